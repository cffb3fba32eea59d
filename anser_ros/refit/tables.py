"""Computes a refit's tables once: driving field, layers and predictions of all clouds."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.model import FieldModel
from anser_ros.physics.sensor import SensorTable
from anser_ros.physics.volume import TrackedVolume
from anser_ros.refit.clouds import Cloud, Region, bodies, default_clouds
from anser_ros.refit.excitation import Excitation, FieldFunction, excitation_for
from anser_ros.refit.layer import Layer, body_layer, bottom_layer, box_layer, pose_weight
from anser_ros.refit.prior import BODY, ORIENTED, UPRIGHT, CloudPrior, Response, build_prior
from anser_ros.refit.reduced import ReducedPrior, reduced
from anser_ros.refit.search import COARSE, body_factor
from anser_ros.settings import RefitSettings

Array = NDArray[np.float64]
Hypothesis = tuple[Cloud, Response, Layer]
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
    needs of each of the `bodies`; ``weight`` (P,) is the `pose_weight` of the region's samples.
    """

    excitation: Excitation
    region: Region
    layers: tuple[Layer, ...]
    priors: tuple[CloudPrior, ...]
    frequencies_hz: tuple[float, ...]
    factors: tuple[NDArray[np.float32], ...]
    references: SensorTable
    settings: RefitSettings
    weight: Array

    @cached_property
    def bodies(self) -> tuple[Cloud, ...]:
        """Return the compact bodies that may be put in as further hypotheses."""
        return bodies(self.region)

    def body_prior(self, body: int) -> CloudPrior:
        """Return the full hypothesis of a compact body."""
        cloud = self.bodies[body]
        rng = np.random.default_rng([self.settings.seed, body])
        return self._prior(cloud, BODY, body_layer(self.region, self.weight, cloud), rng)

    def reduced(self, prior: CloudPrior) -> ReducedPrior:
        """Return a hypothesis of these tables, or a body of theirs, in few numbers."""
        field = self.excitation.field(prior.cloud.positions)
        rng = np.random.default_rng(self.settings.seed)
        return reduced(prior, field, np.array(self.frequencies_hz), rng)

    def with_priors(self, report: ReportShare) -> 'RefitTables':
        """Return the tables with the predictions of all clouds."""
        hypotheses = hypotheses_of(default_clouds(self.region), *self.layers)
        sizes = np.cumsum([0, *(len(cloud.positions) for cloud, _, _ in hypotheses)])
        rng, priors = np.random.default_rng(self.settings.seed), []
        for hypothesis, done in zip(hypotheses, sizes[:-1].tolist(), strict=True):
            report(START + (1.0 - START) * done / float(sizes[-1]))
            priors.append(self._prior(*hypothesis, rng))
        return replace(self, priors=tuple(priors))

    def _prior(
        self, cloud: Cloud, response: Response, layer: Layer, rng: np.random.Generator
    ) -> CloudPrior:
        field = self.excitation.field(cloud.positions)
        return build_prior(
            cloud, response, layer, self.references, field, np.array(self.frequencies_hz),
            self.settings.accuracy, rng,
        )  # fmt: skip


def build_tables(
    model: FieldModel,
    references: SensorTable,
    settings: RefitSettings,
    drawing: FieldFunction | None,
    volume: TrackedVolume | None = None,
    report: ReportShare = lambda share: None,
) -> RefitTables:
    """Compute the tables; raises `FitError` as `excitation_for` does, and what ``report`` does."""
    excitation, region = excitation_for(model, drawing, volume)
    report(START)
    nearest = default_clouds(region)[0]
    layers = (
        bottom_layer(model, region, excitation, nearest.positions),
        box_layer(region, excitation),
    )
    tables = RefitTables(
        excitation,
        region,
        layers,
        (),
        model.frequencies_hz,
        _factors(bodies(region), references, excitation),
        references,
        settings,
        pose_weight(region.volume.samples(), excitation),
    )
    return tables.with_priors(report)


def _factors(
    around: Sequence[Cloud], references: SensorTable, excitation: Excitation
) -> tuple[NDArray[np.float32], ...]:
    places = np.concatenate([cloud.positions[:COARSE] for cloud in around])
    fields = excitation.field(places).reshape(len(around), COARSE, -1, 3)
    return tuple(
        body_factor(cloud, references, field) for cloud, field in zip(around, fields, strict=True)
    )


def hypotheses_of(clouds: Sequence[Cloud], bottom: Layer, box: Layer) -> tuple[Hypothesis, ...]:
    """Return every cloud with each response that is worth its time."""
    out: list[Hypothesis] = []
    for cloud in clouds:
        layer = box if cloud.overhead else bottom
        plain = Response() if cloud.overhead else UPRIGHT
        out.append((cloud, plain, layer))
        if len(cloud.positions) <= MOST_ORIENTED:
            out.append((cloud, ORIENTED, layer))
    return tuple(out)
