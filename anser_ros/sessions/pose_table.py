"""Writes the tables of poses that an evaluation leaves, as `docs/interfaces.md` promises them."""

import csv
from math import isfinite
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

from anser_ros.pose_states import OK
from anser_ros.sessions.evaluation import Evaluation
from anser_ros.sessions.pose_errors import PoseSeries

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
SOURCES_FILE = 'sources.csv'
ERROR_COLUMNS = ('stamp_ns', 'name', 'position_error_m', 'orientation_error_rad')
"""Columns of the table of errors, of coils and bodies."""


def write_poses(path: Path, evaluation: Evaluation) -> None:
    """Write every sensor's pose, or why there is none, by stamp."""
    rows = [row for series in evaluation.sensors.values() for row in _sensor_rows(series)]
    rows.sort(key=lambda row: row[0])
    _write(path, POSE_COLUMNS, rows)


def write_body_poses(path: Path, evaluation: Evaluation) -> None:
    """Write every rigid tool's 6-DoF pose, or why there is none, one tool after the other."""
    rows = [row for series in evaluation.bodies.values() for row in _body_rows(series)]
    _write(path, BODY_COLUMNS, rows)


def write_sources(path: Path, evaluation: Evaluation) -> None:
    """Write where each body saw the source, in the body's frame, or why it did not."""
    rows = [row for series in evaluation.sources.values() for row in _sensor_rows(series)]
    _write(path, POSE_COLUMNS, rows)


def write_errors(path: Path, evaluation: Evaluation) -> None:
    """Write the error of every pose that has an optical one, of coils, bodies and sources."""
    rows = [
        [estimate.stamp_ns, series.name, f'{place:.9g}', f'{turn:.9g}']
        for series in (
            *evaluation.sensors.values(),
            *evaluation.bodies.values(),
            *evaluation.sources.values(),
        )
        for estimate, place, turn in zip(
            series.estimates, series.position_error.tolist(), series.orientation_error.tolist(),
            strict=True,
        )
        if isfinite(place)
    ]  # fmt: skip
    _write(path, ERROR_COLUMNS, rows)


def _write(path: Path, columns: tuple[str, ...], rows: list[list[Any]]) -> None:
    with path.open('w', newline='', encoding='utf-8') as stream:
        writer = csv.writer(stream)
        writer.writerow(columns)
        writer.writerows(rows)


def _sensor_rows(series: PoseSeries) -> list[list[Any]]:
    rows = []
    for pose in series.estimates:
        head = [pose.stamp_ns, series.name]
        if pose.state == OK:
            values = [*pose.position, *pose.axis, pose.sigma_position_m, pose.residual_t]
            rows.append([*head, *(f'{float(v):.9g}' for v in values), OK])
        else:
            rows.append([*head, *[''] * 8, pose.state])
    return rows


def _body_rows(series: PoseSeries) -> list[list[Any]]:
    rows = []
    for pose in series.estimates:
        head = [pose.stamp_ns, series.name]
        if pose.state == OK and pose.rotation is not None:
            quaternion = Rotation.from_matrix(pose.rotation).as_quat()
            values = [*pose.position, *quaternion, pose.sigma_position_m, pose.residual_t]
            rows.append([*head, *(f'{float(v):.9g}' for v in values), OK])
        else:
            rows.append([*head, *[''] * 9, pose.state])
    return rows
