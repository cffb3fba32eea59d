"""Follows, as live, patches of a recorded session, which carry reference coils that move."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import BagError, FitError, ParameterError
from anser_ros.frames.intake import Intake
from anser_ros.refit.patches import PatchCoils
from anser_ros.refit.result import RefitResult
from anser_ros.sessions.prepared import PreparedSession
from anser_ros.sessions.recorded_poses import published_poses
from anser_ros.sessions.session import sensor_table
from anser_ros.sessions.volume import stated_volume
from anser_ros.tracking.rotations import rotation_of_quaternion
from anser_ros.wire.recorded import PoseStream

ComplexArray = NDArray[np.complex128]


def parse_patches(entries: Sequence[str]) -> dict[str, str]:
    """Return the topic of every patch's body from entries ``body=topic``.

    Raises
    ------
    ParameterError
        When an entry is not of that form or a body appears twice.
    """
    topics: dict[str, str] = {}
    for entry in entries:
        body, _, topic = entry.partition('=')
        if not body or not topic or body in topics:
            raise ParameterError(f'patches must be BODY=TOPIC, each once, got {entry!r}')
        topics[body] = topic
    return topics


class PatchFollower:
    """Runs a refit with the coils of patches, whose poses lie in the session's own bag.

    The live node computes a refit for new places in parallel with its callbacks and continues
    without the patches meanwhile; here that takes no time.

    Parameters
    ----------
    prepared : PreparedSession
        With references and a baseline.
    topics : dict of str to str
        Topic of every patch's poses by its body (see `parse_patches`).

    Raises
    ------
    BagError
        When the setup has no coils on such a body, or the bag no poses on such a topic.
    """

    def __init__(self, prepared: PreparedSession, topics: dict[str, str]) -> None:
        session, baseline = prepared.session, prepared.baseline
        assert session.reference is not None and baseline is not None
        moving = tuple(s for s in session.setup.tool_sensors if s.body in topics)
        for body in topics:
            if body not in {s.body for s in moving}:
                raise BagError(f'{session.path}: the setup has no coils on the body {body}')
        found = published_poses(session.path, list(topics.values()))
        for topic, poses in found.items():
            if poses.stamp_ns.size == 0:
                raise BagError(f'{session.path}: no pose on the topic {topic}')
        self._poses: dict[str, PoseStream] = {b: found[t] for b, t in topics.items()}
        self._patches = PatchCoils(sensor_table(moving), baseline.flux, session.setup.refit)
        self._intake = Intake(session.reference.sensors.channel, error=FitError)
        self._refit = self._patches.started(
            prepared.model,
            session.reference.sensors,
            drawing=prepared.nominal.field,
            volume=stated_volume(session.setup),
        )

    def take_flux(
        self,
        stamp_ns: int,
        channels: NDArray[np.int64],
        flux: ComplexArray,
        flags: NDArray[np.int64],
    ) -> None:
        """Keep the fluxes of the patches' coils among the tools'."""
        self._patches.take_flux(stamp_ns, channels, flux, flags)

    def update(
        self,
        stamp_ns: int,
        channels: NDArray[np.int64],
        flux: ComplexArray,
        flags: NDArray[np.int64],
    ) -> RefitResult:
        """Refit to a frame of the references, with the newest pose of every patch."""
        for body, poses in self._poses.items():
            last = int(np.searchsorted(poses.stamp_ns, stamp_ns, side='right')) - 1
            if last >= 0:
                rotation = rotation_of_quaternion(poses.quaternion[last])
                self._patches.put(body, int(poses.stamp_ns[last]), poses.position[last], rotation)
        now, known = self._patches.where(stamp_ns)
        if known.any() and self._patches.must_rebuild(now):
            self._refit = self._patches.rebuilt(self._refit, now)
            self._patches.settle(now)
        frame = self._intake.judge(stamp_ns, channels, flux, flags, self._patches.fixed.shape[1])
        return self._patches.follow(self._refit, frame)
