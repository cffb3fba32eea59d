"""Offers calibration as a function: sessions in, a model with its held-out error out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from anser_ros.api.given import Figures, Progress, SessionSource, session_given, shown
from anser_ros.api.model import Model
from anser_ros.calibration.calibrate import Options
from anser_ros.calibration.layouts import Layout
from anser_ros.calibration.result import to_document
from anser_ros.calibration.sensor_parameters import KINDS
from anser_ros.errors import FitError, ParameterError
from anser_ros.sessions.calibration import calibrate_sessions, check_same_board


@dataclass(frozen=True)
class CalibrationResult(Figures):
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

    ROWS = 'emitters'
    model: Model
    heldout_flux_rmse_t: float
    flux_error_t: float
    figures: Mapping[str, Any]

    def __repr__(self) -> str:
        return f'CalibrationResult({self.model}, held out {self.heldout_flux_rmse_t:.3g} T)'


def calibrate(
    sessions: SessionSource | Sequence[SessionSource],
    *,
    dipoles: int | None = None,
    estimate: Sequence[str] = KINDS,
    force: bool = False,
    progress: Progress = None,
) -> CalibrationResult:
    """Fit a field model to recorded sessions of one board.

    Parameters
    ----------
    sessions : Session or path, or sequence of such
        With tool fluxes and optical poses.
    dipoles : int, optional
        Use a layer of so many by so many vertical dipoles on the board. By default the layout is
        chosen by its error on held-out blocks of space, which takes longer.
    estimate : sequence of str
        Errors of sensors and clock to estimate together with the field, where the scan supports
        them; all of `KINDS` by default, none when it is empty.
    force : bool
        Whether to return a model that is worse on held-out readings than the nominal one.
    progress : bool or callable, optional
        True shows a bar; a function is called with the stage in words, and the finished share
        from 0 to 1.

    Raises
    ------
    FitError
        When the data cannot determine a model, with the number needed and the number found; when
        the sessions are of different boards; or when the nominal model is better and ``force`` is
        not set.

    ParameterError
        When ``dipoles`` or ``estimate`` is none of what they may be.

    Examples
    --------
    >>> from anser_ros import calibrate, load_session
    >>> result = calibrate(load_session('bags/factory.mcap'), dipoles=12)
    >>> len(result.model.field.positions), result.flux_error_t < 1e-9
    (144, True)
    >>> result.model.save('model.yaml')
    """
    several = isinstance(sessions, Sequence) and not isinstance(sessions, str)
    given = [session_given(one) for one in (sessions if several else [sessions])]  # type: ignore
    if not given:
        raise FitError('a calibration needs at least one session')
    check_same_board(given)
    if dipoles is not None and (not isinstance(dipoles, int) or dipoles < 1):
        raise ParameterError(f'dipoles must be a number of at least 1, got {dipoles!r}')
    if isinstance(estimate, str) or set(estimate) - set(KINDS):
        raise ParameterError(f'estimate must be some of {", ".join(KINDS)}, got {estimate!r}')
    layout = None if dipoles is None else Layout('layer', dipoles, 1.0, 0.0)
    options = Options(layout=layout, estimate=tuple(estimate))
    with shown(progress, 'calibrate') as tell:
        found = calibrate_sessions(given, options, tell)
    figures = to_document(found)
    if not found.better_than_nominal and not force:
        raise FitError(
            f'the held-out error, {figures["heldout_flux_rmse_t"]:.3g} T, is worse than that of '
            f'the board as drawn, {found.nominal_rmse_t:.3g} T; force=True returns it anyway'
        )
    return CalibrationResult(
        Model(found.model), figures['heldout_flux_rmse_t'], found.model.flux_error_t, figures
    )
