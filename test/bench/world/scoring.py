"""Compares what a diagnosis found, and what a tracker said, with the truth."""

import csv

import numpy as np
from unlisted import ACCEPTED

TOLERANCE = {
    'sensor_gain': 1e-3, 'time_offset': 0.5e-3, 'lever_arm': 0.1e-3, 'registration': 0.1e-3,
    'coil_drift': 1e-3, 'static_metal': 15e-3, 'conductive_plate': 10e-3, 'saturation': 0.1,
    'sensor_axis': 0.1, 'channel_crosstalk': 2e-3, 'coil_crosstalk': 1e-3, 'coil_moved': 0.1e-3,
    'pickup': 0.1, 'phase_delay': 1e-8, 'moving_metal': 40e-3, 'excess_noise': 0.1,
    'outliers': 0.01, 'sensor_size': 1e-3, 'clock_rate': 20.0, 'coil_step': 2e-3,
}  # fmt: skip
"""Largest error of each effect's parameters: absolute, in the unit of `UNIT`."""
UNIT = {
    'sensor_gain': ('', 1), 'time_offset': ('ms', 1e3), 'lever_arm': ('mm', 1e3),
    'registration': ('mm at 0.2 m', 1e3), 'coil_drift': ('', 1), 'static_metal': ('mm', 1e3),
    'conductive_plate': ('mm', 1e3), 'saturation': ('of full scale', 1), 'sensor_axis': ('deg', 1),
    'channel_crosstalk': ('', 1), 'coil_crosstalk': ('', 1), 'coil_moved': ('mm', 1e3),
    'pickup': ('of rms', 1), 'phase_delay': ('us', 1e6), 'moving_metal': ('mm', 1e3),
    'excess_noise': ('of factor', 1), 'outliers': ('', 1), 'sensor_size': ('mm', 1e3),
    'clock_rate': ('ppm', 1), 'coil_step': ('', 1),
}  # fmt: skip
SAMPLES = np.linspace(0, 40, 201)


def _far(one, other):
    return float(np.linalg.norm(np.asarray(one, float) - np.asarray(other, float)))


def _rotated(rotation_deg, shift):
    """Where a frame's change brings eight points of the volume, (8, 3)."""
    from scipy.spatial.transform import Rotation

    corners = np.array([(x, y, z) for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (0.1, 0.2)])
    return Rotation.from_rotvec(np.radians(rotation_deg)).apply(corners) + shift


def _axis_error(true, found):
    if 'rotation_deg' in true:
        if 'rotation_deg' not in found or set(true['channels']) != set(found['channels']):
            return np.inf
        return _far(true['rotation_deg'], found['rotation_deg'])
    if found.get('channel') != true['channel']:
        return np.inf
    cosine = np.dot(true['axis'], found['axis']) / np.linalg.norm(found['axis'])
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def _curve(found):
    """Relative change of strength at `SAMPLES` by a found drift, or curve with knots."""
    if 'time_s' in found:
        return np.interp(SAMPLES, found['time_s'], found['change'])
    return found['amount'] * (1 - np.exp(-SAMPLES / found['tau_s']))


def _moving_error(true, found):
    """Mean distance of the two ways over the session; where the body goes gently in between."""

    def way(p):
        s = np.clip((SAMPLES - p['t_start_s']) / (p['t_end_s'] - p['t_start_s']), 0, 1)[:, None]
        s = s * s * (3 - 2 * s)
        return np.asarray(p['start_m']) * (1 - s) + np.asarray(p['end_m']) * s

    return float(np.mean(np.linalg.norm(way(true) - way(found), axis=1)))


