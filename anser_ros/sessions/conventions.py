"""Finds units, order and axes in which optical poses and fluxes were written, from the fluxes.

Poses predict the fluxes of the drawn board. If they do not fit as they are, but fit when read in
another unit, in another order or with other axes, they were written in that convention. If nothing
fits (an optical frame that is not the board's, a board that cannot be drawn), nothing is reported.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import PlausibilityError
from anser_ros.field.measurements import Measurements
from anser_ros.refit.excitation import FieldFunction
from anser_ros.sessions.drawing import NominalBoard
from anser_ros.sessions.units import FLUX_UNITS, LENGTH_UNITS, unit_words
from anser_ros.sessions.volume import tracked_volume
from anser_ros.wire.setup import Setup

Array = NDArray[np.float64]

MOST_FRAMES = 40
"""Frames that are looked at, evenly over the recording: enough for shares, few enough for a
hundredth of a second."""
FEWEST_READINGS = 12
"""Readings (a coil in a frame) without which nothing is decided: fewer fit by chance."""
MISFIT = 0.3
"""Relative misfit of a reading (over all emitters) up to which it fits. A board as drawn, with the
tolerances of a workshop, metal and a tool's own errors, predicts to a few hundredths; a wrong axis
misses by one and more."""
POOR, GOOD = 0.6, 0.8
"""Shares of readings that fit: below the first the poses as they stand are in doubt, above the
second another reading of them is right. Half a turn about one axis leaves a third of the readings
of a triaxial coil right, so between the two nothing is decided."""
TOO_LARGE = 100.0
"""Factor over the drawn board's fluxes from which on a unit is in doubt; gains and currents of a
board that is not as drawn stay far below."""


@dataclass(frozen=True)
class Reading:
    """Describes one way to read the numbers of a pose, and says in words what they then are.

    ``order`` is where x, y, z and w stand, ``scale`` m in a unit of length, and ``axes`` which of
    the numbers, counted from one, are x, y and z: negative where they are reversed. A rotation
    that is inverse is from fg to the body; in another frame rotations have these axes too.
    """

    words: str
    order: tuple[int, int, int, int] = (0, 1, 2, 3)
    is_inverse: bool = False
    scale: float = 1.0
    axes: tuple[int, int, int] = (1, 2, 3)
    is_frame: bool = False

    def placed(self, position: Array, rotation: Array) -> tuple[Array, Array]:
        """Return positions (F, 3), m, and rotations (F, 3, 3) that are written so."""
        turn = np.eye(3)[np.abs(self.axes) - 1] * np.sign(self.axes)[:, None]
        position = self.scale * position @ turn.T
        if not self.is_frame:
            return position, rotation
        # A left-handed tracker states rotations of a body that it has mirrored as well.
        back = turn.T if np.linalg.det(turn) < 0.0 else np.eye(3)
        return position, turn @ rotation @ back


def _other_axes() -> Iterator[Reading]:
    """Exchanged and reversed axes: of positions alone, and of the whole frame."""
    for order in itertools.permutations((1, 2, 3)):
        for signs in itertools.product((1, -1), repeat=3):
            x, y, z = (sign * axis for sign, axis in zip(signs, order, strict=True))
            if (x, y, z) == (1, 2, 3):
                continue
            named = ', '.join(f'{"-" * (a < 0)}{"xyz"[abs(a) - 1]}' for a in (x, y, z))
            for is_frame, what in ((False, 'positions with'), (True, 'poses in a frame of')):
                yield Reading(f'{what} the axes {named}', axes=(x, y, z), is_frame=is_frame)


AS_WRITTEN = Reading('')
"""The poses as `docs/interfaces.md` has them: m, x y z w, body to fg."""
W_FIRST = (1, 2, 3, 0)
"""Where x, y, z and w stand in a quaternion that begins with w."""
OTHER_READINGS = (
    Reading('quaternions with w first', W_FIRST),
    Reading('rotations from fg to the body', is_inverse=True),
    Reading('quaternions with w first and rotations from fg to the body', W_FIRST, True),
    *(Reading(f'positions in {unit}', scale=1 / size) for unit, size in LENGTH_UNITS.items()),
    *(
        Reading(f'positions in {unit} and quaternions with w first', W_FIRST, scale=1 / size)
        for unit, size in LENGTH_UNITS.items()
    ),
    *_other_axes(),
)
"""What people write instead; the first that fits is named."""


def check_conventions(path: str, setup: Setup, nominal: NominalBoard, tool: Measurements) -> None:
    """Check units and order of a tool's poses, and the unit of its fluxes, against each other.

    Raises
    ------
    PlausibilityError
        When the poses contradict the fluxes as they stand and fit them when read in another way,
        or the fluxes are larger than the board can make by the factor of a unit.
    """
    field = nominal.field
    if field is None:
        return
    rows, columns = _chosen(tool)
    fit = partial(_fit, field, tool, rows, columns)
    share, gain = fit(AS_WRITTEN) if len(rows) >= FEWEST_READINGS else (np.nan, np.nan)
    if share > GOOD:
        median = float(np.median(np.linalg.norm(tool.flux[rows, columns], axis=1)))
        _check_flux(path, tool, median, gain, 'at its poses')
        return
    for reading in OTHER_READINGS if share < POOR else ():
        better, _ = fit(reading)
        if better > GOOD:
            span = float(np.linalg.norm(np.ptp(tool.position[rows], axis=0)))
            raise PlausibilityError(
                f'{path}: optical poses of {tool.body} (positions span {span:.3g} m) explain '
                f'{100 * share:.0f} % of the fluxes as they stand, and {100 * better:.0f} % when '
                f'read as {reading.words}'
            )
    _check_size(path, setup, field, tool)


def _chosen(tool: Measurements) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Frames and columns of readings with a pose, of some frames over the whole recording.

    Fluxes in a small unit are beyond what counts as valid, so only flags and NaN exclude one.
    """
    whole = np.isfinite(tool.flux).all(axis=2) & (tool.flags == 0) & tool.has_pose[:, None]
    frames = np.flatnonzero(whole.any(axis=1))
    frames = frames[:: max(1, -(-frames.size // MOST_FRAMES))]
    some = np.zeros(whole.shape[0], dtype=bool)
    some[frames] = True
    rows, columns = np.nonzero(whole & some[:, None])
    return rows, columns


def _fit(
    drawn: FieldFunction,
    tool: Measurements,
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    reading: Reading,
) -> tuple[float, float]:
    """Share of readings (P,) that fit when poses are read so, and the fluxes' common factor."""
    flux = tool.flux[rows, columns]
    frames, where = np.unique(rows, return_inverse=True)
    # Loaded here, as each start of a node would pay for it that has no poses to read.
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_quat(
        Rotation.from_matrix(tool.rotation[frames]).as_quat()[:, list(reading.order)]
    )
    rotation = (turn.inv() if reading.is_inverse else turn).as_matrix()
    centres, axes = tool.sensors.placed(*reading.placed(tool.position[frames], rotation))
    predicted = np.einsum('pki,pi->pk', drawn(centres[where, columns]), axes[where, columns])
    size = np.einsum('pk,pk->p', predicted, predicted)
    ratio = np.einsum('pk,pk->p', predicted, flux) / np.maximum(size, 1e-300)
    # All channels may lag by the same phase; their sign is left as it is.
    lag = 0.5 * float(np.angle(np.sum((ratio / np.maximum(np.abs(ratio), 1e-300)) ** 2)))
    gain = float(np.median(np.abs(ratio)))
    miss = np.linalg.norm(flux - gain * np.exp(1j * lag) * predicted, axis=1)
    return float(np.mean(miss < MISFIT * np.linalg.norm(flux, axis=1))), gain


def _check_flux(path: str, tool: Measurements, median: float, gain: float, where: str) -> None:
    """Raise where fluxes are larger than the drawn board's by the factor of a unit."""
    if gain > TOO_LARGE:
        unit = unit_words(gain, FLUX_UNITS) or 'another unit than T'
        raise PlausibilityError(
            f'{path}: fluxes of {tool.body} are {median:.3g} T, {gain:.2g} times what the drawn '
            f'board makes {where}: {unit}?'
        )


def _check_size(path: str, setup: Setup, drawn: FieldFunction, tool: Measurements) -> None:
    """Raise where fluxes are larger than the drawn board makes anywhere in the tracked volume."""
    whole = np.isfinite(tool.flux).all(axis=2) & (tool.flags == 0)
    if not whole.any():
        return
    median = float(np.median(np.linalg.norm(tool.flux[whole], axis=1)))
    there = np.linalg.norm(drawn(tracked_volume(setup).samples(4, 3)), axis=(1, 2))
    if median > TOO_LARGE * float(there.max()):
        usual = float(np.median(there))
        _check_flux(path, tool, median, median / usual, 'in the tracked volume')
