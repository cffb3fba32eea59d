"""Makes a session of somebody else's bag, and files that other programs read of a session."""

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import BagError, ParameterError
from anser_ros.stamps import SECOND_NS
from anser_ros.wire.bag import Salvage, iter_messages, published_poses, read_fluxes
from anser_ros.wire.bag_writer import SessionWriter
from anser_ros.wire.recorded import MOST_ALIKE, POSE_TYPES, SETUP_TYPE, PoseStream, RecordedFluxes
from anser_ros.wire.setup import parse_setup


@dataclass(frozen=True)
class ImportedBag:
    """Holds how many messages each topic got, and how many were left out, by topic and type.

    What is left out has no known definition; ``lost`` says in words what could not be read.
    """

    messages: dict[str, int]
    left_out: dict[str, int]
    lost: str


def parse_remaps(entries: Sequence[str]) -> dict[str, str]:
    """Return new names by old ones from entries ``FROM:=TO``; raises `ParameterError`."""
    names: dict[str, str] = {}
    for entry in entries:
        old, _, new = entry.partition(':=')
        if not old.startswith('/') or not new.startswith('/') or old in names:
            raise ParameterError(f'a new name must be /FROM:=/TO, each once, got {entry!r}')
        names[old] = new
    return names


def import_bag(
    path: str | os.PathLike[str],
    out: Path,
    remaps: Mapping[str, str] | None = None,
    setup_text: str | None = None,
) -> ImportedBag:
    """Write the messages of any ROS 2 bag as one MCAP file that every command reads.

    ``remaps`` are new names of topics; a setup document's text is written at the start, in place
    of any in the bag. Raises `BagError` when the bag cannot be read, has no message, or lacks a
    topic that is to be renamed; `SetupError` when the text is not a setup document.
    """
    if setup_text is not None:
        parse_setup(setup_text)
    names, salvage = dict(remaps or {}), Salvage()
    written: Counter[str] = Counter()
    left_out: Counter[str] = Counter()
    types: dict[str, str] = {}
    seen: set[str] = set()
    with SessionWriter(out) as writer:
        for message in iter_messages(path, salvage):
            if setup_text is not None and not seen:
                writer.write_setup(setup_text, message.log_time_ns)
            seen.add(message.topic)
            topic, type_name = names.get(message.topic, message.topic), message.type_name
            is_setup = topic.endswith('/setup') and type_name == SETUP_TYPE
            if is_setup and setup_text is not None:
                continue
            if types.setdefault(topic, type_name) != type_name:
                clash = f'{topic} would have {types[topic]} and {type_name}'
                raise BagError(f'{os.fspath(path)}: {clash}')
            if not message.definition:
                left_out[f'{message.topic} ({type_name})'] += 1
                continue
            channel = writer.channel(topic, type_name, message.definition)
            writer.write(channel, message.log_time_ns, message.data)
            written[topic] += 1
        missing = sorted(set(names) - seen)
        if missing or not written:
            what = f'no topic {", ".join(missing)}' if missing else 'no type is known'
            raise BagError(f'{os.fspath(path)}: {what}; there are: {salvage.topic_words()}')
    return ImportedBag(dict(written), dict(left_out), salvage.lost)


CSV, TUM, MAT = 'csv', 'tum', 'mat'
FORMATS = (CSV, TUM, MAT)
"""Forms of files; TUM, which `evo` reads, has poses only."""
POSE_COLUMNS = ('stamp_ns', 'x_m', 'y_m', 'z_m', 'qx', 'qy', 'qz', 'qw')


def export_bag(path: str | os.PathLike[str], out: Path, form: str) -> tuple[dict[str, int], str]:
    """Write a file for each topic of poses and of fluxes; raises `BagError` when there is none.

    Return how many rows each file got, by its name, and in words what could not be read.
    """
    if form not in FORMATS:
        raise ParameterError(f'format must be among {", ".join(FORMATS)}, got {form!r}')
    salvage, tables = Salvage(), dict[str, tuple[int, dict[str, NDArray[Any]]]]()
    found = published_poses(path, salvage=salvage)
    # Transforms of our own poses, and these with their covariance, are there besides.
    known = *found, '/tf'
    held = (t for t, kind in salvage.topics.items() if kind in POSE_TYPES)
    if rest := [topic for topic in held if not topic.startswith(known)]:
        salvage.add(f'{", ".join(rest)} left out, as there are PoseStamped')
    for topic, poses in sorted(found.items()):
        stem = topic.strip('/').removeprefix('anser/').removesuffix('/pose').replace('/', '_')
        tables[stem] = poses.stamp_ns.size, _pose_columns(poses, form)
        if poses.stamp_ns.size > MOST_ALIKE * len(np.unique(poses.stamp_ns)):
            salvage.add(
                f'several poses of {topic} have each stamp: cut to seconds, or played again?'
            )
    for which, fluxes in read_fluxes(path).items() if form != TUM else ():
        tables[f'{which}_flux'] = fluxes.stamp_ns.size, _flux_columns(fluxes, form)
    if not tables:
        words = f'nothing to export as {form}; there are: {salvage.topic_words()}'
        raise BagError(f'{os.fspath(path)}: {words}')
    names = {stem: f'{stem}.{"txt" if form == TUM else form}' for stem in tables}
    for stem, (_, columns) in tables.items():
        _write(out / names[stem], columns, form)
    return {names[stem]: int(count) for stem, (count, _) in tables.items()}, salvage.lost


def _pose_columns(poses: PoseStream, form: str) -> dict[str, NDArray[Any]]:
    """Stamps, in TUM s, positions, m, and quaternions."""
    stamps, places, turns = poses.stamp_ns, poses.position, poses.quaternion
    if form == MAT:
        return {'stamp_ns': stamps, 'position_m': places, 'quaternion_xyzw': turns}
    if form == TUM:
        parts = zip(*divmod(stamps, SECOND_NS), strict=True)
        stamps = np.array([f'{s}.{ns:09d}' for s, ns in parts])
    return dict(zip(POSE_COLUMNS, (stamps, *places.T, *turns.T), strict=True))


def _flux_columns(fluxes: RecordedFluxes, form: str) -> dict[str, NDArray[Any]]:
    """Stamps, channels, flags and phasors, T: of tables a row for each channel of a frame."""
    stamps, channel, flux = fluxes.stamp_ns, fluxes.channel, fluxes.flux
    if form == MAT:
        return {'stamp_ns': stamps, 'channel': channel, 'flags': fluxes.flags, 'flux_t': flux}
    frames, channels, coils = flux.shape
    parts = np.ascontiguousarray(flux).view(np.float64).reshape(-1, 2 * coils)
    names = [f'coil{k}_{part}_t' for k in range(coils) for part in ('re', 'im')]
    columns = {'stamp_ns': stamps.repeat(channels), 'channel': np.tile(channel, frames)}
    return {**columns, 'flags': fluxes.flags.ravel(), **dict(zip(names, parts.T, strict=True))}


def _write(path: Path, columns: Mapping[str, NDArray[Any]], form: str) -> None:
    """A file of MATLAB, a table with commas and a header, or one of TUM with neither."""
    if form == MAT:
        from scipy.io import savemat

        savemat(path, dict(columns), do_compression=True, oned_as='column')
        return
    import pandas  # late: it takes half a second

    layout = {'sep': ' ', 'header': False} if form == TUM else {'lineterminator': '\r\n'}
    frame = pandas.DataFrame(dict(columns))
    frame.to_csv(path, index=False, float_format='%.9g', na_rep='nan', **layout)
