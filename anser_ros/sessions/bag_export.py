"""Writes poses and fluxes of a bag as files that other programs read: CSV, TUM, MATLAB."""

import csv
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import BagError, ParameterError
from anser_ros.sessions.recorded_poses import published_poses
from anser_ros.stamps import SECOND_NS
from anser_ros.wire.recorded import PoseStream, RecordedFluxes

CSV, TUM, MAT = 'csv', 'tum', 'mat'
FORMATS = (CSV, TUM, MAT)
"""Forms of files; TUM, which `evo` reads, has poses only."""
POSE_COLUMNS = ('stamp_ns', 'x_m', 'y_m', 'z_m', 'qx', 'qy', 'qz', 'qw')


@dataclass(frozen=True)
class ExportedBag:
    """Holds how many rows each file got, by its name, and in words what could not be read."""

    rows: dict[str, int]
    lost: str


def export_bag(path: str | os.PathLike[str], out: Path, form: str) -> ExportedBag:
    """Write a file for each topic of poses and of fluxes.

    Raises
    ------
    BagError
        When the bag cannot be read, or has neither.
    ParameterError
        When the form is unknown.
    """
    if form not in FORMATS:
        raise ParameterError(f'format must be among {", ".join(FORMATS)}, got {form!r}')
    # Nodes that read no bag run where the packages that read bags are not installed.
    from anser_ros.wire.bag import POSE_TYPE, Salvage, iter_messages, read_fluxes

    salvage = Salvage()
    topics = sorted({m.topic for m in iter_messages(path, salvage) if m.type_name == POSE_TYPE})
    written: dict[str, int] = {}
    for topic, poses in published_poses(path, topics).items():
        if poses.stamp_ns.size:
            name = f'{_file_name(topic)}.{"txt" if form == TUM else form}'
            stream = PoseStream(poses.stamp_ns, poses.position, poses.quaternion)
            _write_poses(out / name, stream, form)
            written[name] = int(poses.stamp_ns.size)
    if form != TUM:
        for which, fluxes in read_fluxes(path).items():
            name = f'{which}_flux.{form}'
            _write_fluxes(out / name, fluxes, form)
            written[name] = int(fluxes.stamp_ns.size)
    if not written:
        raise BagError(f'{os.fspath(path)}: nothing to export as {form}')
    return ExportedBag(written, salvage.lost)


def _file_name(topic: str) -> str:
    """A topic as the name of a file."""
    return topic.strip('/').removeprefix('anser/').removesuffix('/pose').replace('/', '_')


def _write_poses(path: Path, poses: PoseStream, form: str) -> None:
    if form == MAT:
        _write_mat(
            path,
            {
                'stamp_ns': poses.stamp_ns,
                'position_m': poses.position,
                'quaternion_xyzw': poses.quaternion,
            },
        )
        return
    rows = np.column_stack([poses.position, poses.quaternion]).tolist()
    with path.open('w', encoding='utf-8', newline='') as stream:
        if form == TUM:
            for stamp, row in zip(poses.stamp_ns.tolist(), rows, strict=True):
                words = ' '.join(f'{value:.9g}' for value in row)
                stream.write(f'{stamp // SECOND_NS}.{stamp % SECOND_NS:09d} {words}\n')
            return
        writer = csv.writer(stream)
        writer.writerow(POSE_COLUMNS)
        for stamp, row in zip(poses.stamp_ns.tolist(), rows, strict=True):
            writer.writerow([stamp, *(f'{value:.9g}' for value in row)])


def _write_fluxes(path: Path, fluxes: RecordedFluxes, form: str) -> None:
    if form == MAT:
        _write_mat(
            path,
            {
                'stamp_ns': fluxes.stamp_ns,
                'channel': fluxes.channel,
                'flags': fluxes.flags,
                'flux_t': fluxes.flux,
            },
        )
        return
    with path.open('w', encoding='utf-8', newline='') as stream:
        writer = csv.writer(stream)
        parts = [f'coil{k}_{part}_t' for k in range(fluxes.flux.shape[2]) for part in ('re', 'im')]
        writer.writerow(['stamp_ns', 'channel', 'flags', *parts])
        writer.writerows(_flux_rows(fluxes))


def _flux_rows(fluxes: RecordedFluxes) -> Iterator[list[object]]:
    for stamp, flags, frame in zip(
        fluxes.stamp_ns.tolist(), fluxes.flags.tolist(), fluxes.flux, strict=True
    ):
        for channel, flag, values in zip(fluxes.channel.tolist(), flags, frame, strict=True):
            parts = np.ascontiguousarray(values).view(np.float64).tolist()
            yield [stamp, channel, flag, *(f'{value:.9g}' for value in parts)]


def _write_mat(path: Path, arrays: dict[str, NDArray[np.generic]]) -> None:
    from scipy.io import savemat

    savemat(path, arrays, do_compression=True, oned_as='column')
