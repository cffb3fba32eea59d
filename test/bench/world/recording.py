"""Writes a laboratory's recordings as bags in the layout of docs/interfaces.md.

Of `anser_ros` only the writer of bags and the byte layout of the clouds are used.
"""

import numpy as np
import yaml
from laboratory import (
    FLUX_NOISE_T,
    OPTICAL_JITTER_M,
    OPTICAL_JITTER_RAD,
    STATIC_NOISE_T,
    measured,
    read_fluxes,
)
from motions import Wander, raster
from scipy.spatial.transform import Rotation, Slerp

from anser_ros.wire.bag_writer import SessionWriter
from anser_ros.wire.points import FluxPoints, encode_flux

FLUX_HZ, OPTICAL_HZ, LENGTH_S = 25.0, 60.0, 40.0
SECOND_NS = 1_000_000_000
START_NS = 1_760_000_000 * SECOND_NS
TRUE_STEP_S = 1 / 240


def _reported(position, rotation, rng):
    """Poses as an optical tracker reports them: (P, 3) and quaternions (P, 4)."""
    seen = position + OPTICAL_JITTER_M * rng.normal(size=position.shape)
    turn = Rotation.from_rotvec(OPTICAL_JITTER_RAD * rng.normal(size=position.shape))
    return seen, (turn * Rotation.from_matrix(rotation)).as_quat()


def _stamps(time):
    return START_NS + SECOND_NS + np.round(np.asarray(time) * SECOND_NS).astype(np.int64)


def _cloud(sensors, moves, flux):
    blank = np.full_like(sensors.place, np.nan)
    points = FluxPoints(
        channel=np.asarray(sensors.channel), flags=np.zeros(len(sensors.channel), dtype=np.int64),
        flux=flux, position=blank if moves else sensors.place,
        axis=blank if moves else sensors.axis,
    )  # fmt: skip
    return encode_flux(points)


def _write(path, board, rate_hz, flux_stamps, fluxes, optical_stamps, poses):
    """One bag; every stream in the order of its stamps."""
    events = [(int(s), 0, i) for i, s in enumerate(optical_stamps)]
    events += [(int(s), 1, i) for i, s in enumerate(flux_stamps)]
    text = yaml.safe_dump(board.document(rate_hz), sort_keys=False)
    streams = (('tool', board.tool, True), ('reference', board.reference, False))
    with SessionWriter(path) as writer:
        writer.write_setup(text, START_NS)
        for stamp, kind, i in sorted(events):
            if kind == 0:
                writer.write_pose(
                    f'/optical/{board.tool.body}/pose', stamp, poses[0][i], poses[1][i]
                )
                continue
            for (name, sensors, moves), flux in zip(streams, fluxes, strict=True):
                fields, step, data = _cloud(sensors, moves, flux[i])
                count = len(sensors.channel)
                writer.write_flux(f'/anser/{name}/flux', stamp, fields, step, count, data)


def wander_over(board, rng):
    """A motion through the volume of a board's sessions."""
    low, high = board.heights_m
    return Wander.drawn(rng, [-0.125, -0.125, low], [0.125, 0.125, high])


def record_scan(path, lab, rng):
    """Write the factory's recording, the tool at rest at point after point."""
    position, rotation = raster(lab.board.scan, rng)
    time = np.arange(len(position), dtype=np.float64)
    fluxes = measured(lab, time, read_fluxes(lab, time, position, rotation), STATIC_NOISE_T, rng)
    stamps = _stamps(time)
    poses = _reported(position, rotation, rng)
    _write(path, lab.board, FLUX_HZ, stamps, fluxes, stamps, poses)


def _tracked(lab, wander, rng):
    """Optical stamps (s) and poses over the session, on the tracker's own clock."""
    fine = np.arange(-2.0, LENGTH_S + 2.0, TRUE_STEP_S)
    position, rotation = wander.at(fine)
    stamped = fine
    for change in lab.on_optical:
        stamped, position, rotation = change(stamped, position, rotation)
    time = np.arange(-0.2 + rng.uniform(0, 1 / OPTICAL_HZ), LENGTH_S + 0.2, 1 / OPTICAL_HZ)
    place = np.stack([np.interp(time, stamped, position[:, i]) for i in range(3)], axis=1)
    turn = Slerp(stamped, Rotation.from_matrix(rotation))(time).as_matrix()
    return time, place, turn


def record_session(path, lab, rng):
    """Write a session of 40 s in which the tool moves; return its true path.

    That is ``stamp_ns``, ``position``, ``rotation`` of the tool's body in fg at every flux stamp,
    and ``sensor_position`` (F, S, 3).
    """
    wander = wander_over(lab.board, rng)
    time = np.arange(0, LENGTH_S, 1 / FLUX_HZ)
    position, rotation = wander.at(time)
    fluxes = measured(lab, time, read_fluxes(lab, time, position, rotation), FLUX_NOISE_T, rng)
    optical, place, turn = _tracked(lab, wander, rng)
    stamps = _stamps(time)
    poses = _reported(place, turn, rng)
    _write(path, lab.board, FLUX_HZ, stamps, fluxes, _stamps(optical), poses)
    return {
        'stamp_ns': stamps,
        'position': position,
        'rotation': rotation,
        'sensor_position': position[:, None] + np.einsum('fij,sj->fsi', rotation, lab.tool.place),
    }
