"""Offers calibration as a function: sessions in, a model with its held-out error out."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from anser_ros.api.model import Model
from anser_ros.calibration.calibrate import Options
from anser_ros.calibration.layouts import Layout
from anser_ros.calibration.result import to_document
from anser_ros.calibration.sensor_parameters import KINDS
from anser_ros.errors import FitError
from anser_ros.sessions.calibration import calibrate_sessions, check_same_board
from anser_ros.sessions.session import Session


@dataclass(frozen=True)
class CalibrationResult:
    """Holds a calibrated model and how good it is.

    Attributes
    ----------
    model : Model
    heldout_flux_rmse_t : float
        Error on readings that took no part in the fit, T, optical jitter included.
    flux_error_t : float
        The model's own error there, T a phasor component, noise and jitter subtracted.
    figures : mapping
        Everything that ``calibration.json`` holds.
    """

    model: Model
    heldout_flux_rmse_t: float
    flux_error_t: float
    figures: Mapping[str, Any]

    def __repr__(self) -> str:
        return f'CalibrationResult({self.model}, held out {self.heldout_flux_rmse_t:.3g} T)'

    def to_dict(self) -> dict[str, Any]:
        """Return the content of ``calibration.json`` (``docs/interfaces.md``)."""
        return dict(self.figures)


def calibrate(
    sessions: Session | Sequence[Session],
    *,
    dipoles: int | None = None,
    estimate: Sequence[str] = KINDS,
    force: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> CalibrationResult:
    """Fit a field model to recorded sessions of one board.

    Parameters
    ----------
    sessions : Session or sequence of Session
        With tool fluxes and optical poses.
    dipoles : int, optional
        Use a layer of so many by so many vertical dipoles on the board. By default the layout is
        chosen by its error on held-out blocks of space, which takes longer.
    estimate : sequence of str
        Errors of sensors and clock to estimate together with the field, where the scan supports
        them; all of `KINDS` by default, none when it is empty.
    force : bool
        Whether to return a model that is worse on held-out readings than the nominal one.
    progress : callable, optional
        Called with the stage in words, and the finished share from 0 to 1.

    Raises
    ------
    FitError
        When the data cannot determine a model, with the number needed and the number found; when
        the sessions are of different boards; or when the nominal model is better and ``force`` is
        not set.

    Examples
    --------
    >>> from anser_ros import calibrate, load_session
    >>> result = calibrate(load_session('bags/factory.mcap'), dipoles=12)
    >>> len(result.model.field.positions), result.flux_error_t < 1e-9
    (144, True)
    >>> result.model.save('model.yaml')
    """
    given = [sessions] if isinstance(sessions, Session) else list(sessions)
    if not given:
        raise FitError('a calibration needs at least one session')
    check_same_board(given)
    layout = None if dipoles is None else Layout('layer', dipoles, 1.0, 0.0)
    options = Options(layout=layout, estimate=tuple(estimate))
    found = calibrate_sessions(given, options, progress)
    figures = to_document(found)
    if not found.better_than_nominal and not force:
        raise FitError(
            f'the held-out error, {figures["heldout_flux_rmse_t"]:.3g} T, is worse than that of '
            f'the board as drawn, {found.nominal_rmse_t:.3g} T; force=True returns it anyway'
        )
    return CalibrationResult(
        Model(found.model), figures['heldout_flux_rmse_t'], found.model.flux_error_t, figures
    )
