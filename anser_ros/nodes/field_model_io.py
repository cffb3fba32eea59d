"""What a field_model publishes (`ModelOutput`, `MetalView`), keeps on disk (`KeptBaseline`), asks
of its references (`PlaceWatch`: is the board where the model has it?) and receives besides them
(`ToolWitnesses`). A baseline cannot be taken while metal is near, so a node that was killed leaves
its own to the next one: the node confirms it every second, as long as the sender of the references
goes on and nothing speaks against it.
"""

import contextlib
import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, PointStamped, Pose, PoseStamped
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from anser_ros.arrays import Array, ComplexArray
from anser_ros.chain.frame import ChainFrame, FrameReadings
from anser_ros.chain.model_half import ToolPose, poses_of, tool_readings
from anser_ros.effects.correction import Correction
from anser_ros.errors import AnserError, FitError, FrameError
from anser_ros.field.model import FieldModel
from anser_ros.fingerprint import fingerprint_of
from anser_ros.frames.intake import Frame
from anser_ros.integrity.board_place import BoardPlace
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.node import AnserNode
from anser_ros.nodes.streams.clouds import (
    GivenModel,
    ModelWriter,
    is_frame,
    read_frame,
    readings_of,
)
from anser_ros.nodes.streams.one_source import OneSource
from anser_ros.physics.rotations import rotation_of_quaternion
from anser_ros.pose_states import code_of
from anser_ros.refit.frame import ReadingWindow
from anser_ros.refit.live_refit import LiveRefit
from anser_ros.refit.model import Metal, RefitResult
from anser_ros.sessions.kept_tables import DAMAGED, read_arrays, used_s, write_arrays
from anser_ros.sessions.session import sensor_table, tracking_noise
from anser_ros.stamps import set_stamp, stamp_of
from anser_ros.tracking.estimate import PoseEstimate
from anser_ros.wire.cdr import PointCloud
from anser_ros.wire.points import ModelError
from anser_ros.wire.recorded import pose_numbers, unit_quaternions
from anser_ros.wire.setup import Setup, topic_of


def pose_in(message: PoseStamped, frame_id: str, body: str) -> tuple[Array, Array]:
    """Return position (3,), m, and rotation (3, 3) of a body in a frame, with any prefix.

    Raises `FrameError` when the pose is given in another frame, or is no pose.
    """
    if not is_frame(message.header.frame_id, frame_id):
        raise FrameError(f'the pose of {body} is in {message.header.frame_id!r}, not {frame_id!r}')
    numbers = pose_numbers(message.pose)
    position, quaternion = np.array(numbers[:3]), unit_quaternions(numbers[3:])
    if not (np.isfinite(position).all() and np.isfinite(quaternion).all()):
        raise FrameError(f'the pose of {body} is not finite, or its quaternion has no unit length')
    return position, rotation_of_quaternion(quaternion)


class ModelOutput(ModelWriter):
    """Publishes models, and keeps the ``newest`` for the nodes of the same process."""

    def __init__(self, node: AnserNode) -> None:
        super().__init__()
        self.newest: GivenModel | None = None
        self._published: ModelError | None = None
        self.models = node.create_publisher(PointCloud2, 'field_model', qos.MODELS)
        self.errors = node.create_publisher(PointCloud2, 'field_model_error', qos.MODEL_ERRORS)

    def publish(
        self, model: FieldModel, frame_id: str, stamp_ns: int, follows: bool, withheld: str
    ) -> None:
        """Publish a model, and before it its uncertainty where that is news."""
        self.newest = given = self.given(model, stamp_ns, follows, code_of(withheld))
        if given.error is not self._published:
            self._published = given.error
            self.errors.publish(self.error(given, frame_id))
        self.models.publish(self.dipoles(given, frame_id))


LEAST_SHOWN_DENSITY = 0.15
"""Sources whose density is at least this part of the strongest one's are shown."""
MOST_SHOWN = 400
"""Sources that are shown at most, the strongest ones: as many as a viewer draws with ease."""
CENTROID_M = 0.03
"""Diameter of the ball that marks the centroid, m: large enough to be seen among the sources."""
VIEW_PERIOD_S = 0.2
"""Time, s, from one marker to the next: eyes follow it, and it costs a message of kilobytes."""


