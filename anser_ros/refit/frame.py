"""Frames of reference fluxes in the references' order, with a reason for each unusable one."""

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import FitError
from anser_ros.physics.sensor import LARGEST_FLUX_T
from anser_ros.refit import health
from anser_ros.refit.kernels import fill_frame

ComplexArray = NDArray[np.complex128]

_REASONS = (
    health.MISSING,
    health.OK,
    health.FLAGGED,
    health.NOT_FINITE,
    health.NO_BASELINE,
    health.SILENT,
    health.ABSURD,
)
QUIET = 0.05
"""A coil that reads less than this share of its baseline is silent: no metal shields so well."""


class FrameOrder:
    """Knows which row of a frame belongs to which reference.

    Parameters
    ----------
    channel : ndarray of int, shape (S,)
        Channels of the references.
    baseline : ndarray, shape (S, K), complex
        A coil whose baseline is not finite can't be used.
    """

    def __init__(self, channel: NDArray[np.int64], baseline: ComplexArray) -> None:
        self._channels: list[int] = channel.tolist()
        self._shape = baseline.shape
        self._least = _least_power(baseline)
        self._told: bytes | None = None
        self._rows = np.empty(0, dtype=np.int64)

    def read(
        self,
        channels: NDArray[np.generic],
        flux: NDArray[np.generic],
        flags: NDArray[np.generic] | None,
        baseline: ComplexArray | None = None,
    ) -> tuple[ComplexArray, NDArray[np.bool_], list[str]]:
        """Fluxes (S, K) in the references' order, which can be used, and why others can't.

        ``baseline`` (S, K) are the clean readings of this frame, where coils move.

        Raises
        ------
        FitError
            When shapes don't fit or a channel appears twice.
        """
        given, number = np.asarray(flux), np.asarray(channels, dtype=np.int64)
        marks = np.zeros(number.shape, dtype=np.int64) if flags is None else np.asarray(flags)
        count, k = self._shape
        if given.shape != (number.size, k) or marks.shape != number.shape:
            raise FitError(
                f'refit: {number.size} channels and {k} emitters need fluxes of that shape and '
                f'as many flags, got {given.shape} and {marks.shape}'
            )
        told = number.tobytes()
        if told != self._told:
            if len(set(number.tolist())) != number.size:
                raise FitError('refit: a channel appears twice in the frame')
            row = {c: i for i, c in enumerate(number.tolist())}
            self._rows = np.array([row.get(c, -1) for c in self._channels], dtype=np.int64)
            self._told = told
        ordered = np.empty(self._shape, dtype=np.complex128)
        code = np.empty(count, dtype=np.int64)
        least = self._least if baseline is None else _least_power(baseline)
        fill_frame(
            np.ascontiguousarray(given, dtype=np.complex128),
            np.ascontiguousarray(marks, dtype=np.int64),
            self._rows, least, LARGEST_FLUX_T, ordered, code,
        )  # fmt: skip
        return ordered, code == 1, [_REASONS[c] for c in code.tolist()]


def _least_power(baseline: ComplexArray) -> NDArray[np.float64]:
    """Power of a reading below which a coil is silent, shape (S,), T^2; NaN without a baseline."""
    power = np.asarray((np.abs(baseline) ** 2).sum(axis=1), dtype=np.float64)
    return np.where(np.isfinite(power), QUIET**2 * power, np.nan)
