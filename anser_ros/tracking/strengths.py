"""Learns the emitters' strengths from the tools, where no reference follows them.

An emitter that is warmer than at the calibration multiplies all that is read of it by one complex
factor, at every pose. Metal changes each coil's readings by a factor of its own, and a bent tool
those of some coils. So each emitter's factor, and how fast it changes, is a slow state beside the
poses (an iterated Kalman filter from which each frame's pose is eliminated). It corrects what is
read once readings themselves have determined it, and only by frames in which it leaves no more
than noise; what is unknown of it is in the sigma of poses, and in the gate.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from anser_ros.arrays import Array, ComplexArray
from anser_ros.integrity.pose_checks import STREAM_GAP_S
from anser_ros.kernel_cache import kernel
from anser_ros.settings import EMITTER_STEADY_S, ToolSettings
from anser_ros.stamps import NANO
from anser_ros.tracking import body_track, coil_step
from anser_ros.tracking.body_track import BodyFit, BodyFrame
from anser_ros.tracking.estimate import USUAL_GATE
from anser_ros.tracking.rigid import fill_common
from anser_ros.tracking.solve import RealField
from anser_ros.tracking.solve_context import AS_THEY_ARE

PACE_S = 0.2
"""Time between frames that are learnt from, s: a strength changes by 1e-4 in it."""
MOST_LEFT = 4.0
"""Residual power per freedom that strengths may leave: twice the noise, as a calibrated tool's own
errors do. Metal leaves a hundred times as much on nine coils."""
AGREEING, CONTRADICTING = 3, 10
"""Frames in a row that strengths have to explain before they are used, and that they do not before
they are learnt anew: half a second, in which metal that moves changes, and two seconds."""
LEAST, CERTAIN = 1e-3, 4.0
"""Change of a strength, and standard deviations of it, from which on it is one. Calibrations leave
errors of half as much, which are no change: learnt, they made poses no better, and unlike by the
frame that a tracker began with. A smaller change moves coils of a tool of nine by 0.003 mm
(simulated); from a larger one on, three coils are beyond 3 sigma while an emitter warms up."""
KNOWN = 3e-3
"""Standard deviation of a strength up to which it is used: from 0.1 mm of a pose on, metal passes
for strengths that a single coil hardly knows."""
MOST = 4.0
"""Strength in its prior deviations from which on it is no emitter that warms up."""
SOFT = 1e-9
"""Relative information on a turn of a pose that no reading sees, as of a coil about its axis."""
Look = tuple[BodyFrame, BodyFit]
"""What a body, or a single coil, reads in a frame, and where it was found by that."""


@kernel
def go_on(mean, covariance, seconds, rate, keep):  # type: ignore[no-untyped-def]
    """Carry strengths and their rates (2 2K,), and their covariance, on by some time, in place.

    Of rates ``keep`` is left, and what is new makes their deviation ``rate`` in the long run, 1/s.
    """
    width = mean.size // 2
    for i in range(width):
        mean[i] += seconds * mean[width + i]
        mean[width + i] *= keep
        for j in range(2 * width):
            covariance[i, j] += seconds * covariance[width + i, j]
            covariance[width + i, j] *= keep
    for i in range(2 * width):
        for j in range(width):
            covariance[i, j] += seconds * covariance[i, width + j]
            covariance[i, width + j] *= keep
    for i in range(width, 2 * width):
        covariance[i, i] += rate * rate * (1.0 - keep * keep)


@kernel
def learn_strengths(  # type: ignore[no-untyped-def]
    start, coils, rows, flux, model, away, count, most, mean, covariance
):  # fmt: skip
    """Return the power per freedom that strengths leave of a frame, learnt from if at ``most``.

    The first seven ``rows`` are those of `BodySolution` at the pose ``start``; ``coils`` and
    ``model`` are as of `solve_near`, which knows no errors of strengths here. The ``flux``
    (S, 2K), T, is corrected, by ``away`` (2K,) less than the ``mean``. ``count`` are the readings
    less the pose's unknowns. ``mean`` and ``covariance`` are as of `go_on`.
    """
    width, size, sigma = flux.shape[1], flux.size, model.sigma
    common = np.empty((model.modes.shape[1] // width + coils[3].shape[0], size))
    fill_common(
        start[0], start[1], coils[0], coils[1], coils[2], coils[3], flux, model.uncertain,
        model.modes, sigma, np.empty((0, 0)), common,
    )  # fmt: skip
    white = np.zeros((7 + width, size))
    for i in range(7):
        for k in range(size):
            white[i, k] = rows[i, k]
    for s in range(flux.shape[0]):
        for k in range(0, width, 2):
            for i in range(2):
                w, column = 1.0 / sigma[k + i], s * width + k + i
                white[7 + k, column] = w * flux[s, k + i]
                white[8 + k, column] = w * flux[s, k + 1 - i] * (2 * i - 1)
    others = np.dot(white, common.T)
    square = np.dot(white, white.T) - np.dot(others, others.T)
    across, pose = square[:, 1:7].copy(), square[1:7, 1:7].copy()
    for i in range(6):
        pose[i, i] *= 1.0 + SOFT
    square -= np.dot(np.dot(across, np.linalg.inv(pose)), across.T)
    information, known = square[7:, 7:].copy(), covariance[:width, :width].copy()
    score, before = square[7:, 0] - np.dot(information, away), np.linalg.inv(known)
    chi2 = square[0, 0] - np.dot(away, square[7:, 0] + score)
    after = np.linalg.inv(before + information)
    explained = np.dot(score, np.dot(after, score))
    ratio = (chi2 - explained) / max(count - np.sum(after * information), 1.0)
    if not ratio <= most:
        return ratio
    scale = max(ratio, 1.0)
    after = np.linalg.inv(before + information / scale)
    carried = np.dot(covariance[:, :width].copy(), before)
    mean += np.dot(carried, np.dot(after, score)) / scale
    covariance -= np.dot(np.dot(carried, known - after), carried.T)
    covariance += covariance.T.copy()
    covariance *= 0.5
    return ratio


class EmitterStrengths:
    """Holds what is known of the emitters' strengths, relative to the model's, less one.

    ``used`` (K,) is what fluxes are corrected by, None for nothing, and ``errors`` (2K, 2K) its
    errors of one standard deviation each, as in `SolveContext`.
    """

    used: ComplexArray | None
    errors: Array

    def __init__(self) -> None:
        self.forget(None, ToolSettings())

    def forget(self, field: RealField | None, tools: ToolSettings) -> None:
        """Begin anew with the emitters as a model has them."""
        self.field, self.tools, self._last_ns = field, tools, 0
        self._width = 0 if field is None else field.moments.shape[1]
        self._agreed = 0  # Frames in a row that were explained; negative where they were not
        self.used, self.errors = None, AS_THEY_ARE

    def _open(self) -> None:
        """Forget what was learnt, but not what is used."""
        prior = [self.tools.emitter_offset**2, self.tools.emitter_rate_1_s**2]
        self._mean = np.zeros(2 * self._width)
        if self.used is not None:
            self._mean[: self._width] = self.used.view(np.float64)
        self._covariance = np.diag(np.repeat(prior, self._width))

    def words(self, emitters: Sequence[str]) -> str:
        """Return which emitters are corrected by more than `LEAST`, with one sigma."""
        if self.used is None:
            return ''
        sigma = np.sqrt((self.errors**2).sum(axis=1)).reshape(-1, 2)
        each = zip(emitters, self.used.tolist(), sigma.max(axis=1).tolist(), strict=True)
        return ', '.join(
            f'{name} {100 * one.real:+.2f} % and {1e3 * one.imag:+.1f} mrad ± {100 * error:.2f} %'
            for name, one, error in each
            if abs(one) > LEAST
        )

    def is_due(self, stamp_ns: int) -> bool:
        """Return whether a frame is to be learnt from."""
        return not 0.0 <= (stamp_ns - self._last_ns) * NANO < PACE_S

    def learn(self, stamp_ns: int, looks: Iterable[Look]) -> None:
        """Learn from a frame that was corrected by ``used``."""
        if not self._last_ns:
            self._open()
        seconds, self._last_ns = (stamp_ns - self._last_ns) * NANO, stamp_ns
        if not 0.0 <= seconds <= STREAM_GAP_S:
            self._agreed = 0
            return
        rate, keep = self.tools.emitter_rate_1_s, math.exp(-seconds / EMITTER_STEADY_S)
        go_on(self._mean, self._covariance, seconds, rate, keep)
        explained = [self._explains(*look) for look in looks]
        if not explained:
            return
        self._agreed = self._agreed + 1 if all(explained) else min(self._agreed, 0) - 1
        if self._agreed <= -CONTRADICTING:
            self._agreed = 0
            self._open()
        known, mean = self._covariance[: self._width, : self._width], self._mean[: self._width]
        sigma, size = np.sqrt(np.diag(known)), np.abs(mean)
        is_change = self.used is not None or (size > np.maximum(LEAST, CERTAIN * sigma)).any()
        is_known = sigma.max() <= KNOWN and size.max() <= MOST * self.tools.emitter_offset
        if self._agreed >= AGREEING and is_change and is_known:
            self.used = mean.view(np.complex128).copy()
            self.errors = np.linalg.cholesky(known)

    def _explains(self, frame: BodyFrame, fit: BodyFit) -> bool:
        """Return whether strengths leave no more than noise of a frame, which then is learnt.

        Where what was found by the used strengths misfits, it is found again with what is unknown
        of them: they multiply what is read, so that this is exact.
        """
        solution, used = fit.solution, fit.used
        flux, start = frame.flux[used], (solution.position, solution.rotation)
        coils, model = frame.coils.subset(used).arrays, frame.context.arrays
        if not fit.good(USUAL_GATE):
            known = self._covariance[: self._width, : self._width]
            unknown = frame.context.with_strengths(np.linalg.cholesky(known))
            frame = replace(frame, context=unknown)
            solution = body_track.solve_with(frame, used, start).solution
        away = self._mean[: self._width].copy()
        if self.used is not None:
            away -= self.used.view(np.float64)
        unknowns = (body_track if len(used) > 1 else coil_step).UNKNOWNS
        ratio: float = learn_strengths(
            start, coils, solution.rows, flux, model, away, flux.size - unknowns, MOST_LEFT,
            self._mean, self._covariance,
        )  # fmt: skip
        return ratio <= MOST_LEFT
