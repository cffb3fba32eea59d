"""Writes the tables of poses that an evaluation leaves, as `docs/interfaces.md` promises them."""

import csv
from collections.abc import Mapping
from math import isfinite
from operator import itemgetter
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

from anser_ros.pose_states import OK
from anser_ros.sessions.evaluation import Evaluation
from anser_ros.sessions.pose_errors import PoseSeries
from anser_ros.tracking.estimate import PoseEstimate

POSE_COLUMNS = (
    'stamp_ns', 'sensor', 'x_m', 'y_m', 'z_m', 'ax', 'ay', 'az', 'sigma_position_m', 'residual_t',
    'status',
)  # fmt: skip
"""Columns of the sensors' table; a coil's pose is its centre and its sensitive axis."""
BODY_COLUMNS = (
    'stamp_ns', 'body', 'x_m', 'y_m', 'z_m', 'qx', 'qy', 'qz', 'qw', 'sigma_position_m',
    'residual_t', 'status',
)  # fmt: skip
"""Columns of the bodies' table; the orientation is a quaternion."""
POSES_FILE, BODIES_FILE, ERRORS_FILE = 'poses.csv', 'bodies.csv', 'errors.csv'
ERROR_COLUMNS = ('stamp_ns', 'name', 'position_error_m', 'orientation_error_rad')
"""Columns of the table of errors, of coils and bodies."""


def write_tables(folder: Path, evaluation: Evaluation) -> list[Path]:
    """Write the tables of poses and of errors into a folder; the files.

    Sensors' poses, or why there is none, are sorted by stamp; those of bodies, and of what else
    was tracked, are one after the other.
    """
    tables = {
        POSES_FILE: (POSE_COLUMNS, sorted(_sensor_rows(evaluation.sensors), key=itemgetter(0))),
        BODIES_FILE: (BODY_COLUMNS, _body_rows(evaluation.bodies)),
        ERRORS_FILE: (ERROR_COLUMNS, _error_rows(evaluation)),
        **{f'{k}.csv': (POSE_COLUMNS, _sensor_rows(g)) for k, g in evaluation.further.items()},
    }
    for name, (columns, rows) in tables.items():
        with (folder / name).open('w', newline='', encoding='utf-8') as stream:
            writer = csv.writer(stream)
            writer.writerow(columns)
            writer.writerows(rows)
    return [folder / name for name in tables]


def _error_rows(evaluation: Evaluation) -> list[list[Any]]:
    """The error of every pose that has an optical one."""
    return [
        [estimate.stamp_ns, series.name, f'{place:.9g}', f'{turn:.9g}']
        for group in evaluation.groups.values()
        for series in group.values()
        for estimate, place, turn in zip(
            series.estimates, series.position_error.tolist(), series.orientation_error.tolist(),
            strict=True,
        )
        if isfinite(place)
    ]  # fmt: skip


def _sensor_rows(group: Mapping[str, PoseSeries]) -> list[list[Any]]:
    """Rows of what has a place and an axis."""
    return [
        _row(series, pose, [*pose.position, *pose.axis] if pose.state == OK else None, 6)
        for series in group.values()
        for pose in series.estimates
    ]


def _body_rows(group: Mapping[str, PoseSeries]) -> list[list[Any]]:
    rows = []
    for series in group.values():
        for pose in series.estimates:
            values = None
            if pose.state == OK and pose.rotation is not None:
                values = [*pose.position, *Rotation.from_matrix(pose.rotation).as_quat()]
            rows.append(_row(series, pose, values, 7))
    return rows


def _row(
    series: PoseSeries, pose: PoseEstimate, values: list[float] | None, count: int
) -> list[Any]:
    """One pose of so many numbers, its sigma and residual; empty cells where there is none."""
    cells = [''] * (count + 2)
    if values is not None:
        values = [*values, pose.sigma_position_m, pose.residual_t]
        cells = [f'{float(value):.9g}' for value in values]
    return [pose.stamp_ns, series.name, *cells, pose.state]
