"""Places reference coils on patches that move: their baseline follows from their pose.

Such a coil has no recorded baseline. Its expected reading without metal is the calibrated model's
flux at its tracked pose, and the tracker's error becomes noise of that reading, far above a fixed
coil's. It still senses strong metal from places where no fixed coil can be.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import FitError
from anser_ros.field.model import FieldModel
from anser_ros.frames.intake import Frame, Intake
from anser_ros.physics.dipole import flux_jacobian
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit.live_refit import LiveRefit
from anser_ros.refit.result import RefitResult
from anser_ros.settings import Accuracy, RefitSettings

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MOVED_M = 3e-3
"""Shift of a patch's coil, m, from which on its tables are rebuilt."""
TURNED_RAD = 0.03
"""Rotation of a patch's coil, rad, and shift above, within which a refit's tables stay valid."""


def clean_reading(
    model: FieldModel, coils: SensorTable, accuracy: Accuracy
) -> tuple[ComplexArray, Array]:
    """Return the readings of placed coils without metal, with their uncertainty.

    Parameters
    ----------
    model : FieldModel
        Calibrated.
    coils : SensorTable
        Places and axes in fg.
    accuracy : Accuracy
        Of the patches' poses and of their coils' gains.

    Returns
    -------
    flux : ndarray, shape (S, K), complex
        T.
    sigma : ndarray, shape (S,)
        Root mean square over the emitters of a component's standard deviation, T.
    """
    flux, d_position, d_axis = flux_jacobian(
        coils.position, coils.axis, coils.length, model.positions, model.directions, model.moments
    )
    power = (np.abs(accuracy.reference_gain * flux) ** 2).mean(axis=1)
    power += (np.abs(accuracy.patch_position_m * d_position) ** 2).sum(axis=1).mean(axis=1)
    # Turns across the axis only: a turn about it changes nothing.
    along = np.einsum('sa,sak->sk', coils.axis, d_axis)
    across = (np.abs(d_axis) ** 2).sum(axis=1) - np.abs(along) ** 2
    power += accuracy.patch_rotation_rad**2 * across.mean(axis=1)
    return flux, np.sqrt(power)


def has_moved(then: SensorTable, now: SensorTable) -> NDArray[np.bool_]:
    """Return which coils (S,) have moved too far for the tables of their former places."""
    shift = np.linalg.norm(now.position - then.position, axis=1)
    turn = np.linalg.norm(np.cross(now.axis, then.axis), axis=1)
    opposite = (now.axis * then.axis).sum(axis=1) < 0.0
    return np.asarray((shift > MOVED_M) | (turn > TURNED_RAD) | opposite)


POSE_AGE_NS = 200_000_000
"""Largest difference between the stamps of a patch's pose and of a frame (0.2 s)."""
FLUX_AGE_NS = 100_000_000
"""Largest difference between the stamps of a patch's flux and of a frame (0.1 s)."""


@dataclass(frozen=True)
class Placed:
    """Holds the patches' coils in one frame.

    Attributes
    ----------
    flux : ndarray, shape (S, K), complex
        T; NaN where pose or flux are missing or stale.
    baseline : ndarray, shape (S, K), complex
        What they should read without metal, T.
    """

    flux: ComplexArray
    baseline: ComplexArray


