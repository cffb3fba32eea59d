"""Calibrates sessions that cannot determine a free field, with a drawn board as the prior.

A plate's typed places, in one plane even (`calibration.drawn_fit`). Where the drawn board puts
each coil is compared with what was typed first: places of another pitch, a place that was missed,
or a probe upside down are refused by name.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from anser_ros.arrays import Array
from anser_ros.calibration.calibrate import Options
from anser_ros.calibration.drawn_fit import DrawnFit, DrawnFitter, evenly
from anser_ros.calibration.held_out import HeldOutTally
from anser_ros.calibration.layout_fit import RICH
from anser_ros.calibration.layouts import Generator, Layout
from anser_ros.calibration.moments import FitFigures, Progress
from anser_ros.calibration.population import OpticalNoise, Population
from anser_ros.calibration.readings import (
    FEWEST_SCAN_FRAMES,
    is_thick,
    usable_frames,
    usable_weights,
    with_pose,
)
from anser_ros.calibration.result import Calibration, Scan, corrections, residuals, with_provenance
from anser_ros.calibration.sensor_fit import SensorFit
from anser_ros.errors import FitError
from anser_ros.field.measurements import Measurements
from anser_ros.physics.constants import DEGREES
from anser_ros.physics.rotations import nearest_rotation
from anser_ros.sessions.nominal_board import NominalBoard
from anser_ros.sessions.session import Session
from anser_ros.sessions.tracked_session import track_session
from anser_ros.tracking.estimate import NO_GATE, TrackerSettings

MOST_NOISE = 5.0
"""Noise of a fit in units of the fluxes' from which on no board like the drawn one explains
them: metal does that, and poses of another place."""
NEAR_M = 8e-3
"""Distance from a typed place to where the drawn board puts the coil, m, up to which they agree:
a drawn board is right to 2 or 3 mm."""
MOST_ASTRAY = 0.1
"""Share of the places that may lie farther off without a reason that has a name."""
OTHER_PITCH = 0.05
"""Relative difference of a pitch from the typed one that is named: far more than a drawn board's
own errors make of it."""
CLEAR = 2.0
"""Standard deviations from which on an emitter is said to be elsewhere than drawn."""


def is_for_drawing(sessions: Sequence[Session], options: Options) -> bool:
    """Return whether typed places leave a field open that the drawn board closes.

    They are fewer than the dipoles of a free field, or all in one plane, and belong to one plate.
    """
    tools = [tool for session in sessions for tool in session.tools]
    if options.layout is not None or not options.estimate or len(sessions) != 1:
        return False
    if any(tool.is_followed or not tool.sensors.is_single.all() for tool in tools):
        return False
    if not all(tool.has_pose.any() for tool in tools) or usable_frames(tools) < FEWEST_SCAN_FRAMES:
        return False
    few = sum(int(m.usable.sum()) for m in tools) < RICH.count**2
    return (few or not is_thick(tools)) and NominalBoard.of(sessions[0].setup).model is not None


def fit_to_drawing(
    session: Session, generator: Generator, options: Options, progress: Progress | None = None
) -> Calibration | None:
    """Fit the drawn board; None where its field cannot be that of the readings, as near metal.

    Raises `FitError` with what was typed wrongly.
    """
    assert generator.nominal is not None
    session = replace(session, tools=tuple(evenly(session.tools)), reference=None)
    settings = TrackerSettings(gate=NO_GATE, max_sigma_m=1.0)
    tracked = track_session(session, generator.nominal, settings).sensors
    typed = [with_pose(tool) for tool in session.tools]
    for tool, one in zip(session.tools, typed, strict=True):
        series = tracked[tool.sensors.name[0]]
        rows = np.flatnonzero(np.isin(tool.time, one.time))
        found = [series.estimates[row] for row in rows.tolist()]
        known = series.ok[rows]
        places = np.array([estimate.position for estimate in found])
        places = np.where(known[:, None], places, np.nan)
        axes = np.array([estimate.axis for estimate in found])
        if contradiction := check_typed(one, places, axes):
            if is_thick([one]):
                return None  # metal moves them as well, and a free field says so
            raise FitError(contradiction)
    noise_t = options.accuracy.flux_noise_t
    fit = DrawnFitter(typed, generator, options.estimate, noise_t).fit(progress)
    if fit.noise_t > MOST_NOISE * noise_t:
        return None
    names = [Path(session.path).name for _ in session.tools]
    return with_provenance(_calibration(fit, typed, generator, options), names)


def check_typed(typed: Measurements, there: Array, axes: Array) -> str:
    """Return in words how far typed places are from where the drawn board puts them, if they are.

    Raises `FitError` with the size where that has a reason with a name.

    ``there``, ``axes`` (F, 3): where the drawn board puts the body's first coil, m, NaN where it
    does not say, and its axis.
    """
    stated, pointing = (of_all[:, 0] for of_all in typed.placed())
    known, places = np.isfinite(there).all(axis=1), stated
    if known.sum() < FEWEST_SCAN_FRAMES:
        return ''
    alike = np.einsum('fi,fi->f', pointing, axes)[known]
    if np.median(alike) < 0.0:
        raise FitError(
            f'{typed.body}: the coil points the other way than typed, by '
            f'{DEGREES * np.arccos(np.clip(np.median(alike), -1.0, 1.0)):.0f} deg: is its axis '
            'reversed, or the probe upside down?'
        )
    off = np.linalg.norm(there - places, axis=1)
    if np.mean(off[known] > NEAR_M) <= MOST_ASTRAY:
        return ''
    pitch = float(np.median(cKDTree(places).query(places, 2)[0][:, 1]))
    # A place where the drawn board puts no coil speaks for neither.
    later = np.linalg.norm(there[:-1] - places[1:], axis=1) > NEAR_M
    wrong = np.concatenate([[0], np.cumsum(off[:-1] > NEAR_M)])
    wrong[:-1] += np.cumsum(later[::-1])[::-1]
    missed, last = np.flatnonzero(wrong == wrong.min())[[0, -1]].tolist()
    if wrong[missed] <= MOST_ASTRAY * known.sum() and missed < len(places) - 1:
        raise FitError(
            f'{typed.body}: one of the typed places {missed + 1} to {last + 1} was missed: from '
            f'there on each reading belongs to the next place, {1e3 * pitch:.0f} mm or more off'
        )
    middle, centre = places[known].mean(axis=0), there[known].mean(axis=0)
    turn = nearest_rotation((there[known] - centre).T @ (places[known] - middle))
    arms, ways = (places[known] - middle) @ turn.T, there[known] - centre
    scale = float((arms * ways).sum() / (arms**2).sum())
    rest = np.linalg.norm(ways - scale * arms, axis=1)
    if np.mean(rest > NEAR_M) <= MOST_ASTRAY and abs(scale - 1.0) > OTHER_PITCH:
        raise FitError(
            f'{typed.body}: the places lie {scale:.3f} times as far apart as typed: '
            f'{1e3 * scale * pitch:.2f} mm where {1e3 * pitch:.2f} mm are typed'
        )
    return (
        f'{typed.body}: the drawn board puts the coil {1e3 * np.median(off[known]):.0f} mm '
        '(median) from where it was typed: is the plate turned, mirrored or elsewhere?'
    )


def _calibration(
    fit: DrawnFit, typed: Sequence[Measurements], generator: Generator, options: Options
) -> Calibration:  # fmt: skip
    """The result of a fit in the form of every calibration's."""
    jitter = OpticalNoise(float(fit.jitter[0]), float(fit.jitter[3]))
    accuracy = replace(
        options.accuracy, optical_position_m=jitter.position_m,
        optical_rotation_rad=jitter.rotation_rad,
    )  # fmt: skip
    now = tuple(part.now for part in fit.parts)
    steady = tuple(np.ones(len(m.time), dtype=bool) for m in typed)
    sensors = SensorFit(
        fit.sensors, fit.posterior, (), fit.evidence, fit.noise_t, jitter,
        Population(fit.sensors).alone, steady, steady, 0.0, {}, fit.model.shift_sigma_m,
    )  # fmt: skip
    tally = HeldOutTally(fit.noise_t, fit.noise_t, accuracy, len(fit.model.positions))
    for part, terms in zip(fit.parts, fit.held_out, strict=True):
        tally.add(terms, usable_weights(part.now), part.now.position)
    figures = FitFigures(
        weights=tuple(part.weights for part in fit.parts), noise_t=fit.noise_t,
        rank=round(fit.freedom), freedom=fit.freedom / (2 * len(generator.emitters)),
        condition=float(np.linalg.cond(fit.posterior.covariance)) if len(fit.sensors) else 1.0,
        alternations=fit.steps,
    )  # fmt: skip
    corrected = corrections(sensors)
    assert generator.nominal is not None
    model = replace(fit.model, effects=corrected)
    frame = (
        f'the frame is that of the drawing, to {1e3 * model.shift_sigma_m:.2f} mm along each axis'
    )
    return Calibration(
        model=model, fit=figures, held_out=tally.result(),
        layout=Layout('drawn', len(model.positions), 1.0, 0.0, 'nominal', words=WORDS),
        damping=0.0, n_measurements=sum(int(m.usable.sum()) for m in now),
        residuals=residuals(now, model),
        scan=Scan(now, accuracy, corrected, (), sensors),
        nominal_rmse_t=residuals(typed, generator.nominal).rmse_t,
        undetermined=(frame,), more={
            'emitters_off': emitter_rows(fit, generator),
            'plate': {
                'shift_m': fit.plate[:3].tolist(), 'turn_rad': fit.plate[3:6].tolist(),
                'scale': float(1.0 + fit.plate[6]),
            },
        },
    )  # fmt: skip