class MetalView:
    """Shows where the metal is, a few times a second: ``metal``, ``metal/centroid``."""

    def __init__(self, node: Node) -> None:
        self._markers = node.create_publisher(MarkerArray, 'metal', qos.LATCHED)
        self._centroid = node.create_publisher(PointStamped, 'metal/centroid', qos.STREAM)
        self._shown_s: float | None = None

    def show(self, result: RefitResult, frame_id: str, stamp_ns: int) -> None:
        """Show what a refit found, or take away what was shown when it found nothing."""
        now_s, shown_s = time.monotonic(), self._shown_s
        is_due = shown_s is None or now_s - shown_s >= VIEW_PERIOD_S
        if result.find is None and shown_s is not None:
            self._markers.publish(metal_markers(None, frame_id, stamp_ns))
            self._shown_s = None
        elif result.find is not None and is_due and result.metal is not None:
            self._shown_s = now_s
            self._markers.publish(metal_markers(result.metal, frame_id, stamp_ns))
            self._centroid.publish(centroid_message(result.metal, frame_id, stamp_ns))


def centroid_message(metal: Metal, frame_id: str, stamp_ns: int) -> PointStamped:
    """Return where the metal's middle is, as far as the emitters reach it."""
    message = PointStamped()
    message.header.frame_id = frame_id
    set_stamp(message.header.stamp, stamp_ns)
    message.point = _point(metal.centroid)
    return message


def metal_markers(metal: Metal | None, frame_id: str, stamp_ns: int) -> MarkerArray:
    """Return spheres as large as the space they stand for, and one at the centroid.

    The markers shown before are deleted: their number changes, and without metal there are none.
    """
    clear = _marker(frame_id, stamp_ns, 0)
    clear.action = Marker.DELETEALL
    if metal is None:
        return MarkerArray(markers=[clear])
    density = np.abs(metal.polarisability) / metal.volumes
    rows = np.argsort(-density)[:MOST_SHOWN]
    rows = rows[density[rows] >= LEAST_SHOWN_DENSITY * density[rows[0]]]
    markers: list[Marker] = []
    for volume in np.unique(metal.volumes[rows]).tolist():
        here = rows[metal.volumes[rows] == volume]
        spheres = _marker(frame_id, stamp_ns, len(markers))
        spheres.type = Marker.SPHERE_LIST
        spheres.scale.x = spheres.scale.y = spheres.scale.z = 0.8 * float(volume) ** (1.0 / 3.0)
        spheres.color = ColorRGBA(r=0.8, g=0.4, b=0.1, a=1.0)
        spheres.points = [_point(metal.positions[row]) for row in here]
        strength = density[here] / density[rows[0]]
        spheres.colors = [
            ColorRGBA(r=0.8, g=0.4, b=0.1, a=float(0.1 + 0.5 * part)) for part in strength
        ]
        markers.append(spheres)
    centre = _marker(frame_id, stamp_ns, len(markers))
    centre.type = Marker.SPHERE
    centre.pose.position = _point(metal.centroid)
    centre.scale.x = centre.scale.y = centre.scale.z = CENTROID_M
    centre.color = ColorRGBA(r=0.9, g=0.1, b=0.1, a=0.9)
    return MarkerArray(markers=[clear, *markers, centre])


def _marker(frame_id: str, stamp_ns: int, number: int) -> Marker:
    marker = Marker(ns='metal', id=number, action=Marker.ADD)
    marker.header.frame_id = frame_id
    set_stamp(marker.header.stamp, stamp_ns)
    marker.pose = Pose()
    marker.pose.orientation.w = 1.0
    return marker


def _point(values: np.ndarray) -> Point:
    x, y, z = (float(v) for v in values)
    return Point(x=x, y=y, z=z)


BASELINE_S = 60.0
"""How long after it was last confirmed, s, a baseline is taken up: a supervisor is faster."""
CONFIRM_S = 1.0
"""Time from one confirmation of a baseline to the next, s."""


