"""Makes the field models compared: the drawing, the article's method, and this package's."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from anser_ros.calibration.calibrate import Options
from anser_ros.calibration.dipole_sites import basis_rows
from anser_ros.calibration.factors import TriangularFactor, as_complex, as_real
from anser_ros.calibration.layouts import Layout, place
from anser_ros.calibration.prior import emitter_gains
from anser_ros.calibration.readings import with_pose
from anser_ros.calibration.result import Calibration
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel
from anser_ros.sessions.calibration import calibrate_sessions
from anser_ros.sessions.calibration_engine import generator_of
from anser_ros.sessions.session import Session
from anser_ros.sessions.starting_model import NOMINAL, model_for

ARTICLE_COUNT = 12
"""Dipoles along a side of the article's layer, as it states."""
OUTLINE = 1.0
"""Size of the article's layer as a multiple of the coils' outline."""


def centres_extension(session: Session) -> float:
    """Return the size of a layer up to the outermost coil centres, relative to the outline."""
    generator = generator_of(session.setup)
    centres = generator.centres[:, :2]
    reach = np.abs(centres - generator.middle[:2]).max(axis=0)
    return float((reach / generator.half_extent).max())


def drawn_model(session: Session, training: Sequence[Session]) -> FieldModel:
    """Return the drawing's Biot-Savart model with a real gain for each emitter.

    The gains are fitted to undistorted recordings.
    """
    nominal = model_for(NOMINAL, session)
    tools = [with_pose(tool) for other in training for tool in other.tools]
    gains = emitter_gains(nominal, tools).real
    # The drawing's own tolerances are what the gains and the data now replace.
    model = replace(nominal, moments=nominal.moments * gains, modes=None)
    return expecting(model, _residual_rms(model, tools))


def expecting(model: FieldModel, flux_error_t: float) -> FieldModel:
    """Return the model with at least this error of its own, so that solutions are not refused."""
    return replace(model, flux_error_t=max(flux_error_t, model.flux_error_t))


def _residual_rms(model: FieldModel, tools: Sequence[Measurements]) -> float:
    """Return the root mean square of the in-phase residuals at the measured poses, T."""
    errors = []
    for tool in tools:
        points, axes = tool.placed()
        lengths = np.broadcast_to(tool.sensors.length, tool.usable.shape)
        flux = model.flux(points[tool.usable], axes[tool.usable], lengths[tool.usable])
        errors.append((tool.flux[tool.usable] - flux).real.ravel())
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


def article_model(session: Session, extension: float = OUTLINE) -> FieldModel:
    """Return the article's model: 12 x 12 fixed z-dipoles by least squares (its equation 6)."""
    dipoles = place(Layout('layer', ARTICLE_COUNT, extension, 0.0), generator_of(session.setup))
    factor = TriangularFactor(len(dipoles), 2 * len(session.setup.emitter_names))
    for tool in session.tools:
        posed = with_pose(tool)
        used = posed.usable.ravel()
        right = as_real(posed.flux).reshape(used.size, -1)
        factor.add(basis_rows(posed, dipoles)[used], right[used])
    moments = as_complex(factor.spectrum().solve(0.0)).real.astype(complex)
    return FieldModel(
        dipoles.positions, dipoles.directions, moments,
        session.setup.emitter_names, session.setup.frequencies_hz,
    )  # fmt: skip


def our_model(sessions: Sequence[Session]) -> Calibration:
    """Return this package's calibration, with everything chosen by held-out error."""
    return calibrate_sessions(list(sessions), Options())