class PatchCoils:
    """Keeps the places of the patches' coils by their poses, and their readings.

    Parameters
    ----------
    coils : SensorTable
        Places and axes in their bodies' frames.
    fixed : ndarray, shape (R, K), complex
        Baseline of the fixed references, T.
    settings : RefitSettings, optional
        Of the refit that the coils take part in; its accuracy is also that of their poses.
    """

    def __init__(
        self, coils: SensorTable, fixed: ComplexArray, settings: RefitSettings | None = None
    ) -> None:
        self.coils = coils
        self.fixed = fixed
        self.settings = settings or RefitSettings()
        self._poses: dict[str, tuple[int, Array, Array]] = {}
        self._intake = Intake(coils.channel, error=FitError)
        self._flux = np.full((len(coils), fixed.shape[1]), np.nan, dtype=np.complex128)
        self._flux_ns = 0
        self._built_at: SensorTable | None = None

    def put(self, body: str, stamp_ns: int, position: Array, rotation: Array) -> None:
        """Take in a body's pose, its place (m) and rotation matrix in fg."""
        self._poses[body] = (stamp_ns, position, rotation)

    def take_flux(
        self,
        stamp_ns: int,
        channels: NDArray[np.int64],
        flux: ComplexArray,
        flags: NDArray[np.int64],
    ) -> None:
        """Take in the fluxes of the patches' coils, which are among those of the tools."""
        frame = self._intake.judge(stamp_ns, channels, flux, flags, self.fixed.shape[1])
        self._flux = np.where(frame.usable[:, None], frame.flux, np.nan)
        self._flux_ns = stamp_ns

    def where(self, stamp_ns: int) -> tuple[SensorTable, NDArray[np.bool_]]:
        """Return the coils in fg by their present poses, and which of them have such a pose."""
        position, axis = self.coils.position.copy(), self.coils.axis.copy()
        known = np.zeros(len(self.coils), dtype=bool)
        for coil, body in enumerate(self.coils.body):
            if body not in self._poses:
                continue
            pose_ns, place, rotation = self._poses[body]
            position[coil] = place + rotation @ self.coils.position[coil]
            axis[coil] = rotation @ self.coils.axis[coil]
            known[coil] = abs(stamp_ns - pose_ns) < POSE_AGE_NS
        return self.coils.with_geometry(position, axis), known

    def frame(self, stamp_ns: int, model: FieldModel) -> Placed:
        """Return the coils' readings at a time, and those that they would have without metal."""
        now, known = self.where(stamp_ns)
        clean, _ = clean_reading(model, now, self.settings.accuracy)
        usable = known & (abs(stamp_ns - self._flux_ns) < FLUX_AGE_NS)
        if self._built_at is None:
            usable[:] = False
        else:
            usable &= ~has_moved(self._built_at, now)
        return Placed(np.where(usable[:, None], self._flux, np.nan), clean)

    def must_rebuild(self, now: SensorTable) -> bool:
        """Return whether coils have moved so far that the refit has to be rebuilt."""
        return self._built_at is None or bool(has_moved(self._built_at, now).any())

    def follow(self, refit: LiveRefit, frame: Frame) -> RefitResult:
        """Refit to a frame of the fixed references and to the patches' coils at their places."""
        placed = self.frame(frame.stamp_ns, refit.model)
        both = frame.joined(self.coils.channel, placed.flux)
        return refit.follow(both, np.concatenate([self.fixed, placed.baseline]))

    def started(self, model: FieldModel, references: SensorTable, **options: Any) -> LiveRefit:
        """Return a first refit, in which the patches' coils have no place yet.

        Parameters
        ----------
        model : FieldModel
        references : SensorTable
            The fixed ones.
        options
            Of `LiveRefit`, but for its settings.
        """
        start = start_table(self.coils)
        clean = np.concatenate(
            [self.fixed, clean_reading(model, start, self.settings.accuracy)[0]]
        )
        return LiveRefit(model, references.joined(start), clean, self.settings, **options)

    def rebuilt(self, refit: LiveRefit, now: SensorTable) -> LiveRefit:
        """Return the refit for the present places of the patches; `settle` puts it in force."""
        return _rebuild(refit, now, self.fixed)

    def settle(self, at: SensorTable) -> None:
        """Put the refit that was computed for the patches' present places in force."""
        self._built_at = at


def start_table(coils: SensorTable) -> SensorTable:
    """Return patches' coils at some place over the board, for a first refit without them."""
    return coils.with_geometry(coils.position + np.array([0.0, 0.0, 0.3]))


def noise_of(sigma: Array, n_fixed: int, nominal_t: float) -> Array:
    """Return the noise of all references relative to that of the fixed ones."""
    return np.concatenate([np.ones(n_fixed), np.hypot(1.0, sigma / nominal_t)])


def _rebuild(refit: LiveRefit, now: SensorTable, fixed: ComplexArray) -> LiveRefit:
    count = len(refit.references) - len(now)
    table = refit.references.select(np.arange(count)).joined(now)
    clean, sigma = clean_reading(refit.model, now, refit.settings.accuracy)
    noise = noise_of(sigma, count, refit.settings.accuracy.flux_noise_t)
    return refit.moved(table, np.concatenate([fixed, clean]), noise)
