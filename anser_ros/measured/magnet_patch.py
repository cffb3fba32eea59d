"""A magnet before a patch of 16 sensors: what is learnt on one file, scored on the others.

A gain that was learnt may have changed by the time of the next file, and one file cannot say by
how much. The spread of the gains among the sensors is the natural size of such a change, so the
tracker carries it in the covariance of the readings: all three axes of a sensor scale together,
which leaves the direction of its field as good as the noise.

The data (github xpy-zju/Dual-stage-magnetic-localization, MIT) are read where they lie.
"""

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.errors import FitError
from anser_ros.measured import ReportRow
from anser_ros.measured.candidates import search_text
from anser_ros.measured.magnet_fit import Jitter, MagnetFit, fit, search
from anser_ros.measured.magnet_model import EFFECTS, Recording, Source, cylinder, point_source
from anser_ros.measured.magnet_step import StepAnalysis, analyse_step, step_rows, step_text
from anser_ros.measured.magnet_track import ReadingError, track

Array = NDArray[np.float64]

NAME = 'magnet_patch'

RADIUS_M, HALF_LENGTH_M = 5e-3, 5e-3
"""Radius and half length of the magnet, m."""
OPTICAL = Jitter(2e-4, 8e-3)
"""Jitter of the optical poses, m and rad."""
FIRST_NOISE_T = 3e-6
"""Noise of the readings from which the fit starts, T; it is then estimated."""
TARGET_MM, TARGET_DEG = 0.24, 0.55
"""Position and orientation errors that the analysis should reach, mm and degrees."""
SENSORS = 16
"""Sensors of the patch."""
CANDIDATES = (
    'sensor_gain',
    'channel_gain',
    'sensor_axis',
    'sensor_position',
    'channel_crosstalk',
    'pickup',
    'ambient',
    'saturation',
    'lever_arm',
    'source_axis',
    'registration',
    'moment_drift',
    'time_offset',
)


@dataclass(frozen=True)
class Lesson:
    """What one file taught, and how the others are tracked with it.

    Attributes
    ----------
    learnt_on : str
    fit : MagnetFit
    gain_error : float
        Assumed relative change of a gain between files: the spread of the gains found.
    errors : dict
        Tracked file and manner to (position RMSE mm, orientation RMSE deg).
    """

    learnt_on: str
    fit: MagnetFit
    gain_error: float
    errors: dict[tuple[str, str], tuple[float, float]]


@dataclass(frozen=True)
class MagnetAnalysis:
    """Every file in turn as the one to learn from, and the robot's file."""

    lessons: tuple[Lesson, ...]
    step: StepAnalysis | None


MANNERS = {
    'plain': 'unit gains, least squares',
    'weighted': 'unit gains, gain error in the covariance',
    'effects': 'effects, least squares',
    'full': 'effects, gain error in the covariance',
}


def read_table(path: Path) -> tuple[list[str], Array]:
    """Header and numbers of a CSV file; text columns become nan.

    Raises
    ------
    FitError
        When the file is missing or has no rows.
    """
    if not path.is_file():
        raise FitError(f'no such file: {path}')
    with path.open(newline='') as stream:
        header, *rows = list(csv.reader(stream))
    if not rows:
        raise FitError(f'{path.name} has no rows')

    def number(text: str) -> float:
        try:
            return float(text)
        except ValueError:
            return math.nan

    return header, np.array([[number(text) for text in row] for row in rows])


