"""What a refit computes once: the driving field, the layers and what every cloud predicts."""

from dataclasses import dataclass

import numpy as np

from anser_ros.fitting.model import FieldModel
from anser_ros.fitting.refit_clouds import Region, default_clouds
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
    """

    excitation: Excitation
    region: Region
    layers: tuple[Layer, ...]
    priors: tuple[CloudPrior, ...]


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
    rng = np.random.default_rng(settings.seed)
    frequencies = np.array(model.frequencies_hz)
    priors = [
        build_prior(
            cloud,
            box if cloud.overhead else bottom,
            references,
            excitation.field(cloud.positions),
            frequencies,
            settings.survey,
            rng,
        )
        for cloud in clouds
    ]
    return Scene(excitation, region, (bottom, box), tuple(priors))
