"""Compares tracked poses with the optical ones, sensor by sensor."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.experiments.article import STATISTICS
from anser_ros.field.model import FieldModel
from anser_ros.physics.angles import axis_angles
from anser_ros.sessions.evaluation import track_session
from anser_ros.sessions.session import Session

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SensorErrors:
    """Holds one sensor's errors frame by frame, with NaN where it was not tracked.

    Attributes
    ----------
    tracked, true : ndarray, shape (F, 3)
        Tracked and optical position, m, frame fg.
    distance, angle : ndarray, shape (F,)
        Position error, m, and orientation error, rad.
    """

    tracked: Array
    true: Array
    distance: Array
    angle: Array

    def corrected(self, tracked: Array) -> 'SensorErrors':
        """Return the errors with other tracked positions."""
        distance = np.where(
            np.isfinite(self.distance), np.linalg.norm(tracked - self.true, axis=1), np.nan
        )
        return SensorErrors(tracked, self.true, distance, self.angle)

    @property
    def tracked_fraction(self) -> float:
        """Return the fraction of the frames that have a pose."""
        return float(np.isfinite(self.distance).mean())

    def millimetres(self) -> dict[str, float]:
        """Return RMSE, ME, PRC50 and PRC95 of the position (article, equation 7), mm."""
        return statistics(1e3 * self.distance)

    def degrees(self) -> dict[str, float]:
        """Return the same figures of the orientation, degrees."""
        return statistics(np.degrees(self.angle))


def statistics(errors: Array) -> dict[str, float]:
    """Return the article's four figures of errors, or NaN without any finite error."""
    good = errors[np.isfinite(errors)]
    if good.size == 0:
        return dict.fromkeys(STATISTICS, float('nan'))
    return {
        'RMSE': float(np.sqrt(np.mean(good**2))),
        'ME': float(good.mean()),
        'PRC50': float(np.percentile(good, 50)),
        'PRC95': float(np.percentile(good, 95)),
    }


def track(session: Session, model: FieldModel, in_phase: bool = False) -> dict[str, SensorErrors]:
    """Track a session and return the errors by the last part of a sensor's name, in capitals.

    As in the article every solution counts, even if a tracker would withhold it for its residual.
    """
    evaluation = track_session(session, model, in_phase=in_phase)
    out = {}
    for tool in session.tools:
        centres, axes = tool.placed()
        for column, name in enumerate(tool.sensors.name):
            series = evaluation.sensors[name]
            tracked = np.array([estimate.position for estimate in series.estimates])
            found = np.array([estimate.axis for estimate in series.estimates])
            distance = np.linalg.norm(tracked - centres[:, column], axis=1)
            angle = axis_angles(found, axes[:, column])
            token = name.rsplit('/', 1)[-1].upper()
            out[token] = SensorErrors(tracked, centres[:, column], distance, angle)
    return out
