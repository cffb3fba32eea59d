"""Holds what a scan says of its own sensors, clock and optics."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.contradictions import Contradiction
from anser_ros.calibration.optical_noise import OpticalNoise
from anser_ros.calibration.population import Posterior
from anser_ros.calibration.sensor_parameters import SensorParameters, Survey


@dataclass(frozen=True)
class SurveyResult:
    """Holds what a scan says of its own sensors, clock and optics.

    Attributes
    ----------
    parameters : SensorParameters
        What was asked for.
    posterior : Posterior
        Values, prior widths and covariance of all parameters.
    left_out : tuple of str
        Kinds that the data do not speak for.
    evidence : dict of str to float
        Gain of the log probability by each other kind.
    noise_t : float
        Noise of a phasor component, with what the field's model misses, T.
    optical : OpticalNoise
        Jitter of the optical poses.
    alone : dict of str to ndarray of int
        Parameters of channels that stand outside their population.
    kept, steady : tuple of ndarray of bool
        Frames of each of the measurements whose pose and field are good, and those in which
        nothing moved.
    reflected : float
        Share of the frames whose pose is not where the fluxes put it.
    undetermined : dict of str to float
        Kinds that the scan does not determine, with the standard deviation that it leaves; these
        are as the setup says, or as their prior makes them.
    shift_sigma_m : float
        Standard deviation along each axis, m, of a shift that the whole field shares: of the lever
        arm, and of the mean of all optical poses.
    contradictions : tuple of Contradiction
        Of which parameters two sessions say different things.
    """

    parameters: SensorParameters
    posterior: Posterior
    left_out: tuple[str, ...]
    evidence: dict[str, float]
    noise_t: float
    optical: OpticalNoise
    alone: dict[str, NDArray[np.int64]]
    kept: tuple[NDArray[np.bool_], ...]
    steady: tuple[NDArray[np.bool_], ...]
    reflected: float
    undetermined: dict[str, float]
    shift_sigma_m: float = 0.0
    contradictions: tuple[Contradiction, ...] = ()

    def survey(self, body: str) -> Survey:
        """Return the survey of a body's sensors."""
        return self.parameters.survey(body, self.posterior.values)
