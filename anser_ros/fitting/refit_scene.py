"""What a refit computes once: the driving field, the layers and what every cloud predicts."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from anser_ros.fitting.model import FieldModel
from anser_ros.fitting.refit_clouds import Cloud, Region, default_clouds
from anser_ros.fitting.refit_excitation import Excitation, FieldFunction, excitation_for
from anser_ros.fitting.refit_layer import Layer, bottom_layer, box_layer
from anser_ros.fitting.refit_prior import (
    ORIENTED,
    UPRIGHT,
    CloudPrior,
    Response,
    build_prior,
)
from anser_ros.fitting.refit_result import RefitSettings
from anser_ros.physics.sensor import SensorTable

Hypothesis = tuple[Cloud, Response, Layer]

MOST_ORIENTED = 1000
"""A cloud of more sources than this gets no tensors: they cost most where they matter least."""


@dataclass(frozen=True)
class Scene:
    """The pieces.

    Attributes
    ----------
    excitation : Excitation
    region : Region
    layers : tuple of Layer
        Below the board, and around the volume.
    hypotheses : tuple of (Cloud, Response, Layer)
    priors : tuple of CloudPrior
    frequencies_hz : tuple of float
    """

    excitation: Excitation
    region: Region
    layers: tuple[Layer, ...]
    hypotheses: tuple[Hypothesis, ...]
    priors: tuple[CloudPrior, ...]
    frequencies_hz: tuple[float, ...]

    def moved(self, references: SensorTable, settings: RefitSettings) -> 'Scene':
        """The scene for references that are elsewhere."""
        priors = _priors(
            self.hypotheses, references, self.excitation, self.frequencies_hz, settings
        )
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
    hypotheses = _hypotheses(clouds, bottom, box)
    priors = _priors(hypotheses, references, excitation, model.frequencies_hz, settings)
    return Scene(excitation, region, (bottom, box), hypotheses, priors, model.frequencies_hz)


def _hypotheses(clouds: Sequence[Cloud], bottom: Layer, box: Layer) -> tuple[Hypothesis, ...]:
    """Every cloud with the responses that are worth their time."""
    out: list[Hypothesis] = []
    for cloud in clouds:
        layer = box if cloud.overhead else bottom
        plain = Response() if cloud.overhead else UPRIGHT
        out.append((cloud, plain, layer))
        if len(cloud.positions) <= MOST_ORIENTED:
            out.append((cloud, ORIENTED, layer))
    return tuple(out)


def _priors(
    hypotheses: Sequence[Hypothesis],
    references: SensorTable,
    excitation: Excitation,
    frequencies_hz: tuple[float, ...],
    settings: RefitSettings,
) -> tuple[CloudPrior, ...]:
    rng = np.random.default_rng(settings.seed)
    return tuple(
        build_prior(
            cloud,
            response,
            layer,
            references,
            excitation.field(cloud.positions),
            np.array(frequencies_hz),
            settings.survey,
            rng,
        )
        for cloud, response, layer in hypotheses
    )
