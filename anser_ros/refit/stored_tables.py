"""Turns a refit's tables into plain arrays and back, so that they need not be computed again.

Stored is what takes seconds: the layers, the hypotheses' predictions and the factors of the
search. The emitters' field and the clouds are worked out anew, in a fraction of that.
"""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.model import FieldModel
from anser_ros.physics.sensor import SensorTable
from anser_ros.physics.volume import TrackedVolume
from anser_ros.refit.clouds import bodies, default_clouds
from anser_ros.refit.excitation import FieldFunction, excitation_for
from anser_ros.refit.layer import Layer
from anser_ros.refit.prior import CloudPrior
from anser_ros.refit.tables import RefitTables, hypotheses_of
from anser_ros.settings import RefitSettings

Arrays = Mapping[str, NDArray[Any]]
"""Arrays by name; a number or a text is an array of no axes, and what is None is not there."""


def arrays_of(tables: RefitTables) -> dict[str, NDArray[Any]]:
    """Return what `tables_of` makes the tables from again."""
    out: dict[str, NDArray[Any]] = {'weight': tables.weight}
    out |= {f'factor{i}': factor for i, factor in enumerate(tables.factors)}
    for i, layer in enumerate(tables.layers):
        out |= _plain(f'layer{i}', layer)
    for i, prior in enumerate(tables.priors):
        out |= _plain(f'prior{i}', prior)
    return out


def tables_of(
    arrays: Arrays,
    model: FieldModel,
    references: SensorTable,
    settings: RefitSettings,
    drawing: FieldFunction | None,
    volume: TrackedVolume | None = None,
) -> RefitTables:
    """Return the tables whose arrays these are; the other arguments are those of `build_tables`.

    Raises
    ------
    KeyError
        When an array is missing.
    FitError
        As `excitation_for`.
    """
    excitation, region = excitation_for(model, drawing, volume)
    bottom, box = (Layer(**_given(f'layer{i}', Layer, arrays)) for i in range(2))
    hypotheses = hypotheses_of(default_clouds(region), bottom, box)
    priors = tuple(
        CloudPrior(
            cloud=cloud, response=response, layer=layer, **_given(f'prior{i}', CloudPrior, arrays)
        )
        for i, (cloud, response, layer) in enumerate(hypotheses)
    )
    return RefitTables(
        excitation,
        region,
        (bottom, box),
        priors,
        model.frequencies_hz,
        tuple(arrays[f'factor{i}'] for i in range(len(bodies(region)))),
        references,
        settings,
        arrays['weight'],
    )


def _plain(prefix: str, thing: Layer | CloudPrior) -> dict[str, NDArray[Any]]:
    """Return the arrays, numbers and texts of a layer or hypothesis under their names."""
    values = {f.name: getattr(thing, f.name) for f in fields(thing)}
    return {
        f'{prefix}.{name}': np.asarray(value)
        for name, value in values.items()
        if isinstance(value, np.ndarray | float | str)
    }


def _given(prefix: str, kind: type[Layer | CloudPrior], arrays: Arrays) -> dict[str, Any]:
    """Return the values that `_plain` stored; None for what may be None and was."""
    out: dict[str, Any] = {}
    for name in (f.name for f in fields(kind) if f.name not in NOT_STORED):
        stored = arrays.get(f'{prefix}.{name}')
        if stored is None and name not in MAY_BE_NONE:
            raise KeyError(f'{prefix}.{name}')
        out[name] = stored.item() if stored is not None and stored.ndim == 0 else stored
    return out


NOT_STORED = 'cloud', 'response', 'layer', '_projected'
"""Fields that are worked out anew."""
MAY_BE_NONE = 'rows', 'inverse'
"""Fields of a layer that only some have."""
