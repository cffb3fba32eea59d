"""Flux messages to arrays: what is no frame is refused, and every fault has its counter.

The tracker and the field model count alike, so that an operator finds the same fault under the
same name in both.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2

from anser_ros.errors import LayoutError
from anser_ros.nodes.model_clouds import NANO, layout_of, stamp_of, width_of
from anser_ros.physics.sensor import LARGEST_FLUX_T
from anser_ros.tracking.emitters import living_emitters
from anser_ros.wire.points import DROPPED, SATURATED, STALE, FluxPoints, decode_flux

Count = Callable[[str, int], None]
# A second is also what a warm start of the tracker may be old.
JUMP_NS = NANO
KINDS = ((SATURATED, 'saturated'), (STALE, 'stale'), (DROPPED, 'dropped'))


def read_flux(message: PointCloud2) -> tuple[int, FluxPoints]:
    """Stamp (ns) and points of a flux message.

    Raises
    ------
    LayoutError
        When the stamp is zero or none, or the cloud is no flux cloud.
    """
    if message.header.stamp.nanosec >= NANO:
        raise LayoutError(
            f'the stamp has {message.header.stamp.nanosec} nanoseconds, a second or more'
        )
    stamp_ns = stamp_of(message)
    if stamp_ns <= 0:
        raise LayoutError('the flux message has no stamp')
    width = width_of(message)
    return stamp_ns, decode_flux(
        layout_of(message), message.point_step, width, message.data, bool(message.is_bigendian)
    )


def read_frame(message: PointCloud2, frame_id: str, count: Count) -> tuple[int, FluxPoints]:
    """Read a flux message that must be in a frame; its peculiarities are counted.

    Parameters
    ----------
    message : PointCloud2
    frame_id : str
        The setup's frame.
    count : callable
        Gets a counter's name, and by how much it rises: ``fluxes_big_endian``,
        ``fluxes_other_frame_id``, ``fluxes_without_stamp``.

    Raises
    ------
    LayoutError
        When it is in another frame, has no stamp, or is no flux cloud.
    """
    if message.is_bigendian:
        count('fluxes_big_endian', 1)
    if message.header.frame_id != frame_id:
        count('fluxes_other_frame_id', 1)
        raise LayoutError(
            f'fluxes in the frame {message.header.frame_id!r}, the setup is in {frame_id!r}'
        )
    if stamp_of(message) <= 0 or message.header.stamp.nanosec >= NANO:
        count('fluxes_without_stamp', 1)
    return read_flux(message)


class FrameWatch:
    """Looks at frames before they are used: order of the stamps, and readings that are no good.

    Parameters
    ----------
    channels : ndarray of int, shape (S,)
        The channels that ought to be there.
    emitters : tuple of str
        Names of the emitters.
    count : callable
        Gets a counter's name, and by how much it rises: ``frames``, ``duplicates``; ``time_jumps``
        back, ``time_jumps_forward`` of more than a second; ``frames_empty``;
        ``frames_dead_emitter``; and readings that were not used: ``readings_missing``,
        ``readings_saturated``, ``readings_stale``, ``readings_dropped``, ``readings_not_finite``,
        ``readings_absurd``.

    Attributes
    ----------
    dead : tuple of str
        Emitters that no sensor heard in the last frame while others were heard.
    """

    def __init__(
        self, channels: NDArray[np.int64], emitters: tuple[str, ...], count: Count
    ) -> None:
        self._channels, self._emitters, self._count = channels, emitters, count
        self._last_ns = 0
        self.dead: tuple[str, ...] = ()

    def admit(self, stamp_ns: int, points: FluxPoints) -> NDArray[np.complex128] | None:
        """Return the fluxes of a frame, NaN for absurd ones; None for a frame seen before.

        Raises
        ------
        LayoutError
            When it has another number of emitters.
        """
        count, last_ns = self._count, self._last_ns
        if points.flux.shape[1] != len(self._emitters):
            raise LayoutError(
                f'the model has {len(self._emitters)} emitters, the fluxes {points.flux.shape[1]}'
            )
        if stamp_ns == last_ns:
            count('duplicates', 1)
            return None
        if stamp_ns < last_ns:
            count('time_jumps', 1)
        elif 0 < last_ns < stamp_ns - JUMP_NS:
            count('time_jumps_forward', 1)
        self._last_ns = stamp_ns
        count('frames', 1)
        if not len(points.channel):
            count('frames_empty', 1)
        usable = np.isin(points.channel, self._channels) & (points.flags == 0)
        living = living_emitters(points.flux, usable)
        self.dead = ()
        if living is not None:
            count('frames_dead_emitter', 1)
            self.dead = tuple(self._emitters[k] for k in np.flatnonzero(~living))
        sound = np.abs(points.flux) < LARGEST_FLUX_T
        if not (sound.all() and usable.sum() == len(self._channels)):
            self._count_unusable(points, sound.all(axis=1))
        return points.flux if sound.all() else np.where(sound, points.flux, np.nan)

    def _count_unusable(self, points: FluxPoints, sound: NDArray[np.bool_]) -> None:
        """Count each reading that can't be used by the first reason that applies."""
        wanted = np.isin(points.channel, self._channels)
        flags, sound = points.flags[wanted], sound[wanted]
        found = {'missing': len(self._channels) - len(flags)}
        left = np.ones(len(flags), dtype=bool)
        for bit, kind in KINDS:
            found[kind] = int((left & (flags & bit != 0)).sum())
            left &= flags & bit == 0
        finite = np.isfinite(points.flux[wanted]).all(axis=1)
        found['not_finite'] = int((left & ~finite).sum())
        found['absurd'] = int((left & finite & ~sound).sum())
        for kind, many in found.items():
            if many:
                self._count(f'readings_{kind}', many)
