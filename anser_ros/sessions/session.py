"""Holds a recorded session as arrays, and its frames."""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from anser_ros.chain.frame import ChainFrame, FrameReadings
from anser_ros.errors import BagError
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel
from anser_ros.frames.intake import GOOD, reading_codes
from anser_ros.physics.pose_track import PoseTrack
from anser_ros.physics.sensor import SensorTable, Windings
from anser_ros.sessions.nominal_board import tracked_volume
from anser_ros.sessions.plausibility import plausible_tools, times_of_mounting
from anser_ros.stamps import NANO
from anser_ros.tracking.estimate import TrackerSettings
from anser_ros.wire.points import STALE
from anser_ros.wire.recorded import Bag, PoseStream, RecordedFluxes
from anser_ros.wire.setup import FIELD_GENERATOR, SensorRows, SensorSpec, Setup

MOST_NOISE_T = 1e-3
"""Noise, T, from which on a setup's statement is a mistake: emitters make microtesla at most."""
MOST_STAMP_SIGMA_S = 0.1
"""Error of the stamps, s, from which on a statement is a mistake; a hand moves 1 cm in it."""


@dataclass(frozen=True)
class Session:
    """Holds one recording as measurements of every body that moves, in the order of the setup.

    Time 0 of all is at ``start_ns``. The references are there where their fluxes were recorded;
    ``lost`` says in words what could not be read.
    """

    path: str
    setup: Setup
    start_ns: int
    tools: tuple[Measurements, ...]
    reference: Measurements | None
    lost: str = ''

    def __repr__(self) -> str:
        tools = (f'{tool.body}: {tool.time.size} frames' for tool in self.tools)
        return f'Session({self.path}, {", ".join(tools) or "no tools"})'

    @property
    def sensors(self) -> SensorTable:
        """Return all tool sensors, one body after the other."""
        return sensor_table(()).joined(*(tool.sensors for tool in self.tools))

    def with_stated(self, stated: Mapping[str, float]) -> 'Session':
        """Return the session with values stated before its setup's; raises `ParameterError`."""
        return replace(self, setup=self.setup.with_stated(stated))

    def mountings(self) -> 'tuple[Session, ...]':
        """Return the parts in which all was mounted alike, sessions of their own; or itself.

        How exactly a fixture holds a body, or the source, is of each mounting.
        """
        starts = sorted({time for tool in self.tools for time in times_of_mounting(tool)})
        ends = zip([-np.inf, *starts], [*starts, np.inf], strict=True)
        return tuple(self._between(*own) for own in ends) if starts else (self,)

    def _between(self, begin: float, end: float) -> 'Session':
        """The frames from a time to before another, s, under a name that says so."""
        name = f'{self.path} from {max(begin, 0.0):.4g} s on'

        def own(measured: Measurements) -> Measurements:
            return replace(measured.between(begin, end), session=name)

        reference = None if self.reference is None else own(self.reference)
        return replace(self, path=name, tools=tuple(map(own, self.tools)), reference=reference)


def sensor_table(specs: tuple[SensorSpec, ...]) -> SensorTable:
    """Return the specified sensors as a table, in the given order."""
    rows = SensorRows.of(specs)
    return SensorTable(
        channel=rows.channel,
        name=tuple(s.name for s in specs),
        body=tuple(s.body for s in specs),
        position=rows.position,
        axis=rows.axis,
        length=np.array([s.length_m for s in specs], dtype=np.float64),
        windings=Windings.of([s.windings for s in specs]),
    )


def _measured(setup: Setup, name: str) -> float:
    """What the acquisition wrote into the setup; NaN if nothing, and if a value was stated."""
    value: Any = setup.extra.get(name)
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return float(value) if is_number and name not in setup.stated else np.nan


def measured_noise(setup: Setup) -> float:
    """Return the noise of flux components that was measured, T; 0 if none, or if one is stated."""
    measured = _measured(setup, 'flux_noise_t')
    return measured if 0.0 < measured < MOST_NOISE_T else 0.0


def tracking_noise(setup: Setup, found_t: float = 0.0) -> float:
    """Return the noise that tracking starts from, T: what is stated, or was measured if larger.

    What a calibration found goes before what a document states, where nothing was measured since.
    """
    measured, stated = measured_noise(setup), setup.accuracy.flux_noise_t
    if found_t > 0.0 and measured == 0.0 and 'flux_noise_t' not in setup.said:
        return found_t
    return max(stated, measured)


def stamp_sigma(setup: Setup) -> float:
    """Return the error of the fluxes' stamps, s: stated, or else measured, or else the default."""
    measured = _measured(setup, 'stamp_sigma_s')
    return measured if 0.0 <= measured <= MOST_STAMP_SIGMA_S else setup.accuracy.stamp_sigma_s


def settings_for(
    setup: Setup, settings: TrackerSettings, model: FieldModel | None = None
) -> TrackerSettings:
    """Return settings with what the setup states or measured, and its volume if they have none.

    The noise is that which the model was calibrated with, unless it was measured or said since.
    """
    return replace(
        settings,
        flux_noise_t=tracking_noise(setup, 0.0 if model is None else model.noise_t),
        stamp_sigma_s=stamp_sigma(setup),
        tools=setup.refit.tools,
        volume=settings.volume or tracked_volume(setup),
    )


