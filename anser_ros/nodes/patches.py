"""Reference coils on patches that move: poses from a topic, fluxes among the tools'.

A patch is a body of the setup whose pose somebody else tracks. Its coils join the fixed references
for as long as pose and flux are fresh; where one is missing, they are left out and said to be.
"""

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray

from anser_ros.errors import FrameError, ParameterError
from anser_ros.fitting.model import FieldModel
from anser_ros.fitting.refit import LiveRefit
from anser_ros.fitting.refit_patches import PoseError, clean_reading, has_moved
from anser_ros.nodes.model_clouds import stamp_of
from anser_ros.physics.sensor import SensorTable
from anser_ros.tracking.rotations import rotation_of_quaternion
from anser_ros.wire.points import FluxPoints

ComplexArray = NDArray[np.complex128]
Array = NDArray[np.float64]

POSE_AGE_NS = 200_000_000
FLUX_AGE_NS = 100_000_000


def parse_patches(entries: Sequence[str]) -> dict[str, str]:
    """Topic of every patch's body from entries ``body=topic``.

    Raises
    ------
    ParameterError
        When an entry is not of that form or a body appears twice.
    """
    topics: dict[str, str] = {}
    for entry in entries:
        body, _, topic = entry.partition('=')
        if not body or not topic or body in topics:
            raise ParameterError(f'patches: {entry!r} is no new body=topic')
        topics[body] = topic
    return topics


@dataclass(frozen=True)
class Placed:
    """The patches' coils in one frame.

    Attributes
    ----------
    flux : ndarray, shape (S, K), complex
        T; NaN where pose or flux are missing or stale.
    baseline : ndarray, shape (S, K), complex
        What they should read without metal, T.
    """

    flux: ComplexArray
    baseline: ComplexArray


class Patches:
    """Keeps the patches' coils where their poses say.

    Parameters
    ----------
    coils : SensorTable
        Places and axes in their bodies' frames.
    n_emitters : int
    frame_id : str
        The poses' frame must be this one.
    """

    def __init__(self, coils: SensorTable, n_emitters: int, frame_id: str) -> None:
        self.coils = coils
        self._frame_id = frame_id
        self._poses: dict[str, tuple[int, Array, Array]] = {}
        self._flux = np.full((len(coils), n_emitters), np.nan, dtype=np.complex128)
        self._flux_ns = 0
        self._built_at: SensorTable | None = None
        self._worker = ThreadPoolExecutor(max_workers=1)
        self._pending: Future[LiveRefit] | None = None
        self._pending_at: SensorTable | None = None

    def close(self) -> None:
        """End the worker."""
        self._worker.shutdown(wait=False, cancel_futures=True)

    def take_pose(self, body: str, message: PoseStamped) -> None:
        """Keep a body's pose.

        Raises
        ------
        FrameError
            When it is given in another frame, or is no pose.
        """
        if message.header.frame_id != self._frame_id:
            raise FrameError(
                f'the pose of {body} is in {message.header.frame_id!r}, not {self._frame_id!r}'
            )
        p, q = message.pose.position, message.pose.orientation
        quaternion = np.array([q.x, q.y, q.z, q.w])
        position = np.array([p.x, p.y, p.z])
        norm = float(np.linalg.norm(quaternion))
        if not np.isfinite(position).all() or not abs(norm - 1.0) < 1e-2:
            raise FrameError(f'the pose of {body} is no pose')
        rotation = rotation_of_quaternion(quaternion / norm)
        self._poses[body] = (stamp_of(message), position, rotation)

    def take_flux(self, stamp_ns: int, points: FluxPoints) -> None:
        """Keep the fluxes of the patches' coils among the tools'."""
        self._flux[:] = np.nan
        row = {int(c): i for i, c in enumerate(points.channel.tolist())}
        for coil, channel in enumerate(self.coils.channel.tolist()):
            if channel in row and not points.flags[row[channel]]:
                self._flux[coil] = points.flux[row[channel]]
        self._flux_ns = stamp_ns

    def where(self, stamp_ns: int) -> tuple[SensorTable, NDArray[np.bool_]]:
        """Coils in fg by the poses of about now, and which of them have such a pose."""
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
        """The coils' readings and what they should read at a time."""
        now, known = self.where(stamp_ns)
        clean, _ = clean_reading(model, now, PoseError())
        usable = known & (abs(stamp_ns - self._flux_ns) < FLUX_AGE_NS)
        if self._built_at is None:
            usable[:] = False
        else:
            usable &= ~has_moved(self._built_at, now)
        return Placed(np.where(usable[:, None], self._flux, np.nan), clean)

    def _must_rebuild(self, now: SensorTable) -> bool:
        return self._built_at is None or bool(has_moved(self._built_at, now).any())

    def start_table(self) -> SensorTable:
        """Coils somewhere over the board, for a first refit that leaves them out."""
        return self.coils.with_geometry(self.coils.position + np.array([0.0, 0.0, 0.3]))

    def moved_refit(
        self, refit: LiveRefit, stamp_ns: int, fixed: ComplexArray
    ) -> LiveRefit | None:
        """A refit for where the patches are now, when it is needed and has been worked out.

        Parameters
        ----------
        refit : LiveRefit
            The one in force; its last coils are the patches'.
        stamp_ns : int
        fixed : ndarray, shape (R, K), complex
            Baseline of the fixed references.
        """
        if self._pending is not None:
            if not self._pending.done():
                return None
            done, self._pending = self._pending.result(), None
            self._built_at = self._pending_at
            return done
        now, known = self.where(stamp_ns)
        if not known.any() or not self._must_rebuild(now):
            return None
        self._pending_at = now
        self._pending = self._worker.submit(_rebuild, refit, now, fixed)
        return None


def joined(first: SensorTable, second: SensorTable) -> SensorTable:
    """Two tables as one."""
    return SensorTable(
        channel=np.concatenate([first.channel, second.channel]),
        name=(*first.name, *second.name),
        body=(*first.body, *second.body),
        position=np.concatenate([first.position, second.position]),
        axis=np.concatenate([first.axis, second.axis]),
        length=np.concatenate([first.length, second.length]),
    )


def noise_of(sigma: Array, n_fixed: int, nominal_t: float) -> Array:
    """Noise of all references over the nominal one, the fixed ones' being 1."""
    return np.concatenate([np.ones(n_fixed), np.hypot(1.0, sigma / nominal_t)])


def _rebuild(refit: LiveRefit, now: SensorTable, fixed: ComplexArray) -> LiveRefit:
    count = len(refit.references) - len(now)
    table = joined(refit.references.select(np.arange(count)), now)
    clean, sigma = clean_reading(refit.model, now, PoseError())
    noise = noise_of(sigma, count, refit.settings.flux_noise_t)
    return refit.moved(table, np.concatenate([fixed, clean]), noise)