def parameter_error(name, true, found):
    """Error of a found effect's main parameter in the units of `TOLERANCE`.

    Infinity where it was found in the wrong channel or coil, None where there is no measure.
    """
    for key in ('channel', 'coil'):
        if key in true and found.get(key) != true[key] and key in found:
            return np.inf
    measures = {
        'sensor_gain': lambda: abs(
            found['gain'] * np.exp(1j * np.radians(found['phase_deg']))
            - true['gain'] * np.exp(1j * np.radians(true['phase_deg']))
        ),
        'time_offset': lambda: abs(found['offset_s'] - true['offset_s']),
        'lever_arm': lambda: _far(found['offset_m'], true['offset_m']),
        'registration': lambda: np.linalg.norm(
            _rotated(found['rotation_deg'], found['translation_m'])
            - _rotated(true['rotation_deg'], true['translation_m']),
            axis=1,
        ).max(),
        'coil_drift': lambda: np.abs(_curve(found) - _curve(true)).max(),
        'static_metal': lambda: _far(found['position_m'], true['position_m']),
        'conductive_plate': lambda: abs(found['z_m'] - true['z_m']),
        'saturation': lambda: abs(found['full_scale_t'] / true['full_scale_t'] - 1),
        'sensor_axis': lambda: _axis_error(true, found),
        'cluster_axis': lambda: _axis_error(true, found),
        'channel_crosstalk': lambda: np.abs(np.subtract(found['matrix'], true['matrix'])).max(),
        'coil_crosstalk': lambda: (
            abs(found['eps'] - true['eps']) if found['coils'] == true['coils'] else np.inf
        ),
        'coil_moved': lambda: _far(found['shift_m'], true['shift_m']),
        'pickup': lambda: abs(found['rms_t'] / true['rms_t'] - 1),
        'phase_delay': lambda: abs(found['delay_s'] - true['delay_s']),
        'moving_metal': lambda: _moving_error(true, found),
        'excess_noise': lambda: abs(found['factor'] / true['factor'] - 1),
        'channel_noise': lambda: abs(found['factor'] / true['factor'] - 1),
        'outliers': lambda: abs(found['fraction'] - true['fraction']),
        'sensor_size': lambda: abs(found['length_m'] - true['length_m']),
        'clock_rate': lambda: abs(found['rate_ppm'] - true['rate_ppm']),
    }
    if name not in measures:
        return None
    try:
        return float(measures[name]())
    except (KeyError, TypeError, ValueError):
        return None


def judge_names(truth, found, unexplained):
    """Return ``right``, or what was ``missed`` and what is not there (``wrong``)."""
    names = [effect['name'] for effect in found]
    taken, missed = set(), []
    for name in truth:
        allowed = {name} | ACCEPTED.get(name, set())
        hits = [i for i, n in enumerate(names) if n in allowed and i not in taken]
        if hits:
            taken |= set(hits) if name == 'two_metals' else {hits[0]}
        elif name in ACCEPTED and unexplained['depends_on']:
            missed.append(f'{name} (said to be unexplained)')
        else:
            missed.append(name)
    wrong = [n for i, n in enumerate(names) if i not in taken]
    if not missed and not wrong:
        return 'right'
    words = [f'missed {", ".join(missed)}'] if missed else []
    return '; '.join(words + ([f'wrong {", ".join(wrong)}'] if wrong else []))


def describe(truth, found):
    """Parameter errors of all effects that were found under their name, as text."""
    words = []
    for name, true in truth.items():
        effect = next((e for e in found if e['name'] in {name} | ACCEPTED.get(name, set())), None)
        error = parameter_error(name, true, effect['parameters']) if effect else None
        if error is None:
            continue
        kind = {'cluster_axis': 'sensor_axis', 'channel_noise': 'excess_noise'}.get(name, name)
        unit, scale = UNIT[kind]
        mark = '' if error <= TOLERANCE[kind] else ' (!)'
        words.append(f'{scale * error:.3g} {unit}'.strip() + mark)
    return ', '.join(words)


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
    """Errors of every sensor's poses against the exact path, over all frames with a pose.

    ``tracked`` is their share, ``over_3_sigma`` that of poses further off than three of their own
    sigmas, and ``last_m`` the root mean square of the last 8 s.
    """
    truth = np.load(path_npz)
    _, stamps, errors, sigmas, count = exact_errors(
        poses_csv, truth['stamp_ns'], truth['sensor_position']
    )
    late = stamps > int(truth['stamp_ns'][-1]) - 8_000_000_000
    if not errors.size:
        return {'rmse_m': None, 'p95_m': None, 'tracked': 0.0, 'over_3_sigma': 0.0, 'last_m': None}
    return {
        'rmse_m': float(np.sqrt(np.mean(errors**2))),
        'p95_m': float(np.percentile(errors, 95)),
        'tracked': len(errors) / count,
        'over_3_sigma': float(np.mean(errors > 3 * sigmas)),
        'last_m': float(np.sqrt(np.mean(errors[late] ** 2))) if late.any() else None,
    }
