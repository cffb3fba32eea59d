"""Compares what a tracker said with the truth."""

import csv

import numpy as np


def exact_errors(poses_csv, stamp_ns, places):
    """How far the poses with state ok are off true places (F, S, 3), of the sensors by name.

    Number of the sensor, stamp, error and sigma of the position of each, m; and of how many
    poses, ok or not.
    """
    with open(poses_csv, newline='', encoding='utf-8') as stream:
        rows = list(csv.DictReader(stream))
    ok = [row for row in rows if row['status'] == 'ok']
    _, numbers = np.unique([row['sensor'] for row in rows], return_inverse=True)
    numbers = numbers[[row['status'] == 'ok' for row in rows]]
    stamps = np.array([int(row['stamp_ns']) for row in ok], np.int64)
    found = np.array([[float(row[k]) for k in ('x_m', 'y_m', 'z_m')] for row in ok])
    true = places[np.searchsorted(stamp_ns, stamps), numbers]
    sigmas = np.array([float(row['sigma_position_m']) for row in ok])
    return numbers, stamps, np.linalg.norm(found.reshape(-1, 3) - true, axis=1), sigmas, len(rows)


def true_errors(poses_csv, path_npz):
    """Root mean square error, m, of every sensor's poses against the exact path.

    And the share of the poses that are further off than three of their own sigmas.
    """
    truth = np.load(path_npz)
    places = truth['sensor_position']
    _, _, errors, sigmas, _ = exact_errors(poses_csv, truth['stamp_ns'], places)
    return float(np.sqrt(np.mean(errors**2))), float(np.mean(errors > 3 * sigmas))
