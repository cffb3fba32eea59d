"""Writes poses and fluxes of a bag as files that other programs read: CSV, TUM, MATLAB."""

import csv
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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
    """A table of stamps, positions, m, and quaternions."""
    numbers = np.column_stack([poses.position, poses.quaternion]).tolist()
    rows = zip(poses.stamp_ns.tolist(), numbers, strict=True)
    if form == MAT:
        parts = (poses.stamp_ns, poses.position, poses.quaternion)
        _write_mat(path, ('stamp_ns', 'position_m', 'quaternion_xyzw'), parts)
    elif form == TUM:
        with path.open('w', encoding='utf-8') as stream:
            for stamp, row in rows:
                words = ' '.join(f'{value:.9g}' for value in row)
                stream.write(f'{stamp // SECOND_NS}.{stamp % SECOND_NS:09d} {words}\n')
    else:
        _write_csv(path, POSE_COLUMNS, ([s, *(f'{v:.9g}' for v in row)] for s, row in rows))


def _write_fluxes(path: Path, fluxes: RecordedFluxes, form: str) -> None:
    """A table of stamps, channels, flags and phasors, T."""
    if form == MAT:
        parts = (fluxes.stamp_ns, fluxes.channel, fluxes.flags, fluxes.flux)
        _write_mat(path, ('stamp_ns', 'channel', 'flags', 'flux_t'), parts)
        return
    columns = [f'coil{k}_{part}_t' for k in range(fluxes.flux.shape[2]) for part in ('re', 'im')]
    _write_csv(path, ('stamp_ns', 'channel', 'flags', *columns), _flux_rows(fluxes))


def _write_csv(path: Path, columns: Sequence[str], rows: Iterable[list[object]]) -> None:
    with path.open('w', encoding='utf-8', newline='') as stream:
        writer = csv.writer(stream)
        writer.writerow(columns)
        writer.writerows(rows)


def _flux_rows(fluxes: RecordedFluxes) -> Iterator[list[object]]:
    for stamp, flags, frame in zip(
        fluxes.stamp_ns.tolist(), fluxes.flags.tolist(), fluxes.flux, strict=True
    ):
        for channel, flag, values in zip(fluxes.channel.tolist(), flags, frame, strict=True):
            parts = np.ascontiguousarray(values).view(np.float64).tolist()
            yield [stamp, channel, flag, *(f'{value:.9g}' for value in parts)]


def _write_mat(path: Path, names: Sequence[str], arrays: Sequence[NDArray[Any]]) -> None:
    from scipy.io import savemat

    content = dict(zip(names, arrays, strict=True))
    savemat(path, content, do_compression=True, oned_as='column')
