"""Finds the positions of the sensors, as the file of the robot that carries a magnet shows them.

A large magnet is carried past the patch by a robot, its axis always along z. Its own size and the
sensors' constant offsets make a point-dipole model believe that the patch is somewhere else.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from anser_ros.measured import ReportRow
from anser_ros.measured.candidates import CandidateSearch, search_text
from anser_ros.measured.magnet_fit import Jitter, MagnetFit, fit, search
from anser_ros.measured.magnet_model import Recording, Source, point_source
from anser_ros.measured.magnet_patch import as_recording, read_poses

Array = NDArray[np.float64]

NAME = 'magnet_step'
ROBOT = Jitter(1e-5, 1e-4)
"""Jitter of the robot's poses, m and rad."""
FIRST_NOISE_T = 5e-6
"""Noise of the readings from which the fit starts, T; it is then estimated."""
CANDIDATES = (
    'pickup',
    'ambient',
    'source_size',
    'registration',
    'source_axis',
    'sensor_position',
    'sensor_axis',
    'sensor_gain',
    'channel_gain',
    'channel_crosstalk',
    'saturation',
    'moment_drift',
)
N_BLOCKS = 5
"""Blocks of poses that are held out in turn."""


@dataclass(frozen=True)
class StepAnalysis:
    """Holds the effects and positions that the analysis found.

    Attributes
    ----------
    search : CandidateSearch
    naive, final : MagnetFit
        A dipole with the patch's place free; the chosen effects with the patch's place free.
    sensors : MagnetFit
        The chosen effects with every sensor's place free.
    """

    search: CandidateSearch
    naive: MagnetFit
    final: MagnetFit
    sensors: MagnetFit


def analyse(folder: Path) -> StepAnalysis:
    """Analyse the robot's file in a folder."""
    parts, _ = read_poses(folder / 'step1.csv', 'M')
    return analyse_step(as_recording('step1', parts, np.zeros(3)), point_source())


def analyse_step(recording: Recording, source: Source) -> StepAnalysis:
    """Choose the effects on blocks of poses; then free the patch and each sensor."""
    rich = ('pickup', 'source_size', 'registration', 'sensor_position')
    noise = fit(recording, source, rich, FIRST_NOISE_T, ROBOT).noise_t
    found = search(recording, source, CANDIDATES, noise, ROBOT, N_BLOCKS)
    always = tuple(name for name in found.chosen if name not in ('registration', 'ambient'))
    return StepAnalysis(
        found,
        fit(recording, source, ('registration', 'ambient', 'source_axis'), noise, ROBOT),
        fit(recording, source, _with(always, 'registration'), noise, ROBOT),
        fit(recording, source, _with(always, 'registration', 'sensor_position'), noise, ROBOT),
    )


def _with(names: tuple[str, ...], *more: str) -> tuple[str, ...]:
    return (*names, *(name for name in more if name not in names))


def shift_mm(model: MagnetFit) -> float:
    """Return how far the patch seems to be from where it is stated, mm."""
    return float(np.linalg.norm(model.found['registration'][:3])) * 2.0


def scatter_mm(model: MagnetFit) -> float:
    """Return the rms distance of single sensors from the stated grid less the common shift, mm."""
    places = model.found['sensor_position']
    return 1e3 * float(np.sqrt(np.mean(np.sum((places - places.mean(axis=0)) ** 2, axis=1))))


def rows(step: StepAnalysis) -> list[ReportRow]:
    """Return the rows of the report's table."""
    noise = step.final.noise_t
    chosen = f'{", ".join(step.search.chosen)}: chosen and scored on blocks of poses left out'
    sigma = 2.0 * float(np.linalg.norm(step.final.sigma['registration'][:3]))
    return [
        ReportRow(
            NAME,
            'step1: held-out field residual (noise incl.)',
            1e6 * noise * step.search.start,
            1e6 * noise * step.search.end,
            'uT',
            None,
            None,
            chosen,
        ),
        ReportRow(
            NAME,
            f'step1: distance of the patch from its stated place (1 sigma {sigma:.2f} mm)',
            shift_mm(step.naive),
            shift_mm(step.final),
            'mm',
            None,
            None,
            'before: point dipole; after: with the effects above; all poses',
        ),
        ReportRow(
            NAME,
            'step1: scatter of the single sensors about the stated grid, rms',
            np.nan,
            scatter_mm(step.sensors),
            'mm',
            None,
            None,
            'all poses, every sensor free; no gain on held-out poses: no real shift',
        ),
    ]


def tables(step: StepAnalysis) -> str:
    """Return tables of the candidates and of the sensors' places."""
    lines = [search_text(NAME, step.search, 'of the noise')]
    lines.append(f'  noise {1e6 * step.final.noise_t:.2f} uT')
    for title, model in (('point dipole', step.naive), ('with the effects', step.final)):
        shift = 2.0 * model.found['registration'][:3]
        turn = np.degrees(0.02 * model.found['registration'][3:])
        lines.append(
            f'  {title}: the patch seems to sit {np.round(shift, 3)} mm and '
            f'{np.round(turn, 3)} deg from its stated pose'
        )
    if 'source_size' in step.final.found:
        size = 1e4 * float(step.final.found['source_size'][0])
        sigma = 1e4 * float(step.final.sigma['source_size'][0])
        lines.append(
            f'  octupole of the magnet {size:.3f} +- {sigma:.3f} cm^2: half length squared over 6 '
            'minus radius squared over 8 of a cylinder'
        )
    places, sigma_m = step.sensors.found['sensor_position'], step.sensors.sigma['sensor_position']
    lines.append(f'  places of the sensors, own axes, mm (mean sigma {1e3 * sigma_m.mean():.3f}):')
    lines += [
        f'    {k + 1:2d}  ' + ' '.join(f'{1e3 * v:+.3f}' for v in row)
        for k, row in enumerate(places)
    ]
    return '\n'.join(lines)
