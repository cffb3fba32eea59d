"""Describes how somebody else's data are tried: sessions made of them, commands, and figures."""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from anser_ros.arrays import Array, ComplexArray
from anser_ros.errors import FitError
from anser_ros.stamps import SECOND_NS
from anser_ros.wire.bag_writer import SessionWriter
from anser_ros.wire.recorded import optical_topic
from anser_ros.wire.setup import Setup, dump_setup
from anser_ros.wire.setup_values import Vector

SHARED = 'ANSER_SHARED'
"""Environment variable with the folder of other people's data and shared recordings."""


def shared_folder() -> Path:
    """Return the folder of shared data: as the environment says, or beside the repository."""
    beside = Path(__file__).resolve().parents[5] / 'shared'
    return Path(os.environ.get(SHARED, beside))


def existing(path: Path) -> Path:
    """Return a path; raises `FitError` when there is no such file."""
    if not path.is_file():
        raise FitError(f'no such file: {path}')
    return path


def vector(values: Array) -> Vector:
    """Return three plain numbers, as a setup document has them."""
    return (float(values[0]), float(values[1]), float(values[2]))


def write_frames(
    path: Path,
    setup: Setup,
    flux: ComplexArray,
    poses: Mapping[str, tuple[Array, Array]] | None = None,
    stamp_ns: Sequence[int] | None = None,
) -> None:
    """Write a session of F frames: fluxes (F, S, K), T, in the setup's order, and poses of bodies.

    ``poses``: positions (F, 3), m, and quaternions (F, 4), x y z w, frame fg. ``stamp_ns`` (F,):
    one a second by default. Raises `BagError` when the file exists already.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    stamps = [SECOND_NS * (1 + k) for k in range(len(flux))] if stamp_ns is None else stamp_ns
    with SessionWriter(path) as writer:
        writer.write_setup(dump_setup(setup), stamps[0])
        for frame, stamp in enumerate(stamps):
            writer.write_readings(setup.sensors, stamp, flux[frame])
            for body, (position, quaternion) in (poses or {}).items():
                place, turn = position[frame].tolist(), quaternion[frame].tolist()
                writer.write_pose(optical_topic(body), stamp, place, turn)


@dataclass(frozen=True)
class ReportRow:
    """Holds one line of the table that `anser measured` prints."""

    dataset: str  # folder of the measurement
    figure: str  # what is measured, in words
    before: float  # the figure without the effects that were found; nan where there is none
    after: float  # the figure with them
    unit: str  # of `before`, `after` and `target`
    chosen_on: str  # what the effects were chosen and fitted on, and the figure was scored on
    target: float | None = None  # what `after` should not exceed
    met: bool | None = None  # whether it does; None without a target
    # `after` of code for this data set alone, where a recipe has taken its place: docs/results
    special: float | None = None


@dataclass(frozen=True)
class Recipe:
    """States what `anser measured` does with a data set."""

    name: str  # as `anser measured` calls the data set
    # from the folder of the data and that of the bags to the bags written there
    write_sessions: Callable[[Path, Path], list[Path]]
    # from the bags and the folder for results to the command lines, in their order: verb and
    # arguments of `anser`, as anybody would type them
    commands: Callable[[list[Path], Path], list[list[str]]]
    # from the folder of the data, the bags and the folder for results to the figures, read from
    # what the commands wrote
    rows: Callable[[Path, list[Path], Path], list[ReportRow]]
    folder: str = ''  # of the data, below ``measured/``; the name, unless another is given

    def data(self, shared: Path) -> Path:
        """Return the folder of the data in the one that contains ``measured/``."""
        return shared / 'measured' / (self.folder or self.name)


def calibrations(bags: list[Path], out: Path, found: Sequence[str] = ()) -> list[list[str]]:
    """Return the commands that calibrate the first session with sensors as stated, and as found.

    Their models and reports are ``plain`` and ``full``; ``found`` are the options of the second.
    """
    return [
        [
            'calibrate', str(bags[0]), *options, '--out', str(out / f'{kind}.yaml'),
            '--report', str(out / kind),
        ]
        for kind, options in (('plain', ('--estimate', 'none')), ('full', found))
    ]  # fmt: skip


def ran(folder: Path, name: str) -> dict[str, Any]:
    """Return the JSON document of this name that a command wrote into its folder."""
    document: dict[str, Any] = json.loads((folder / name).read_text(encoding='utf-8'))
    return document


def figure(document: dict[str, Any], *keys: str) -> float:
    """Return a number of a document by its keys; nan where it is null or not there."""
    value: Any = document
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    return float('nan') if value is None else float(value)
