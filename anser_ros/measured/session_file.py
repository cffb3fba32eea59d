"""Writes frames of somebody else's measurement as an MCAP session that any command reads."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from anser_ros.wire.pose_topics import optical_topic
from anser_ros.wire.session_writer import SessionWriter
from anser_ros.wire.setup import Setup, dump_setup
from anser_ros.wire.setup_values import Vector

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
    with SessionWriter(path) as writer:
        writer.write_setup(dump_setup(setup), int(stamp_ns[0]))
        for frame, stamp in enumerate(stamp_ns):
            writer.write_readings(setup.sensors, int(stamp), flux[frame])
            for body, (position, quaternion) in (poses or {}).items():
                writer.write_pose(
                    optical_topic(body),
                    int(stamp),
                    position[frame].tolist(),
                    quaternion[frame].tolist(),
                )