class KeptBaseline:
    """Keeps the baseline of a running node of that whole name, in a ``folder``, None for not at
    all.

    ``sender`` returns what identifies the only sender of the references; empty where there is
    none.
    """

    def __init__(self, folder: Path | None, node: str, sender: Callable[[], str]) -> None:
        self.folder, self._node, self._sender = folder, node, sender
        self._of: tuple[str, ...] = ()
        self._kept: Path | None = None

    def expect(self, setup: Setup, model: FieldModel) -> None:
        """Have to do with the references of a setup and with a model from now on."""
        identity = setup.identity
        self._of = identity.board, *identity.bodies.values(), model.fingerprint
        self._kept = None

    @property
    def is_known(self) -> bool:
        """Return whether the references have one sender, and the setup is known."""
        return self._path() is not None

    def read(self) -> ComplexArray | None:
        """Return the baseline that another process confirmed lately, shape (R, K), T, or None."""
        path = self._path()
        with contextlib.suppress(*DAMAGED):
            if path is not None and 0.0 <= time.time() - used_s(path) <= BASELINE_S:
                return np.asarray(read_arrays(path)['flux'], dtype=np.complex128)
        return None

    def confirm(self, flux: ComplexArray) -> None:
        """Keep a baseline, shape (R, K), T, to which nothing is opposed at this moment.

        Raises `OSError` when the disk is full, or must not be written.
        """
        path = self._path()
        if path != self._kept:
            self.drop()
        if path is not None and self._kept is None:
            write_arrays(path, {'flux': flux})
            self._kept = path
            for old in path.parent.glob('baseline_*'):
                if time.time() - used_s(old) > BASELINE_S:
                    old.unlink(missing_ok=True)
        elif path is not None:
            os.utime(path)

    def drop(self) -> None:
        """Keep none: another one is active, or something speaks against it."""
        if self._kept is not None:
            self._kept.unlink(missing_ok=True)
        self._kept = None

    def _path(self) -> Path | None:
        sender = self._sender() if self.folder is not None and self._of else ''
        if self.folder is None or not sender:
            return None
        key = fingerprint_of([self._node, sender, *self._of])
        return self.folder / f'baseline_{key}'


DISCOVERY_S = 1.0
"""Time, s, in which whoever sends the references is found in the graph; a chain without references
has its first pose as much later."""


class PlaceWatch:
    """Asks with the first frame, and again while the model was found to lie aside.

    ``place`` is None where nothing can be compared; ``announced`` returns how many publishers of
    references the graph knows. ``misplaced`` is how the model lies aside; empty where it does not,
    or it is not known yet.
    """

    def __init__(
        self, place: BoardPlace | None = None, announced: Callable[[], int] = lambda: 0
    ) -> None:
        self._place, self._announced = place, announced
        self._has_frame = self._has_looked = False
        self._begin_s = time.monotonic()
        self.misplaced = ''

    @property
    def is_open(self) -> bool:
        """Return whether references could show it, and none has been received."""
        return self._place is not None and not self._has_frame

    @property
    def is_waiting(self) -> bool:
        """Return whether readings of announced references, or of ones still to be, may come."""
        is_early = time.monotonic() - self._begin_s < DISCOVERY_S
        return self.is_open and (is_early or self._announced() > 0)

    def look(self, frame: Frame, window: ReadingWindow) -> bool:
        """Return whether the verdict is another one after a frame, or the first.

        The first frame with enough readings decides; after that a model that was found to be
        displaced is checked again with every whole window.
        """
        is_first, self._has_frame = self.is_open, True
        if self._place is None or (self._has_looked and not (self.misplaced and window.full)):
            return False
        flux = window.mean() if self._has_looked else frame.readings
        before, self.misplaced = self.misplaced, ''
        try:
            self._has_looked |= self._place.check(flux)
        except FitError as error:
            self._has_looked, self.misplaced = True, str(error)
            window.clear()
        return is_first or bool(before) != bool(self.misplaced)


MOST_FRAMES = 8
"""Frames whose fluxes and poses wait for the references of theirs and of the next: two, and some
for a busy machine."""


