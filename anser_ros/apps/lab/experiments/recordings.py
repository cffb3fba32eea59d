"""Finds the recordings of the article's experiments, and holds what the article reports of
each.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from anser_ros.errors import BagError
from anser_ros.sessions.session import Session, load_session

STATISTICS = ('RMSE', 'ME', 'PRC50', 'PRC95')
SENSORS = ('Y', 'Z')

Column = Mapping[str, Mapping[str, float]]
"""Figures by sensor and then by statistic."""


def _column(y: tuple[float, ...], z: tuple[float, ...]) -> Column:
    return {
        'Y': dict(zip(STATISTICS, y, strict=True)),
        'Z': dict(zip(STATISTICS, z, strict=True)),
    }


# Position errors of the article's new model without metal, mm.
TABLE_2_MM = {
    'Biot-Savart': _column((0.93, 0.76, 0.55, 2.04), (1.03, 0.93, 0.91, 1.69)),
    'data-driven': _column((0.28, 0.20, 0.13, 0.62), (0.23, 0.20, 0.18, 0.39)),
}
# Orientation errors of the same, degrees.
TABLE_2_DEG = {
    'Biot-Savart': _column((0.61, 0.45, 0.31, 1.43), (0.80, 0.71, 0.67, 1.32)),
    'data-driven': _column((0.23, 0.20, 0.17, 0.45), (0.21, 0.17, 0.15, 0.42)),
}
TABLE_3_FIELD = {
    'aluminium': {
        'training': {'MAE': 0.1377, 'N-MAE': 0.0085, 'RMSE': 0.1885, 'N-RMSE': 0.0116},
        'test': {'MAE': 0.2082, 'N-MAE': 0.0131, 'RMSE': 0.2854, 'N-RMSE': 0.0179},
    },
    'mu-metal': {
        'training': {'MAE': 0.7827, 'N-MAE': 0.0088, 'RMSE': 1.0817, 'N-RMSE': 0.0122},
        'test': {'MAE': 1.4106, 'N-MAE': 0.0160, 'RMSE': 1.8508, 'N-RMSE': 0.0210},
    },
}
"""Errors of the field over shields: mA/m, and percent of the range."""
# Position errors over the same shields, mm.
TABLE_3_MM = {
    'aluminium': _column((0.16, 0.11, 0.07, 0.32), (0.13, 0.11, 0.09, 0.27)),
    'mu-metal': _column((0.17, 0.12, 0.09, 0.36), (0.16, 0.14, 0.12, 0.29)),
}
# Position errors with the X-ray head below, without shield and with two of them, mm.
TABLE_4_MM = {
    'unshielded': _column((5.72, 5.28, 4.56, 9.39), (4.74, 4.37, 4.02, 7.82)),
    'aluminium': _column((0.31, 0.23, 0.16, 0.63), (0.46, 0.40, 0.36, 0.89)),
    'mu-metal': _column((0.23, 0.19, 0.16, 0.38), (0.51, 0.43, 0.33, 0.97)),
}
# Position errors between two measured planes over the X-ray head, mm.
TABLE_5_MM = {
    'uncompensated': _column((12.01, 11.71, 11.15, 17.22), (25.03, 22.87, 19.71, 46.21)),
    'compensated': _column((0.92, 0.89, 0.81, 1.33), (0.67, 0.65, 0.63, 0.94)),
    'compensated and corrected': _column((0.35, 0.34, 0.33, 0.51), (0.49, 0.47, 0.43, 0.73)),
}


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
    """Opens a folder with one bag for each of `NAMES`."""

    folder: Path  # the folder
    origin: str  # who simulated the recordings, for the report

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