def read_poses(path: Path, magnet: str) -> tuple[dict[str, Array], int]:
    """Columns of a file of 16 sensors a pose, as (F, 16, 3) arrays; `magnet` is their prefix.

    Raises
    ------
    FitError
        When a column is missing, or the rows are not whole poses.
    """
    header, table = read_table(path)
    if len(table) % SENSORS:
        raise FitError(f'{path.name}: {len(table)} rows are not poses of {SENSORS} sensors')
    column = {name: k for k, name in enumerate(header)}
    groups = {
        'field': ('Bx', 'By', 'Bz'),
        'place': ('sensor_x', 'sensor_y', 'sensor_z'),
        'turn': ('sensor_ox', 'sensor_oy', 'sensor_oz'),
        'magnet': tuple(f'{magnet}_{c}' for c in ('x', 'y', 'z')),
        'magnet_turn': tuple(f'{magnet}_{c}' for c in ('ox', 'oy', 'oz')),
    }
    out: dict[str, Array] = {}
    for key, names in groups.items():
        lost = [name for name in names if name not in column]
        if lost:
            raise FitError(f'{path.name} lacks the columns {", ".join(lost)}')
        out[key] = table[:, [column[name] for name in names]].reshape(-1, SENSORS, 3)
    if 'timestamp' in column:
        out |= {'stamp': table[:, column['timestamp']].reshape(-1, SENSORS)}
    return out, len(table) // SENSORS


def as_recording(name: str, parts: dict[str, Array], background_t: Array) -> Recording:
    """SI units, matrices for rotation vectors, ambient field removed."""
    turn = Rotation.from_rotvec(parts['turn'].reshape(-1, 3)).as_matrix()
    frames = len(parts['field'])
    stamp = parts['stamp'].mean(axis=1) if 'stamp' in parts else np.arange(frames, dtype=float)
    return Recording(
        name=name,
        field_t=parts['field'] * 1e-6 - background_t,
        sensor_m=parts['place'] * 1e-3,
        sensor_rotation=turn.reshape(frames, SENSORS, 3, 3),
        magnet_m=parts['magnet'][:, 0] * 1e-3,
        magnet_rotation=Rotation.from_rotvec(parts['magnet_turn'][:, 0]).as_matrix(),
        stamp_s=stamp,
    )


def load(folder: Path, name: str) -> Recording:
    """One file of poses, its own background subtracted."""
    parts, _ = read_poses(folder / f'{name}.csv', 'm')
    background = read_table(folder / f'{name}_background_uT.csv')[1] * 1e-6
    if background.shape != (SENSORS, 3):
        raise FitError(f'{name}: background of shape {background.shape}, expected (16, 3)')
    return as_recording(name, parts, background)


def file_names(folder: Path) -> list[str]:
    """Names of the files of poses that are there."""
    names = sorted(path.stem for path in folder.glob('data*.csv') if not path.stem.endswith('_uT'))
    if len(names) < 2:
        raise FitError(f'{folder} must hold at least two files of poses, found {len(names)}')
    return names


def magnet() -> Source:
    """The cylinder of the data sheet."""
    return cylinder(RADIUS_M, HALF_LENGTH_M)


def learn(recording: Recording, names: tuple[str, ...] = CANDIDATES) -> MagnetFit:
    """Choose and fit effects on one recording alone.

    The noise comes first, from a fit of everything that a single sensor can have; with it the
    candidates are weighed on poses left out, and the chosen ones fitted to all poses.
    """
    source = magnet()
    rich = ('channel_gain', 'sensor_axis', 'sensor_position')
    noise = fit(recording, source, rich, FIRST_NOISE_T, OPTICAL).noise_t
    found = search(recording, source, names, noise, OPTICAL)
    result = fit(recording, source, found.chosen, noise, OPTICAL)
    return MagnetFit(
        result.source, result.moment, result.found, result.sigma, result.noise_t, found
    )


def gain_spread(model: MagnetFit) -> float:
    """Spread of the gains found, as far as they were resolved; how much gains may differ."""
    for name in ('sensor_gain', 'channel_gain'):
        if name in model.found:
            return float(np.std(model.found[name].mean(axis=1)))
    return 0.0


def plain(model: MagnetFit, recording: Recording) -> MagnetFit:
    """The same recording's strength, no effects."""
    return fit(recording, model.source, (), model.noise_t, OPTICAL)


def rmse(recording: Recording, model: MagnetFit, error: ReadingError) -> tuple[float, float]:
    """Position (mm) and orientation (deg) RMSE of a tracked recording."""
    offset, angle = track(recording, model, error).errors(recording)
    return (
        1e3 * float(np.sqrt(np.mean(offset**2))),
        math.degrees(float(np.sqrt(np.mean(angle**2)))),
    )


