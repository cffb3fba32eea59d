"""Solves once for field, poses, bends and sensors of a body that rests at few poses.

A channel's own gain and tilt touch only its own readings, so they are marginalised there: they
widen the covariance of those readings, and what is left is one generalised least-squares problem
in the dipoles' moments and the frames' poses and bends (Golub and Van Loan, Matrix Computations,
section 3.2). Laplace's approximation of the evidence says which kinds of errors, and which further
dipoles, the readings ask for.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from anser_ros.calibration.dipole_sites import DipoleSites
from anser_ros.calibration.moments import FitFigures
from anser_ros.calibration.still_model import Columns, StillModel, StillUnknowns

Array = NDArray[np.float64]

FREEDOM = 4.0
"""Degrees of freedom of Student's t, the distribution of a channel's readings in a frame: a few
wild ones lose weight, and the others hardly any."""
SHARED = 100.0
"""How many times tighter the sum of an error over all frames is held than the error: what all
frames share moves the field or turns the sensors, and is no frame's."""
AT_ONCE = 64
"""Places of a dipole that are judged at a time; each takes three columns for each part."""


def student_weight(size: Array, parts: int) -> Array:
    """Return what readings of so many parts count, by their squared residuals in sigmas."""
    return np.asarray((FREEDOM + parts) / (FREEDOM + size))


def figures_of(
    basis: Array, weights: Array, noise_t: float, freedom: float, alternations: int
) -> FitFigures:
    """Return how well a fit to rows of a basis (P, N) went, its condition worked out."""
    size = np.linalg.svd(basis / np.linalg.norm(basis, axis=0), compute_uv=False)
    return FitFigures(
        weights=(weights,),
        noise_t=noise_t,
        rank=int((size > size[0] * len(basis) * np.finfo(float).eps).sum()),
        freedom=freedom,
        condition=float(size[0] / max(size[-1], np.finfo(float).tiny)),
        alternations=alternations,
    )


@dataclass(frozen=True)
class StillWidths:
    """Holds standard deviations of everything before any data; zero fixes what it belongs to."""

    noise_t: float  # of a reading's component, T
    moments: Array  # (N,): A m^2
    frames: Array  # (6 + B,): of a frame's pose and bend, m and rad
    sensors: Array  # (G + 2,): of gains, and tilts in rad


