"""Keeps the recordings that the experiments need, in a folder with one bag each."""

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from anser_ros.errors import BagError
from anser_ros.sessions.session import Session, load_session

HEAD_DISTANCES_CM = (30, 20, 10, 8, 6, 4, 2)
"""Distances of the X-ray head below the board, cm (article, Figs. 7 and 8)."""
MATERIALS = ('aluminium', 'mu-metal')
NAMES = (
    'factory_tool_a',
    'midplane_tool_b',
    *(f'shield_{m.replace("-", "_")}_tool_b' for m in MATERIALS),
    *(f'shield_{m.replace("-", "_")}_c_arm_tool_b' for m in MATERIALS),
    *(f'c_arm_{d:02d}cm_tool_b' for d in HEAD_DISTANCES_CM),
    'collimator_tool_a',
    'collimator_bottom_tool_b',
    'collimator_midplane_tool_b',
)


@dataclass(frozen=True)
class Recordings:
    """Opens a folder with one bag for each of `NAMES`.

    Attributes
    ----------
    folder : Path
        The folder.
    origin : str
        Who simulated the recordings, for the report.
    """

    folder: Path
    origin: str

    def load(self, name: str) -> Session:
        """Return the recording of a name; raises `BagError` when it cannot be read."""
        return load_session(self.folder / f'{name}.mcap')

    def shield(self, material: str, head: bool = False) -> Session:
        """Return the recording of tool B over a plate, with or without the X-ray head below."""
        middle = '_c_arm' if head else ''
        return self.load(f'shield_{material.replace("-", "_")}{middle}_tool_b')


def missing(folder: Path) -> list[str]:
    """Return the names of the recordings that a folder lacks."""
    return [name for name in NAMES if not (folder / f'{name}.mcap').is_file()]


def default_folder() -> Path:
    """Return the shared recordings' folder, in ``$ANSER_SHARED`` or beside the repository."""
    beside = Path(__file__).resolve().parents[2].parent / 'shared'
    return Path(os.environ.get('ANSER_SHARED', beside)) / 'sessions' / 'paper'


def given_recordings(folder: Path) -> Recordings:
    """Return the recordings of a folder that the user has named.

    Raises
    ------
    BagError
        When a recording is missing.
    """
    lacking = missing(folder)
    if lacking:
        raise BagError(
            f'{folder}: {len(lacking)} of {len(NAMES)} recordings are missing, '
            f'the first is {lacking[0]}.mcap'
        )
    return Recordings(folder, 'simulated by an independent field world')


def with_frames(session: Session, rows: np.ndarray) -> Session:
    """Return the session with some frames of its only tool."""
    return replace(session, tools=(session.tools[0].frames(rows),), reference=None)


def with_sensors(session: Session, names: list[str]) -> Session:
    """Return the session with some sensors of its only tool."""
    tool = session.tools[0]
    rows = np.array([i for i, name in enumerate(tool.sensors.name) if name in names])
    return replace(session, tools=(tool.sensors_only(rows),), reference=None)


def checkerboard(session: Session) -> tuple[Session, Session]:
    """Return training and test points of a lattice, as on a checkerboard (article, Fig. 2)."""
    tool = session.tools[0]
    where = tool.position[:, :2]
    side = max(round(np.sqrt(len(where))) - 1, 1)
    low, high = np.nanmin(where, axis=0), np.nanmax(where, axis=0)
    cell = np.rint((where - low) / np.maximum(high - low, 1e-9) * side)
    black = np.nansum(cell, axis=1).astype(np.int64) % 2 == 0
    return with_frames(session, black), with_frames(session, ~black)
