"""Writes frames of somebody else's measurement as an MCAP session that any command reads."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from anser_ros.wire.bag_writer import SessionWriter
from anser_ros.wire.points import FluxPoints, encode_flux
from anser_ros.wire.pose_topics import optical_topic
from anser_ros.wire.setup import SensorSpec, Setup, Vector, dump_setup

Array = NDArray[np.float64]


def vector(values: Array) -> Vector:
    """Return three plain numbers, as a setup document has them."""
    return (float(values[0]), float(values[1]), float(values[2]))


def write_frames(
    path: Path,
    setup: Setup,
    stamp_ns: Sequence[int],
    flux: NDArray[np.complex128],
    poses: Mapping[str, tuple[Array, Array]] | None = None,
) -> None:
    """Write one flux message of tools, one of references and the poses of the bodies a frame.

    Parameters
    ----------
    path : Path
        The ``.mcap`` file; it must not exist yet.
    setup : Setup
    stamp_ns : sequence of int, length F
    flux : ndarray, shape (F, S, K), complex
        T, sensors in the order of the setup.
    poses : mapping, optional
        Body to its positions (F, 3), m, and quaternions (F, 4), x y z w, frame fg.

    Raises
    ------
    BagError
        When the file exists already.
    """
    groups = [('tool', setup.tool_sensors), ('reference', setup.reference_sensors)]
    with SessionWriter(path) as writer:
        writer.write_setup(dump_setup(setup), int(stamp_ns[0]))
        for frame, stamp in enumerate(stamp_ns):
            for name, sensors in groups:
                if sensors:
                    rows = [row for row, s in enumerate(setup.sensors) if s in sensors]
                    cloud = _cloud(sensors, flux[frame, rows], fixed=name == 'reference')
                    fields, step, data = encode_flux(cloud)
                    topic = f'/anser/{name}/flux'
                    writer.write_flux(topic, int(stamp), fields, step, len(rows), data)
            for body, (position, quaternion) in (poses or {}).items():
                writer.write_pose(
                    optical_topic(body),
                    int(stamp),
                    position[frame].tolist(),
                    quaternion[frame].tolist(),
                )


def _cloud(
    sensors: Sequence[SensorSpec], flux: NDArray[np.complex128], *, fixed: bool
) -> FluxPoints:
    position = np.array([s.position_m for s in sensors])
    axis = np.array([s.axis for s in sensors])
    nothing = np.full(position.shape, np.nan)
    return FluxPoints(
        channel=np.array([s.channel for s in sensors], dtype=np.int64),
        flags=np.zeros(len(sensors), dtype=np.int64),
        flux=np.asarray(flux, dtype=np.complex128),
        position=position if fixed else nothing,
        axis=axis if fixed else nothing,
    )