class ToolWitnesses:
    """Hands the readings of rigid tools to the active refit, once a frame.

    Nothing is subscribed to unless it ``is_wanted``. ``frame_id`` returns the frame of the board,
    ``refuse`` gets a counter's name and the error of what is refused, and ``sources`` are topics
    of which only one publisher is believed.
    """

    def __init__(
        self,
        node: AnserNode,
        is_wanted: bool,
        frame_id: Callable[[], str],
        refuse: Callable[[str, AnserError], None],
    ) -> None:
        self._node, self._frame_id, self._refuse = node, frame_id, refuse
        self._is_wanted, self._noise = is_wanted, 0.0
        self._correction: Correction | None = None
        self._frames: dict[int, FrameReadings] = {}
        self._poses: dict[int, dict[str, ToolPose]] = {}
        self._subscriptions: dict[str, Any] = {}
        topics = ('tool/flux',) if is_wanted else ()
        self.sources = [
            OneSource(node, PointCloud2, topic, self._on_flux, qos.STREAM) for topic in topics
        ]

    def expect(self, setup: Setup, model: FieldModel) -> None:
        """Have to do with the tools of a setup, and with a model's effects, from now on."""
        self._correction = None
        if not self._is_wanted or not setup.tool_sensors:
            return
        sensors = sensor_table(setup.tool_sensors)
        self._correction = Correction.of(model.effects, sensors, model.frequencies_hz)
        self._noise = tracking_noise(setup)
        self._frames, self._poses = {}, {}
        has_none = self.sources[0].subscription is None  # poses are given as fluxes are
        for body in set() if has_none else set(sensors.body) - set(self._subscriptions):
            self._subscriptions[body] = self._node.create_subscription(
                PoseStamped, f'{topic_of(body)}/pose', partial(self._on_pose, body), qos.STREAM
            )
        for body in set(self._subscriptions) - set(sensors.body):
            self._node.destroy_subscription(self._subscriptions.pop(body))

    @property
    def noise_t(self) -> float | None:
        """Return the noise of a component of what the tools read, T; None without witnesses."""
        return None if self._correction is None else self._noise

    def pass_on(self, refit: LiveRefit, stamp_ns: int) -> None:
        """Give the refit what the tools read in its last frame, of the stamp given, once."""
        tools, poses = self._frames.pop(stamp_ns, None), self._poses.pop(stamp_ns, None)
        correction = self._correction
        if tools is None or poses is None or correction is None:
            return
        poses = {body: pose for body, pose in poses.items() if self._has_one_source(body)}
        readings = tool_readings(correction, tools, poses)
        if readings:
            refit.witnessed(readings)
            self._node.count('witnessed_frames')

    def note(self, frame: ChainFrame, found: Sequence[PoseEstimate]) -> None:
        """Take in a frame's tools and poses from the nodes of the same process."""
        if self._correction is not None and frame.tools is not None:
            _keep(self._frames, frame.stamp_ns, frame.tools)
            _keep(self._poses, frame.stamp_ns, poses_of(found))

    def _has_one_source(self, body: str) -> bool:
        """Return whether one publisher gives a body's poses; whose is whose is not known else."""
        known = self._subscriptions.get(body)
        count = 1 if known is None else self._node.count_publishers(known.topic_name)
        if count > 1:
            text = f'{count} publishers of the pose of {body}: it witnesses nothing'
            self._node.warn('witnesses_of_two_sources', text)
        return count <= 1

    def _on_flux(self, message: PointCloud) -> None:
        try:
            stamp_ns, points = read_frame(message, self._frame_id(), self._node.count)
            _keep(self._frames, stamp_ns, readings_of(points))
        except AnserError as error:
            self._refuse('tool_fluxes_refused', error)

    def _on_pose(self, body: str, message: PoseStamped) -> None:
        try:
            pose = pose_in(message, self._frame_id(), body)
            stamp_ns = stamp_of(message)
            _keep(self._poses, stamp_ns, {**self._poses.get(stamp_ns, {}), body: pose})
        except AnserError as error:
            self._refuse('tool_poses_refused', error)


def _keep(kept: dict[int, Any], stamp_ns: int, what: Any) -> None:
    """Keep something under its stamp, and the newest few of what is there."""
    kept[stamp_ns] = what
    while len(kept) > MOST_FRAMES:
        kept.pop(next(iter(kept)), None)