class StillSystem:
    """One linear system about an estimate, with its solution.

    ``now``: about which it is linear. ``widths``: before any data. ``place_width`` (J,): how far
    the last J dipoles of free direction may be from where they are, m. ``moving``: whether places
    and the frames' errors are solved for; at first there is no field to tell them by.

    Attributes
    ----------
    solution : StillUnknowns
    steps : ndarray, shape (J, 3)
        Of the places of free dipoles, m.
    sensor_variance : ndarray, shape (S, G + 2)
    moment_variance, frame_variance : ndarray, shape (N, C), (F, 6 + B)
    residual : ndarray, shape (F, S, C)
        Of the linear model, T.
    """

    def __init__(
        self, model: StillModel, now: StillUnknowns, sites: DipoleSites, widths: StillWidths,
        weights: Array, place_width: Array, moving: bool = True,
    ) -> None:  # fmt: skip
        self.model, self.now, self.widths = model, now, widths
        self.place_width = place_width if moving else place_width[:0]
        columns = model.columns(now, sites, len(self.place_width))
        self.free = (widths.frames > 0.0) & moving
        self.frames, self.sensors = weights.shape
        self._whiten(columns, weights)
        plain = self._shared(columns)
        self.shared = self.inverse_root @ plain
        white = self.shared.reshape(-1, self.shared.shape[2])
        target = (self.inverse_root @ columns.target[..., None]).ravel()
        self.prior = self._prior()
        self.factor = np.linalg.cholesky(white.T @ white + self.prior)
        # What the unknowns can explain of whitened rows v is reach @ (reach.T @ v).
        self.reach = scipy.linalg.solve_triangular(self.factor, white.T, lower=True).T
        self.white_residual = target - self.reach @ (self.reach.T @ target)
        self.values = np.linalg.solve(self.factor.T, self.reach.T @ target)
        self._share_out(columns, columns.target - plain @ self.values)

    def _whiten(self, columns: Columns, weights: Array) -> None:
        parts = self.model.parts
        self.seen = np.tile(weights.T > 0.0, (1, parts))
        root = np.tile(np.sqrt(weights).T, (1, parts)) / self.widths.noise_t
        self.root = np.where(self.seen, root, 0.0)
        # In units of the noise every covariance is the unit matrix and what a sensor adds.
        self.spread = columns.own * self.widths.sensors * self.root[:, :, None]
        covariance = self.spread @ self.spread.transpose(0, 2, 1)
        covariance[:, np.arange(root.shape[1]), np.arange(root.shape[1])] += 1.0
        lower = np.linalg.cholesky(covariance)
        self.log_covariance = 2.0 * float(np.log(np.diagonal(lower, axis1=1, axis2=2)).sum())
        self.unit_root = np.linalg.inv(lower)
        self.inverse_root = self.unit_root * self.root[:, None, :]

    def _shared(self, columns: Columns) -> Array:
        """Columns of moments, part by part, and of the frames' errors: (S, R, Q)."""
        parts, dipoles, count = self.model.parts, columns.basis.shape[2], int(self.free.sum())
        out = np.zeros((self.sensors, parts, self.frames, parts * dipoles + self.frames * count))
        for part in range(parts):
            out[:, part, :, part * dipoles : (part + 1) * dipoles] = columns.basis
        for frame in range(self.frames):
            first = parts * dipoles + frame * count
            out[:, :, frame, first : first + count] = columns.frames[:, :, frame][..., self.free]
        flat = out.reshape(self.sensors, parts * self.frames, -1)
        return np.concatenate([flat, columns.places], axis=2)

    def _prior(self) -> Array:
        widths, free = self.widths, self.widths.frames[self.free]
        moments = np.tile(widths.moments**-2.0, self.model.parts)
        places = np.repeat(self.place_width**-2.0, 3)
        out = np.diag(np.concatenate([moments, np.tile(free**-2.0, self.frames), places]))
        for k, width in enumerate(free):
            same = len(moments) + k + len(free) * np.arange(self.frames)
            out[np.ix_(same, same)] += (SHARED / width) ** 2
        return out

    def _share_out(self, columns: Columns, rest: Array) -> None:
        """Give each sensor its own of what is left (S, R), and order the values as unknowns."""
        parts, dipoles = self.model.parts, columns.basis.shape[2]
        # Its columns span the covariance of the shared unknowns.
        spread = np.linalg.inv(self.factor).T
        variance = (spread**2).sum(axis=1)
        last = parts * dipoles + self.frames * int(self.free.sum())
        moments, frames, steps = np.split(self.values, [parts * dipoles, last])
        self.steps = steps.reshape(-1, 3)
        self.moment_variance = variance[: parts * dipoles].reshape(parts, dipoles).T
        every = np.zeros((2, *self.now.frames.shape))
        every[0][:, self.free] = frames.reshape(self.frames, -1)
        every[1][:, self.free] = variance[parts * dipoles : last].reshape(self.frames, -1)
        self.frame_variance = every[1]
        width = self.widths.sensors
        half = self.unit_root @ self.spread
        white = (self.inverse_root @ rest[..., None])[..., 0]
        own = width * np.einsum('sra,sr->sa', half, white)
        alone = np.maximum(width**2 * (1.0 - (half**2).sum(axis=1)), 0.0)
        # What is uncertain of the shared unknowns is taken for a sensor's own, or is not.
        passed = (half * width).transpose(0, 2, 1) @ self.shared @ spread
        self.sensor_variance = alone + (passed**2).sum(axis=2)
        self.solution = StillUnknowns(moments.reshape(parts, dipoles).T, every[0], own)
        left = rest - np.einsum('sra,sa->sr', columns.own, own)
        self.residual = left.reshape(self.sensors, parts, self.frames).transpose(2, 0, 1)

    def student_weights(self, usable: NDArray[np.bool_]) -> Array:
        """Return weights (F, S) of the readings by what is left of them; 0 where unusable."""
        parts = self.model.parts
        size = (self.residual**2).sum(axis=2) / self.widths.noise_t**2
        return np.where(usable, student_weight(size, parts), 0.0)

    def log_evidence(self, usable: NDArray[np.bool_]) -> float:
        """Return Laplace's approximation of the log evidence, up to a constant of the readings."""
        parts, noise = self.model.parts, self.widths.noise_t
        size = (self.residual**2).sum(axis=2)[usable] / noise**2
        fit = -0.5 * (FREEDOM + parts) * float(np.log1p(size / FREEDOM).sum())
        fit -= parts * size.size * np.log(noise)
        penalty = float(self.values @ self.prior @ self.values)
        used = self.widths.sensors > 0.0
        own = self.solution.sensors[:, used] / self.widths.sensors[used]
        volume = float(np.linalg.slogdet(self.prior)[1])
        volume -= 2.0 * float(np.log(np.diag(self.factor)).sum()) + self.log_covariance
        return float(fit - 0.5 * (penalty + float((own**2).sum())) + 0.5 * volume)

    def gains(self, basis: Array, widths: Array) -> Array:
        """Return the log evidence that a dipole of free direction adds at each of P places.

        ``basis`` (S, F, 3P): flux of its three components in each channel, T/(A m^2). ``widths``
        (W, P): expected sizes of its moment to try, A m^2.

        """
        parts, places = self.model.parts, basis.shape[2] // 3
        flat = np.empty((places, parts * 3, self.sensors * self.root.shape[1]))
        for part in range(parts):
            own = slice(part * self.frames, (part + 1) * self.frames)
            white = (self.inverse_root[:, :, own] @ basis).reshape(flat.shape[2], places, 3)
            flat[:, 3 * part : 3 * part + 3] = white.transpose(1, 2, 0)
        shadow = flat @ self.reach
        pull = flat @ self.white_residual
        normal = flat @ flat.transpose(0, 2, 1) - shadow @ shadow.transpose(0, 2, 1)
        size = widths[:, :, None, None]
        inner = np.eye(3 * parts) + normal[None] * size**2
        step = np.linalg.solve(inner, (pull[None] * widths[:, :, None])[..., None])[..., 0]
        explained = 0.5 * (pull[None] * widths[:, :, None] * step).sum(axis=2)
        return np.asarray(explained - 0.5 * np.linalg.slogdet(inner)[1])
