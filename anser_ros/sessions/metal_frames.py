"""Takes metal from a recording with reference sensors, and learns it."""

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import BagError, FitError
from anser_ros.field.measurements import Measurements
from anser_ros.known_metal.fit import Report, learn_metal
from anser_ros.known_metal.known import KnownMetal
from anser_ros.known_metal.lattice import Coils
from anser_ros.known_metal.rows import CoilReadings, MetalFrame, real_parts
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit.live_refit import LiveRefit
from anser_ros.refit.tables import build_tables
from anser_ros.refit.tool_readings import FREE_M, FREE_RAD, ToolReading, coil_spread, linearised
from anser_ros.sessions.prepared import PreparedSession, correct
from anser_ros.sessions.volume import stated_volume
from anser_ros.settings import Accuracy, ToolSettings
from anser_ros.stamps import NANO

ComplexArray = NDArray[np.complex128]

FRAMES = 80
"""Frames that metal is learnt from, half of which only show what is left unexplained."""
SMOOTHED = 12
"""Frames before and after over which the refit's place of the metal is averaged, half a second."""
SAME_TIME_S = 1e-4
"""Difference of the stamps of references and tools in one frame, at most."""


def learn(
    prepared: PreparedSession, name: str, report: Report = lambda stage, share: None
) -> KnownMetal:
    """Learn the metal that moves in a session.

    The session must have references, a baseline without the metal, and a tool that an optical
    tracker follows. ``report`` is called with the stage and its share done.

    Raises
    ------
    BagError
        When the session lacks what is needed, or no rigid piece explains it.
    """
    session = prepared.session
    if session.reference is None or not len(session.reference.sensors):
        raise BagError(f'{session.path}: metal is learnt with reference sensors, there are none')
    if prepared.baseline is None:
        raise BagError('metal is learnt against --baseline, a recording without it')
    settings = session.setup.refit
    tables = build_tables(
        prepared.model, session.reference.sensors, settings, prepared.nominal.field,
        stated_volume(session.setup), report=lambda share: report('preparing', share),
    )  # fmt: skip
    refit = LiveRefit(
        prepared.model, session.reference.sensors, prepared.baseline.flux, settings, tables=tables
    )
    report('reading', 0.0)
    frames = metal_frames(prepared, refit, tables.excitation.phase, FRAMES)
    try:
        return learn_metal(
            frames, tables.excitation, prepared.model.frequencies_hz, prepared.volume,
            settings.accuracy.flux_noise_t, name, report,
        )  # fmt: skip
    except FitError as error:
        raise BagError(f'{session.path}: {error}') from error


def metal_frames(
    prepared: PreparedSession, refit: LiveRefit, phase: ComplexArray, count: int
) -> list[MetalFrame]:
    """Return at most ``count`` frames, spread evenly over those with metal.

    The session must have references, a baseline and optical poses of the tools; ``phase`` (K,) is
    that of the emitters' fields.

    Raises
    ------
    BagError
        When the session has no metal, or no tool with poses.
    """
    session = correct(prepared).session
    reference, baseline = session.reference, prepared.baseline
    assert reference is not None and baseline is not None
    places = np.full((len(reference.time), 3), np.nan)
    for row, time in enumerate(reference.time.tolist()):
        result = refit.update(
            session.start_ns + round(time / NANO), reference.sensors.channel,
            reference.flux[row], reference.flags[row],
        )  # fmt: skip
        if result.metal is not None:
            places[row] = result.metal.centroid
    there = np.flatnonzero(np.isfinite(places[:, 0]))
    if there.size < count:
        raise BagError(
            f'{session.path}: the references see metal in {there.size} frames, {count} are needed'
        )
    accuracy, tools = session.setup.refit.accuracy, session.setup.refit.tools
    noise = accuracy.flux_noise_t
    out = []
    for row in there[np.linspace(0, there.size - 1, count).astype(int)].tolist():
        change = (reference.flux[row] - baseline.flux) * phase.conj()
        good = np.isfinite(change).all(axis=1) & reference.valid[row]
        readings = [_of_references(reference.sensors.select(np.flatnonzero(good)), change[good])]
        for tool in session.tools:
            near = np.flatnonzero(np.abs(tool.time - reference.time[row]) < SAME_TIME_S)
            if near.size and tool.has_pose[near[0]] and tool.valid[near[0]].any():
                readings.append(
                    _of_tool(tool, int(near[0]), prepared, phase.conj() / noise, accuracy, tools)
                )
        around = places[max(row - SMOOTHED, 0) : row + SMOOTHED + 1]
        out.append(
            MetalFrame(float(reference.time[row]), tuple(readings), np.nanmean(around, axis=0))
        )
    if not any(len(frame.readings) > 1 for frame in out):
        raise BagError(f'{session.path}: no tool has optical poses while metal is there')
    return out


def _of_references(sensors: SensorTable, change: ComplexArray) -> CoilReadings:
    coils = Coils(sensors.position, sensors.axis, sensors.length)
    return CoilReadings(coils, change, np.zeros((2 * change.size, 0)))


def _of_tool(
    tool: Measurements,
    row: int,
    prepared: PreparedSession,
    turn: ComplexArray,
    accuracy: Accuracy,
    tools: ToolSettings,
) -> CoilReadings:
    used = np.flatnonzero(tool.valid[row])
    table = tool.sensors.select(used)
    reading = ToolReading(table, tool.flux[row, used], tool.position[row], tool.rotation[row])
    rows = linearised(reading, prepared.model, prepared.model.moments, turn)
    jitter = np.repeat([accuracy.optical_position_m, accuracy.optical_rotation_rad], 3)
    by_pose = rows.pose * jitter / np.repeat([FREE_M, FREE_RAD], 3)
    by_own = rows.own * coil_spread(len(used), tools)
    noise = accuracy.flux_noise_t
    shared = noise * real_parts(np.concatenate([by_pose, by_own], axis=1))
    change = noise * rows.left.reshape(len(used), -1)
    return CoilReadings(Coils(rows.at, rows.axes, table.length), change, shared)
