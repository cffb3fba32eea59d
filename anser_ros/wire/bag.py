"""Reads bags without ROS: raw messages for replay, and whole sessions as arrays.

A bag is a file in MCAP or sqlite3, or a folder of such files, with rosbag2's ``metadata.yaml`` or
without. What is lost of what the description counts is stated too.
"""

import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Channel, Schema
from mcap_ros2.decoder import DecoderFactory

from anser_ros.errors import BagError, LayoutError, SetupError
from anser_ros.stamps import JUMP_NS, stamp_of
from anser_ros.wire import recorded
from anser_ros.wire.bag_files import Salvage as Salvage
from anser_ros.wire.bag_files import files_of, messages_in, unpacked
from anser_ros.wire.cdr import DEFINITIONS, read_cloud
from anser_ros.wire.points import STALE, FluxPoints, decode_flux
from anser_ros.wire.setup import parse_setup
from anser_ros.wire.text_files import path_of

CDR = b'\0'
"""First byte of every message in CDR."""


class RawMessage(NamedTuple):
    """Holds one message as it lies in the bag: serialised (CDR), with its schema for decoding."""

    topic: str
    type_name: str
    log_time_ns: int
    data: bytes
    channel: Channel
    schema: Schema

    @property
    def definition(self) -> str:
        """Return the text of its type and of all types in it; empty where it is not known."""
        text = self.schema.data.decode('utf-8', 'replace').strip()
        return text if self.schema.encoding == 'ros2msg' and text != self.type_name else ''


def iter_messages(path: str | os.PathLike[str], salvage: Salvage) -> Iterator[RawMessage]:
    """Yield the messages of a bag, one file after the other, each by ascending log time.

    What could not be read is filled into ``salvage``. Raises `BagError` when there is no such
    bag, or no message of it can be read.
    """
    name, schemas = Path(path), dict[tuple[str, bytes], Schema]()
    files, counted = files_of(name, salvage)
    other, read = Counter[str](), 0
    for file in files:
        try:
            with ExitStack() as stack:
                for schema, channel, time, data in messages_in(file, stack, salvage):
                    read += 1
                    kind, form = '' if schema is None else schema.name, channel.message_encoding
                    salvage.topics.setdefault(channel.topic, kind or form)
                    data = unpacked(data) if form == 'cdr' else data
                    if schema is None or form != 'cdr' or data[:1] != CDR:
                        words = (form or 'unknown').upper() if form != 'cdr' else 'of another form'
                        other[f'messages of {channel.topic} are {words}, not CDR'] += 1
                        continue
                    if (kind, schema.data) not in schemas:
                        schemas[kind, schema.data] = _known(schema, len(schemas))
                    known = schemas[kind, schema.data]
                    yield RawMessage(channel.topic, known.name, time, data, channel, known)
        except BagError as error:
            if len(files) == 1:
                raise
            salvage.add(str(error))
    for words, count in other.items():
        salvage.add(f'{count} {words}')
    if read < counted:
        salvage.add(f'{read} of the {counted} messages that metadata.yaml counts are there')
    if read == other.total():
        raise BagError(f'{name}: no message can be read ({salvage.lost or "empty bag"})')


def _known(schema: Schema, number: int) -> Schema:
    """A type with our definition of it, where the package has one; bags lack or garble theirs."""
    name = schema.name if '/msg/' in schema.name else schema.name.replace('/', '/msg/')
    text = DEFINITIONS.get(name)
    data, form = (text.encode(), 'ros2msg') if text else (schema.data, schema.encoding)
    return Schema(id=number + 1, name=name, data=data, encoding=form)


class MessageDecoder(DecoderFactory):  # type: ignore[misc]
    """Turns raw messages into objects with the message's attributes, without ROS."""

    def decode(self, message: RawMessage) -> Any:
        """Decode one message; raises `BagError` when its bytes don't fit its schema."""
        if not message.definition:
            raise BagError(
                f'{message.topic}: neither the bag nor this package defines {message.type_name}'
            )
        try:
            decoder = self.decoder_for(message.channel.message_encoding, message.schema)
            if decoder is not None:
                return decoder(message.data)
        except Exception as error:  # the decoder's errors have no root of their own
            raise BagError(
                f'{message.topic}: {message.type_name} does not decode: {error}'
            ) from error
        raise BagError(f'{message.topic}: no decoder for {message.type_name}')


