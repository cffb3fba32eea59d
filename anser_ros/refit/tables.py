"""Computes a refit's tables once, and turns them into plain arrays and back, so that they need not
be computed again.

Tables are the driving field, the layers, the predictions of all clouds, and for the search of
compact bodies the few directions of the space of readings that each body's readings lie in: with
them alone, and one variance for the remainder, its evidence costs a hundredth of the full one.
Stored is what takes seconds; the emitters' field and the clouds are worked out anew, in a fraction
of that.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.arrays import Array, Integers, Single
from anser_ros.field.model import FieldModel
from anser_ros.physics.sensor import SensorTable
from anser_ros.physics.volume import TrackedVolume
from anser_ros.refit import clouds
from anser_ros.refit.kernels import fill_products, fill_scores
from anser_ros.refit.layer import Layer, body_layer, bottom_layer, box_layer, pose_weight
from anser_ros.refit.prior import (
    BODY,
    ORIENTED,
    UPRIGHT,
    CloudPrior,
    ReducedPrior,
    Response,
    build_prior,
    reduced,
    vector_basis,
)
from anser_ros.settings import RefitSettings

DIRECTIONS = 16
"""Directions of the space of readings that are looked at for each body."""
COARSE = 7
"""Sources of a body that they are made from: its centre and six around it."""
REMAINDER = 1e-3
"""Variance of a reading that those directions leave, over the mean one."""


def _symmetric() -> Array:
    """Return an orthonormal basis of the symmetric tensors, (6, 3, 3)."""
    out = np.zeros((6, 3, 3))
    for component, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
        out[component, i, j] = out[component, j, i] = 1.0 if i == j else np.sqrt(0.5)
    return out


def body_factor(cloud: clouds.Cloud, references: SensorTable, excitation: Array) -> Single:
    """Return the readings of a body's coarse sources, a column for each tensor component.

    Of shape (S K, 6 COARSE), scaled so that the readings have a mean variance of 1.
    ``excitation`` (COARSE, K, 3) is the field of the emitters at the first sources, T.
    """
    basis = vector_basis(
        references.position, references.axis, references.length, cloud.positions[:COARSE]
    )
    columns = np.einsum('sma,cab,mkb->skmc', basis, _symmetric(), excitation, optimize=True)
    factor = columns.reshape(len(references) * excitation.shape[1], -1)
    factor /= np.sqrt((factor**2).sum() / len(factor))
    return np.asarray(factor, dtype=np.float32)


@dataclass
class BodySearch:
    """Holds the directions of the bodies' readings for the coils in use."""

    factors: tuple[Single, ...]  # (all readings, c), from `body_factor`
    rows: Integers  # (n,), readings in use
    whitening: Array  # (n, n), makes noise and drift of the readings white
    strengths: Array  # (A,), variances of a reading that the evidence is summed over
    _tables: dict[float, tuple[Single, Array, Array]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count = min(DIRECTIONS, self.factors[0].shape[1], len(self.rows))
        stacked = np.empty((len(self.factors), count, len(self.rows)), dtype=np.float32)
        self._power = np.empty((len(self.factors), count))
        white = self._white = np.ascontiguousarray(self.whitening.T, dtype=np.float32)
        for body, factor in enumerate(self.factors):
            seen = white @ factor[self.rows]
            values, vectors = np.linalg.eigh(seen.T @ seen)
            top = np.maximum(values[::-1][:count], 1e-12 * values[-1])
            stacked[body] = (seen @ (vectors[:, ::-1][:, :count] / np.sqrt(top))).T
            self._power[body] = top
        self._directions = stacked.reshape(-1, len(self.rows))
        self._left = REMAINDER * float(np.mean((white**2).sum(axis=1)))

    def _table(self, noise: float) -> tuple[Single, Array, Array]:
        """Return precisions (L, A, r), those (A,) of the rest, and log determinants (L, A)."""
        if noise not in self._tables:
            self._tables.clear()
            rest = self.strengths * self._left + noise**2
            inside = self.strengths[:, None] * self._power[:, None, :] + rest[:, None]
            others = len(self.rows) - inside.shape[2]
            log_det = np.log(inside).sum(axis=2) + others * np.log(rest)
            self._tables[noise] = ((1.0 / inside).astype(np.float32), 1.0 / rest, log_det)
        return self._tables[noise]

    def scores(self, readings: Array, noise: float) -> Array:
        """Return the approximate log evidence of every body, (L,); arguments as in
        `Bank.evaluate`.
        """
        inside, rest, log_det = self._table(noise)
        white = np.empty((len(self.rows), 2), dtype=np.float32)
        fill_products(self._white, np.ascontiguousarray(readings.T, dtype=np.float32), white)
        white = np.ascontiguousarray(white.T)
        scores = np.empty(len(self._power))
        fill_scores(self._directions, white, inside, rest, log_det, scores)
        return scores


Hypothesis = tuple[clouds.Cloud, Response, Layer]
"""Where metal may be, how it answers, and what stands for its field."""
ReportShare = Callable[[float], None]
"""Called between two pieces of the work with the share that is done."""

START = 0.1
"""Share of the tables' work that is done before the first hypothesis, on the article's board."""
MOST_ORIENTED = 1000
"""Number of sources from which on a cloud has no tensors, whose cost grows with the sources."""


@dataclass(frozen=True)
class RefitTables:
    """Holds the precomputed tables of a refit.

    ``layers`` are those below the board and around the volume; ``factors`` is what `BodySearch`
    needs of each of the `bodies`.
    """

    excitation: clouds.Excitation
    region: clouds.Region
    frequencies_hz: Array
    references: SensorTable
    settings: RefitSettings
    layers: tuple[Layer, Layer]
    factors: tuple[Single, ...]
    priors: tuple[CloudPrior, ...] = ()

    @cached_property
    def bodies(self) -> tuple[clouds.Cloud, ...]:
        """Return the compact bodies that may be put in as further hypotheses."""
        return clouds.bodies(self.region)

    @cached_property
    def _weight(self) -> Array:
        """Return the `pose_weight` of the region's samples, (P,)."""
        return pose_weight(self.region.volume.samples(), self.excitation)

    def body_prior(self, body: int) -> CloudPrior:
        """Return the full hypothesis of a compact body."""
        cloud = self.bodies[body]
        rng = np.random.default_rng([self.settings.seed, body])
        return self._prior(cloud, BODY, body_layer(self.region, self._weight, cloud), rng)

    def reduced(self, prior: CloudPrior) -> ReducedPrior:
        """Return a hypothesis of these tables, or a body of theirs, in few numbers."""
        field = self.excitation.field(prior.cloud.positions)
        rng = np.random.default_rng(self.settings.seed)
        return reduced(prior, field, self.frequencies_hz, rng)

    def hypotheses(self) -> list[Hypothesis]:
        """Return every cloud with each response that is worth its time."""
        out: list[Hypothesis] = []
        for cloud in clouds.default_clouds(self.region):
            layer = self.layers[int(cloud.overhead)]
            out.append((cloud, Response() if cloud.overhead else UPRIGHT, layer))
            if len(cloud.positions) <= MOST_ORIENTED:
                out.append((cloud, ORIENTED, layer))
        return out

    def with_priors(self, report: ReportShare) -> 'RefitTables':
        """Return the tables with the predictions of all clouds."""
        hypotheses = self.hypotheses()
        sizes = np.cumsum([0, *(len(cloud.positions) for cloud, _, _ in hypotheses)])
        rng, priors = np.random.default_rng(self.settings.seed), []
        for hypothesis, done in zip(hypotheses, sizes[:-1].tolist(), strict=True):
            report(START + (1.0 - START) * done / float(sizes[-1]))
            priors.append(self._prior(*hypothesis, rng))
        return replace(self, priors=tuple(priors))

    def _prior(
        self, cloud: clouds.Cloud, response: Response, layer: Layer, rng: np.random.Generator
    ) -> CloudPrior:
        field = self.excitation.field(cloud.positions)
        return build_prior(
            cloud, response, layer, self.references, field, self.frequencies_hz,
            self.settings.accuracy, rng,
        )  # fmt: skip


def build_tables(
    model: FieldModel,
    references: SensorTable,
    settings: RefitSettings,
    drawing: clouds.FieldFunction | None,
    volume: TrackedVolume | None = None,
    report: ReportShare = lambda share: None,
) -> RefitTables:
    """Compute the tables; raises `FitError` as `excitation_for` does, and what ``report`` does."""
    excitation, region = clouds.excitation_for(model, drawing, volume)
    report(START)
    layers = bottom_layer(region, excitation), box_layer(region, excitation)
    around = clouds.bodies(region)
    places = np.concatenate([cloud.positions[:COARSE] for cloud in around])
    driving = excitation.field(places).reshape(len(around), COARSE, -1, 3)
    pairs = zip(around, driving, strict=True)
    factors = tuple(body_factor(cloud, references, field) for cloud, field in pairs)
    frequencies_hz = np.array(model.frequencies_hz)
    return RefitTables(
        excitation, region, frequencies_hz, references, settings, layers, factors
    ).with_priors(report)


Arrays = Mapping[str, NDArray[Any]]
"""Arrays by name; a number or a text is an array of no axes."""


def arrays_of(tables: RefitTables) -> dict[str, NDArray[Any]]:
    """Return what `tables_of` makes the tables from again."""
    out = {f'factor{i}': factor for i, factor in enumerate(tables.factors)}
    for kind, things in (('layer', tables.layers), ('prior', tables.priors)):
        for i, thing in enumerate(things):
            for name in _stored(type(thing)):
                out[f'{kind}{i}.{name}'] = np.asarray(getattr(thing, name))
    return out


def tables_of(
    arrays: Arrays,
    model: FieldModel,
    references: SensorTable,
    settings: RefitSettings,
    drawing: clouds.FieldFunction | None,
    volume: TrackedVolume | None = None,
) -> RefitTables:
    """Return the tables whose arrays these are; the other arguments are those of `build_tables`.

    Raises `KeyError` when an array is missing; `FitError` as `excitation_for`.
    """
    excitation, region = clouds.excitation_for(model, drawing, volume)
    bottom, box = (Layer(**_given(f'layer{i}', Layer, arrays)) for i in range(2))
    factors = tuple(arrays[f'factor{i}'] for i in range(len(clouds.bodies(region))))
    frequencies_hz = np.array(model.frequencies_hz)
    tables = RefitTables(
        excitation, region, frequencies_hz, references, settings, (bottom, box), factors
    )
    priors = tuple(
        CloudPrior(
            cloud=cloud, response=response, layer=layer, **_given(f'prior{i}', CloudPrior, arrays)
        )
        for i, (cloud, response, layer) in enumerate(tables.hypotheses())
    )
    return replace(tables, priors=priors)


NOT_STORED = 'cloud', 'response', 'layer', '_projected'
"""Fields of a layer or hypothesis that are worked out anew."""


def _stored(kind: type[Any]) -> list[str]:
    return [f.name for f in fields(kind) if f.name not in NOT_STORED]


def _given(prefix: str, kind: type[Layer | CloudPrior], arrays: Arrays) -> dict[str, Any]:
    """Return the stored values of a layer or hypothesis by the names of its fields."""
    values = {name: arrays[f'{prefix}.{name}'] for name in _stored(kind)}
    return {name: value if value.ndim else value.item() for name, value in values.items()}