def _measurements(
    stream: RecordedFluxes,
    sensors: SensorTable,
    start: int,
    body: str,
    session: str,
    optical: PoseStream | None = None,
) -> Measurements:
    """Fluxes in the order of the sensor table, with the body's poses; the board does not move."""
    flux = np.full((stream.stamp_ns.size, len(sensors), stream.flux.shape[2]), np.nan, complex)
    flags = np.full(flux.shape[:2], STALE, dtype=np.int64)
    place = {int(channel): i for i, channel in enumerate(stream.channel)}
    for column, channel in enumerate(sensors.channel.tolist()):
        if channel in place:
            flux[:, column] = stream.flux[:, place[channel]]
            flags[:, column] = stream.flags[:, place[channel]]
    valid = reading_codes(flux, flags) == GOOD
    time = np.asarray((stream.stamp_ns - start) * NANO, dtype=np.float64)
    count, track = time.size, None
    if body == FIELD_GENERATOR:
        position, has_pose = np.zeros((count, 3)), np.ones(count, dtype=bool)
        rotation = np.broadcast_to(np.eye(3), (count, 3, 3))
    elif optical is not None:
        seen = (optical.stamp_ns - start) * NANO
        track = PoseTrack(seen.astype(np.float64), optical.position, optical.quaternion)
        position, rotation, has_pose = track.at(time)
    else:
        position, rotation = np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan)
        has_pose = np.zeros(count, dtype=bool)
    return Measurements(
        body, sensors, time, flux, valid, flags, position, rotation, has_pose, track, session
    )


def shifted(measurements: Measurements, seconds: float) -> Measurements:
    """Return measurements on a time axis that begins so much earlier."""
    track = measurements.track
    if track is not None:
        track = replace(track, time=track.time + seconds)
    return replace(measurements, time=measurements.time + seconds, track=track)


def session_of(bag: Bag) -> Session:
    """Turn a bag into arrays; raises `BagError` when it has other emitters than its setup."""
    streams = [stream for stream in (bag.tool, bag.reference) if stream is not None]
    n_emitters = len(bag.setup.emitter.coils)
    for stream in streams:
        if stream.flux.shape[2] != n_emitters:
            raise BagError(
                f'{bag.path}: the setup has {n_emitters} emitters, '
                f'the fluxes {stream.flux.shape[2]}'
            )
    start = min((int(s.stamp_ns[0]) for s in streams if s.stamp_ns.size), default=0)
    tools, reference = [], None
    table = sensor_table(bag.setup.tool_sensors)
    if bag.tool is not None:
        for body in bag.setup.bodies:
            sensors, poses = table.of_body(body), bag.optical.get(body)
            tools.append(_measurements(bag.tool, sensors, start, body, bag.path, poses))
    if bag.reference is not None and bag.setup.reference_sensors:
        sensors = sensor_table(bag.setup.reference_sensors)
        reference = _measurements(bag.reference, sensors, start, FIELD_GENERATOR, bag.path)
    return Session(bag.path, bag.setup, start, tuple(tools), reference, bag.lost)


def load_session(path: str | os.PathLike[str]) -> Session:
    """Read a bag as a session that is plausible.

    Poses of an optical tracker that stood still while the tool moved are left out; `Session.lost`
    reports this. Raises `BagError` when the bag can't be read; `PlausibilityError` when units,
    clocks or the order of quaternions contradict what was recorded.
    """
    # Nodes that read no bag run where the packages that read bags are not installed.
    from anser_ros.wire.bag import read_bag

    bag = read_bag(path)
    session = session_of(bag)
    tools, left_out = plausible_tools(bag.path, bag.setup, session.tools, bag.refused)
    return replace(session, tools=tools, lost='; '.join(filter(None, (session.lost, left_out))))


def empty_session(setup: Setup, path: str) -> Session:
    """Return a session of a setup with nothing recorded yet: all arrays have no frame."""
    streams: list[RecordedFluxes | None] = []
    for sensors in (setup.tool_sensors, setup.reference_sensors):
        channels, shape = SensorRows.of(sensors).channel, (0, len(sensors))
        stamps, flags = np.zeros(0, dtype=np.int64), np.zeros(shape, dtype=np.int64)
        flux = np.zeros((*shape, len(setup.emitter.coils)), dtype=complex)
        streams.append(RecordedFluxes(stamps, channels, flags, flux) if sensors else None)
    tool, reference = streams
    return session_of(Bag(path, setup, '', tool, reference, {}))


def frames_of(session: Session) -> Iterator[ChainFrame]:
    """Yield every stamp of a session in order, with what was measured under it."""
    rows: dict[float, tuple[list[tuple[Measurements, int]], list[int]]] = {}
    for tool in session.tools:
        for row, time in enumerate(tool.time.tolist()):
            rows.setdefault(time, ([], []))[0].append((tool, row))
    if session.reference is not None:
        for row, time in enumerate(session.reference.time.tolist()):
            rows.setdefault(time, ([], []))[1].append(row)
    for time in sorted(rows):
        tools, references = rows[time]
        reference = None
        if session.reference is not None and references:
            reference = _readings([(session.reference, references[0])])
        yield ChainFrame(
            session.start_ns + round(time / NANO), _readings(tools) if tools else None, reference
        )


def _readings(rows: list[tuple[Measurements, int]]) -> FrameReadings:
    return FrameReadings(
        np.concatenate([body.sensors.channel for body, _ in rows]),
        np.concatenate([body.flux[row] for body, row in rows]),
        np.concatenate([body.flags[row] for body, row in rows]),
    )