class _Collector:
    """Gathers what a session needs from the messages of a bag."""

    def __init__(self) -> None:
        self.decoder = MessageDecoder()
        self.setups: list[str] = []
        self.flux: dict[str, list[tuple[int, FluxPoints]]] = {'tool': [], 'reference': []}
        self.poses: dict[str, list[tuple[int, tuple[float, ...]]]] = {}
        self.refused: Counter[str] = Counter()

    def add(self, raw: RawMessage) -> None:
        try:
            if raw.topic.endswith('/setup') and raw.type_name == recorded.SETUP_TYPE:
                self.setups.append(str(self.decoder.decode(raw).data))
            elif raw.topic.endswith(('/tool/flux', '/reference/flux')):
                self._add_flux(raw)
            elif recorded.optical_stem(raw.topic) and raw.type_name == recorded.POSE_TYPE:
                self._add_pose(raw)
        except (BagError, LayoutError, AttributeError, TypeError, ValueError) as error:
            self.refused[f'{raw.topic}: {error}'] += 1

    def _add_flux(self, raw: RawMessage) -> None:
        if raw.type_name != recorded.FLUX_TYPE:
            raise LayoutError(f'type {raw.type_name} where {recorded.FLUX_TYPE} belongs')
        cloud = read_cloud(raw.data)
        width = cloud.width * cloud.height
        points = decode_flux(cloud.fields, cloud.point_step, width, cloud.data, cloud.is_bigendian)
        stamp = stamp_of(cloud)
        if stamp == 0:
            raise LayoutError('stamp zero')
        self.flux[raw.topic.split('/')[-2]].append((stamp, points))

    def _add_pose(self, raw: RawMessage) -> None:
        message = self.decoder.decode(raw)
        numbers = recorded.pose_numbers(message.pose)
        values = (*numbers[:3], *recorded.unit_quaternions(numbers[3:]).tolist())
        if not np.isfinite(values).all():
            raise LayoutError('a pose with values not finite or a quaternion not of unit length')
        body = recorded.optical_stem(raw.topic)
        self.poses.setdefault(body, []).append((stamp_of(message), values))

    def flux_stream(self, which: str) -> recorded.RecordedFluxes | None:
        frames: dict[int, FluxPoints] = {}
        n_emitters = Counter(points.flux.shape[1] for _, points in self.flux[which])
        last = 0
        for stamp, points in self.flux[which]:
            if stamp < last:
                self.refused[f'{which}/flux: stamped before the one ahead of it, and sorted'] += 1
            last = stamp
            if points.flux.shape[1] != n_emitters.most_common(1)[0][0]:
                self.refused[f'{which}/flux: another number of emitters'] += 1
            elif stamp in frames:
                self.refused[f'{which}/flux: the same stamp twice'] += 1
            else:
                frames[stamp] = points
        if not frames:
            return None
        channels = np.unique(np.concatenate([points.channel for points in frames.values()]))
        stamps = np.array(sorted(frames), dtype=np.int64)
        shape = (stamps.size, channels.size)
        flux = np.full((*shape, n_emitters.most_common(1)[0][0]), np.nan, dtype=np.complex128)
        flags = np.full(shape, STALE, dtype=np.int64)
        for f, stamp in enumerate(stamps.tolist()):
            points = frames[stamp]
            rows = np.searchsorted(channels, points.channel)
            flux[f, rows], flags[f, rows] = points.flux, points.flags
        return recorded.RecordedFluxes(stamps, channels, flags, flux)

    def pose_streams(self) -> dict[str, recorded.PoseStream]:
        streams = {}
        for body, rows in self.poses.items():
            unique = dict(rows)
            stamps = np.array(sorted(unique), dtype=np.int64)
            values = np.array([unique[stamp] for stamp in stamps.tolist()])
            streams[body] = recorded.PoseStream(stamps, values[:, :3], values[:, 3:])
        return streams


def _rename_words(topics: Mapping[str, str]) -> str:
    """Return which topics of a bag may be fluxes under another name, and what renames them."""
    known = ('/tool/flux', '/reference/flux', '/field_model', '/field_model_error')
    others = [
        t for t, kind in topics.items() if kind == recorded.FLUX_TYPE and not t.endswith(known)
    ]
    if not others:
        return ''
    words = f'anser import BAG --remap {others[0]}:=/anser/tool/flux --out session.mcap'
    return f'; if {", ".join(others)} are fluxes: {words}'