def lesson(recordings: dict[str, Recording], learnt_on: str) -> Lesson:
    """Learn on one file, track all the others in four manners."""
    model = learn(recordings[learnt_on])
    bare = plain(model, recordings[learnt_on])
    spread = gain_spread(model)
    white, real = ReadingError(model.noise_t, 0.0), ReadingError(model.noise_t, spread)
    manners = {
        'plain': (bare, white),
        'weighted': (bare, real),
        'effects': (model, white),
        'full': (model, real),
    }
    errors = {
        (name, manner): rmse(recording, *how)
        for name, recording in recordings.items()
        if name != learnt_on
        for manner, how in manners.items()
    }
    return Lesson(learnt_on, model, spread, errors)


def analyse(folder: Path) -> MagnetAnalysis:
    """Everything of this data set."""
    names = file_names(folder)
    recordings = {name: load(folder, name) for name in names}
    lessons = tuple(lesson(recordings, name) for name in names)
    step_path = folder / 'step1.csv'
    step = None
    if step_path.is_file():
        parts, _ = read_poses(step_path, 'M')
        recording = as_recording('step1', parts, np.zeros(3))
        step = analyse_step(recording, point_source())
    return MagnetAnalysis(lessons, step)


def rows(analysis: MagnetAnalysis) -> list[ReportRow]:
    """Before and after, on files that took no part."""
    out = []
    for part in analysis.lessons:
        tracked = sorted({name for name, _ in part.errors})
        chosen = (
            f'{", ".join(part.fit.found)} and the gain spread: {part.learnt_on} only '
            f'(choice on its blocks left out); scored on the other file'
        )
        for name in tracked:
            before, after = part.errors[name, 'plain'], part.errors[name, 'full']
            text = f'learnt on {part.learnt_on}, {name} tracked'
            for k, (kind, unit, goal) in enumerate(
                (('position', 'mm', TARGET_MM), ('orientation', 'deg', TARGET_DEG))
            ):
                met = bool(after[k] <= goal)
                figure = f'{text}: {kind} RMSE'
                out.append(ReportRow(NAME, figure, before[k], after[k], unit, goal, met, chosen))
    return out + (step_rows(NAME, analysis.step) if analysis.step is not None else [])


def tables(analysis: MagnetAnalysis) -> str:
    """Every candidate, the parameters found, and what gains and weights each bring."""
    lines = []
    for part in analysis.lessons:
        model = part.fit
        if model.search is not None:
            title = f'{NAME}, learnt on {part.learnt_on}'
            lines.append(search_text(title, model.search, 'of the noise'))
        lines.append(
            f'  strength {model.moment * (1.0 + float(model.found["moment"][0])):.4f} A m^2, '
            f'noise {1e6 * model.noise_t:.2f} uT, gain spread {100 * part.gain_error:.2f} %'
        )
        for name in model.found:
            if name != 'moment':
                lines += _parameters(model, name)
        for (tracked, manner), (position, angle) in part.errors.items():
            lines.append(f'  {tracked}: {position:.3f} mm {angle:.3f} deg  {MANNERS[manner]}')
    if analysis.step is not None:
        lines.append(step_text(analysis.step))
    return '\n'.join(lines)


def _parameters(model: MagnetFit, name: str) -> list[str]:
    values, sigma, unit = model.found[name], model.sigma[name], EFFECTS[name].unit
    if values.ndim == 1:
        text = ', '.join(f'{v:.4g} +- {s:.2g}' for v, s in zip(values, sigma, strict=True))
        return [f'  {name} {unit}: {text}']
    return [f'  {name} {unit} (one line a sensor, mean sigma {sigma.mean():.2g}):'] + [
        f'    {k + 1:2d}  ' + ' '.join(f'{v:+.5f}' for v in row) for k, row in enumerate(values)
    ]
