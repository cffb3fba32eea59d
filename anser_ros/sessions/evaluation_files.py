"""Writes the document and tables that an evaluation leaves."""

import csv
from collections.abc import Mapping, Sequence
from math import isfinite
from operator import itemgetter
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

from anser_ros.fingerprint import fingerprint_of
from anser_ros.pose_states import OK
from anser_ros.sessions.session import Session
from anser_ros.sessions.tracked_session import Evaluation, PoseSeries, metrics

SCHEMA = 'anser_evaluation/1'
"""Name of the document's layout, which stands in every such document."""


def recording_of(session: Session) -> str:
    """Return the fingerprint of what was recorded, whatever the file is called."""
    return fingerprint_of([tool.flux[:, :1] for tool in session.tools])


def to_document(evaluation: Evaluation) -> dict[str, Any]:
    """Return the figures of every sensor and body, and of a refit, as plain data."""
    document: dict[str, Any] = {'schema': SCHEMA}
    for kind, group in evaluation.groups.items():
        document[kind] = {name: metrics(series) for name, series in group.items()}
    if evaluation.refit is not None:
        document['refit'] = {
            'states': dict(evaluation.refit.states),
            'left_out': dict(evaluation.refit.left_out),
        }
    return document


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
    """Write the tables of poses, sensors' by stamp, and of errors into a folder; the files."""
    of_sensors = _pose_rows(evaluation.sensors, POSE_COLUMNS)
    tables = {
        POSES_FILE: (POSE_COLUMNS, sorted(of_sensors, key=itemgetter(0))),
        BODIES_FILE: (BODY_COLUMNS, _pose_rows(evaluation.bodies, BODY_COLUMNS)),
        ERRORS_FILE: (ERROR_COLUMNS, _error_rows(evaluation)),
        **{
            f'{kind}.csv': (POSE_COLUMNS, _pose_rows(group, POSE_COLUMNS))
            for kind, group in evaluation.further.items()
        },
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


def _pose_rows(group: Mapping[str, PoseSeries], columns: Sequence[str]) -> list[list[Any]]:
    """Rows with an axis, or, in the columns of bodies, a quaternion; empty cells for no pose."""
    of_body, rows = columns is BODY_COLUMNS, []
    for series in group.values():
        for pose in series.estimates:
            cells = [''] * (len(columns) - 3)
            if pose.state == OK and not (of_body and pose.rotation is None):
                turn = Rotation.from_matrix(pose.rotation).as_quat() if of_body else pose.axis
                values = [*pose.position, *turn, pose.sigma_position_m, pose.residual_t]
                cells = [f'{float(value):.9g}' for value in values]
            rows.append([pose.stamp_ns, series.name, *cells, pose.state])
    return rows