def read_bag(path: str | os.PathLike[str]) -> recorded.Bag:
    """Read a recorded session; raises `BagError`, also without a setup or without fluxes."""
    salvage, collector = Salvage(), _Collector()
    for raw in iter_messages(path_of(path, 'a session'), salvage):
        collector.add(raw)
    if not collector.setups:
        raise BagError(f'{os.fspath(path)}: the bag has no setup; anser import --setup adds one')
    text = collector.setups[-1]  # acquisition adds rate and noise once its stream is there
    try:
        setup = parse_setup(text)
        if Path(path).is_dir() and not Path(path, 'metadata.yaml').is_file():
            _check_one_session(os.fspath(path), collector)
    except SetupError as error:
        raise BagError(f'{os.fspath(path)}: {error}') from error
    tool, reference = collector.flux_stream('tool'), collector.flux_stream('reference')
    if tool is None and reference is None:
        reasons = ''.join(f'; {text}' for text in list(collector.refused)[:1])
        reasons = reasons or _rename_words(salvage.topics)
        raise BagError(f'{os.fspath(path)}: the bag has no readable flux{reasons}')
    return recorded.Bag(
        os.fspath(path), setup, text, tool, reference, collector.pose_streams(),
        dict(collector.refused), salvage.lost,
    )  # fmt: skip


def _check_one_session(path: str, found: _Collector) -> None:
    """Refuse a folder of sessions of several boards, or with fluxes twice at the same time."""
    first, *others = (parse_setup(text) for text in dict.fromkeys(found.setups))
    is_one = all((s.emitter, s.sensors) == (first.emitter, first.sensors) for s in others)
    for fluxes in found.flux.values():
        stamps = np.array([stamp for stamp, _ in fluxes], dtype=np.int64)
        runs = np.split(stamps, np.flatnonzero(np.diff(stamps) < -JUMP_NS) + 1)
        spans = sorted((run.min(), run.max()) for run in runs if run.size)
        is_one &= all(before[1] <= after[0] for before, after in pairwise(spans))
    if not is_one:
        words = 'several sessions, of other boards or at the same time'
        raise BagError(f'{path}: {words}; read them one by one')


def read_fluxes(path: str | os.PathLike[str]) -> dict[str, recorded.RecordedFluxes]:
    """Return the fluxes of a bag that need not have a setup, by ``tool`` and ``reference``."""
    collector = _Collector()
    for raw in iter_messages(path, Salvage()):
        if raw.topic.endswith(('/tool/flux', '/reference/flux')):
            collector.add(raw)
    found = {which: collector.flux_stream(which) for which in ('tool', 'reference')}
    return {which: fluxes for which, fluxes in found.items() if fluxes is not None}


def published_poses(
    path: str | os.PathLike[str],
    topics: Sequence[str] | None = None,
    salvage: Salvage | None = None,
) -> dict[str, recorded.PoseStream]:
    """Return what each topic of poses of a bag carries, of some topics or of all.

    Of all, those of `geometry_msgs/PoseStamped` are meant, and where there are none, those of
    other types that hold poses. ``salvage`` takes what could not be read.
    """
    salvage, decoder, plain = salvage or Salvage(), MessageDecoder(), set[str]()
    unread: dict[str, list[BagError]] = {}
    rows: dict[str, list[tuple[int, int, tuple[float, ...]]]] = {t: [] for t in topics or ()}
    for raw in iter_messages(path, salvage):
        is_plain = raw.type_name == recorded.POSE_TYPE
        may_hold = raw.topic in rows or raw.type_name == recorded.POSE_TYPES[-1]
        if topics is None:
            may_hold = is_plain or not plain
        if raw.type_name not in recorded.POSE_TYPES or not may_hold:
            continue
        plain.update([raw.topic] if is_plain else [])
        try:
            poses = recorded.poses_in(raw.topic, decoder.decode(raw))
        except BagError as error:
            unread.setdefault(raw.topic, []).append(error)
            continue
        for topic, stamp, numbers in poses:
            if topics is None or topic in rows:
                rows.setdefault(topic, []).append((stamp, raw.log_time_ns, numbers))
    for topic, errors in unread.items():
        salvage.add(f'{len(errors)} messages of {topic} do not decode, and are left out')
        if not any(rows.values()):
            raise errors[0]
    found = {}
    for topic in [t for t in rows if topics is not None or not plain or t in plain]:
        table = np.array([numbers for *_, numbers in rows[topic]]).reshape(-1, 7)
        times = np.array([row[:2] for row in rows[topic]], dtype=np.int64).reshape(-1, 2)
        unset = times[:, 0] == 0
        if len(times) > 1 and unset.any():
            count = f'{unset.sum()} of {len(times)}'
            remedy = 'these poses are left out'
            if is_never := unset.all():
                count, remedy = f'all {len(times)}', 'the times of recording stand in'
            words = 'the driver does not set header.stamp'
            salvage.add(f'{count} stamps of {topic} are 0: {words}, and {remedy}')
            times, table = times[~unset | is_never, int(is_never) :], table[~unset | is_never]
        found[topic] = recorded.PoseStream(times[:, 0], table[:, :3], table[:, 3:])
    return found
