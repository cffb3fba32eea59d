"""What a refit computes once: the driving field, the layers and what every cloud predicts."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from anser_ros.fitting.model import FieldModel
from anser_ros.fitting.refit_clouds import Cloud, Region, default_clouds
from anser_ros.fitting.refit_excitation import Excitation, FieldFunction, excitation_for
from anser_ros.fitting.refit_layer import Layer, bottom_layer, box_layer
from anser_ros.fitting.refit_prior import CloudPrior, build_prior
from anser_ros.fitting.refit_result import RefitSettings
from anser_ros.physics.sensor import SensorTable


@dataclass(frozen=True)
class Scene:
    """The pieces.

    Attributes
    ----------
    excitation : Excitation
    region : Region
    layers : tuple of Layer
        Below the board, and around the volume.
    priors : tuple of CloudPrior
    frequencies_hz : tuple of float
    """

    excitation: Excitation
    region: Region
    layers: tuple[Layer, ...]
    priors: tuple[CloudPrior, ...]
    frequencies_hz: tuple[float, ...]

    def moved(self, references: SensorTable, settings: RefitSettings) -> 'Scene':
        """The scene for references that are elsewhere."""
        pairs = [(prior.cloud, prior.layer) for prior in self.priors]
        priors = _priors(pairs, references, self.excitation, self.frequencies_hz, settings)
        return replace(self, priors=priors)


def build_scene(
    model: FieldModel,
    references: SensorTable,
    settings: RefitSettings,
    drawing: FieldFunction | None,
) -> Scene:
    """Compute the scene; raises `FitError` as `excitation_for` does."""
    excitation, region = excitation_for(model, drawing)
    clouds = default_clouds(region)
    bottom = bottom_layer(model, region, excitation, clouds[0].positions)
    box = box_layer(region, excitation)
    pairs = [(cloud, box if cloud.overhead else bottom) for cloud in clouds]
    priors = _priors(pairs, references, excitation, model.frequencies_hz, settings)
    return Scene(excitation, region, (bottom, box), priors, model.frequencies_hz)


def _priors(
    pairs: Sequence[tuple[Cloud, Layer]],
    references: SensorTable,
    excitation: Excitation,
    frequencies_hz: tuple[float, ...],
    settings: RefitSettings,
) -> tuple[CloudPrior, ...]:
    rng = np.random.default_rng(settings.seed)
    return tuple(
        build_prior(
            cloud,
            layer,
            references,
            excitation.field(cloud.positions),
            np.array(frequencies_hz),
            settings.survey,
            rng,
        )
        for cloud, layer in pairs
    )