WORDS = 'those of the drawn coils, each a little off, and a weak layer'
"""The layout in words for a report."""
WAYS = (('left', 'right'), ('front', 'back'), ('down', 'up'))
"""Words for the ways along -x, x, -y, y, -z and z."""


def emitter_rows(fit: DrawnFit, generator: Generator) -> list[dict[str, object]]:
    """Return of each emitter how it differs from its drawing, with one sigma, and in words."""
    rows = []
    for name, error, sigma in zip(generator.emitters, fit.errors, fit.sigma, strict=True):
        words = [
            f'sits {1e3 * abs(error[j]):.1f} mm further {WAYS[j][int(error[j] > 0.0)]} than drawn'
            for j in np.argsort(-np.abs(error[:3]))[:1]
            if abs(error[j]) > CLEAR * sigma[j]
        ]
        tilt, of_tilt = np.linalg.norm(error[3:5]), np.linalg.norm(sigma[3:5]) / np.sqrt(2.0)
        if tilt > CLEAR * of_tilt:
            words.append(f'is tilted by {DEGREES * tilt:.1f} deg')
        if abs(error[6]) > CLEAR * sigma[6]:
            words.append(
                f'is {100 * abs(error[6]):.1f} % {"stronger" if error[6] > 0 else "weaker"}'
            )
        rows.append(
            {
                'name': name,
                'shift_m': error[:3].tolist(), 'shift_sigma_m': sigma[:3].tolist(),
                'tilt_rad': error[3:5].tolist(), 'tilt_sigma_rad': sigma[3:5].tolist(),
                'strength': float(1.0 + error[6]), 'strength_sigma': float(sigma[6]),
                'words': f'{name} ' + (' and '.join(words) or 'is as drawn'),
            }
        )  # fmt: skip
    return rows
