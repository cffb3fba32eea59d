"""Puts the effects found into the model: field effects into its dipoles, the rest as records."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import Remedy
from anser_ros.effects.prediction import Fields, changed_illumination
from anser_ros.effects.term import Term
from anser_ros.field.dipoles import Dipoles
from anser_ros.field.model import EffectRecord, FieldModel

Array = NDArray[np.float64]


def corrected_model(
    model: FieldModel, terms: Sequence[Term], records: Sequence[EffectRecord], fields: Fields
) -> FieldModel:
    """Bake field effects into the dipoles and list all effects.

    Metal that moves is not included: the live refit finds its place from the references.
    """
    dipoles = Dipoles(model.positions, model.directions, model.moments)
    light = changed_illumination(terms, fields.illumination)
    for term in terms:
        if term.effect.remedy is Remedy.FIELD and not term.effect.moving:
            added = term.effect.sources(term, fields.model, light, fields.omega)
            if added is not None:
                dipoles = dipoles.joined(added)
    if dipoles.positions.shape[0] == model.positions.shape[0]:
        return replace(model, effects=(*model.effects, *records))
    merged, rows = _merged(dipoles)
    modes = model.modes
    if modes is not None:
        wide = np.zeros((modes.shape[0], merged.positions.shape[0], modes.shape[2]), dtype=complex)
        for mode, own in zip(wide, modes, strict=True):
            np.add.at(mode, rows[: model.positions.shape[0]], own)
        modes = wide
    return replace(
        model,
        positions=merged.positions,
        directions=merged.directions,
        moments=merged.moments,
        modes=modes,
        effects=(*model.effects, *records),
        references=None,  # they were read in the field without these
    )


def _merged(dipoles: Dipoles) -> tuple[Dipoles, NDArray[np.int64]]:
    """Dipoles of the same place and direction added up, and the row that each went to."""
    key = np.round(np.concatenate([dipoles.positions * 1e9, dipoles.directions * 1e9], axis=1))
    _, first, rows = np.unique(key, axis=0, return_index=True, return_inverse=True)
    rows = rows.ravel()
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(order.size)
    rows, first = rank[rows], first[order]
    moments = np.zeros((first.size, dipoles.moments.shape[1]), dtype=complex)
    np.add.at(moments, rows, dipoles.moments)
    return Dipoles(dipoles.positions[first], dipoles.directions[first], moments), rows
