"""Holds what a scan says of its own sensors, clock and optics."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.contradictions import Contradiction
from anser_ros.calibration.optical_noise import OpticalNoise
from anser_ros.calibration.population import Posterior
from anser_ros.calibration.sensor_parameters import BodyErrors, SensorParameters


@dataclass(frozen=True)
class SensorFit:
    """Holds what a scan says of its own sensors, clock and optics."""

    parameters: SensorParameters  # what was asked for
    posterior: Posterior  # values, prior widths and covariance of all parameters
    left_out: tuple[str, ...]  # kinds that the data do not speak for
    evidence: dict[str, float]  # gain of the log probability by each other kind
    noise_t: float  # noise of a phasor component, with what the field's model misses, T
    optical: OpticalNoise  # jitter of the optical poses
    # parameters of channels that stand outside their population
    alone: dict[str, NDArray[np.int64]]
    # kept, steady: frames of each of the measurements whose pose and field are good, and those in
    # which nothing moved
    kept: tuple[NDArray[np.bool_], ...]
    steady: tuple[NDArray[np.bool_], ...]
    reflected: float  # share of the frames whose pose is not where the fluxes put it
    # kinds that the scan does not determine, with the standard deviation that it leaves; these are
    # as the setup says, or as their prior makes them
    undetermined: dict[str, float]
    # standard deviation along each axis, m, of a shift that the whole field shares: of the lever
    # arm, and of the mean of all optical poses
    shift_sigma_m: float = 0.0
    # of which parameters two sessions say different things
    contradictions: tuple[Contradiction, ...] = ()

    def errors_of(self, body: str) -> BodyErrors:
        """Return the errors of a body's sensors."""
        return self.parameters.errors_of(body, self.posterior.values)
