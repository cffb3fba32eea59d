"""Calibrates sessions that cannot determine a free field, with a drawn board as the prior.

A plate's typed places, in one plane even, or a tool that was moved by hand without an optical
tracker (`calibration.drawn_fit`). Where the drawn board puts each coil is compared with what was
typed first: places of another pitch, a place that was missed, or a probe upside down are refused
by name.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from anser_ros.arrays import Array, ComplexArray
from anser_ros.calibration.calibrate import Options
from anser_ros.calibration.disturbances import LEAST_DRIFT
from anser_ros.calibration.drawn_fit import (
    LEVEL,
    MOST_READINGS,
    PLACE,
    PLATE,
    SCALE,
    DrawnFit,
    DrawnFitter,
)
from anser_ros.calibration.held_out import HeldOutTally
from anser_ros.calibration.layout_fit import RICH
from anser_ros.calibration.layouts import Generator, Layout
from anser_ros.calibration.moments import FitFigures, Progress
from anser_ros.calibration.population import OpticalNoise, Population
from anser_ros.calibration.readings import (
    FEWEST_SCAN_FRAMES,
    is_thick,
    thinned,
    usable_frames,
    usable_weights,
    with_pose,
)
from anser_ros.calibration.result import (
    OUTLIER_WEIGHT,
    Calibration,
    Scan,
    at_start,
    corrections,
    residuals,
    with_provenance,
)
from anser_ros.calibration.sensor_fit import SensorFit
from anser_ros.errors import FitError
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel
from anser_ros.physics.constants import DEGREES
from anser_ros.physics.rotations import nearest_rotation
from anser_ros.physics.sensor import SAME_CENTRE_M
from anser_ros.pose_states import INCONSISTENT, OK
from anser_ros.sessions.nominal_board import NominalBoard
from anser_ros.sessions.session import Session
from anser_ros.sessions.tracked_session import track_session
from anser_ros.tracking.coil_step import UNKNOWNS
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
OTHER_GAIN = 0.1
"""The same of a probe's gain: five times what coils differ that are wound by hand."""
MOST_GAPS = 3
"""Places of a lattice without a reading, for each with one, up to which it is one: any places lie
on the lattice of all their coordinates."""
IN_A_LINE = 0.01
"""Ratio of a plate's square widths below which its places lie in a line, which tells no mirror."""
NO_HEIGHT_M = 0.01
"""Height of a typed plate, m, below which it is doubted: a coil and its holder are no flatter."""
ALIKE, OTHER_PHASE = 0.9, 20.0
"""Correlation of an emitter's readings with the drawn ones at places that are right, where another
emitter's is far below, and a phase that all share, deg, that is doubted: filters leave a few."""
CLEAR = 2.0
"""Standard deviations from which on an emitter is said to be elsewhere than drawn."""


def is_for_drawing(sessions: Sequence[Session], options: Options) -> bool:
    """Return whether sessions leave a field open that the drawn board closes.

    That is a tool without any stated pose, or typed places that are fewer than the dipoles of a
    free field, or all in one plane.
    """
    tools = [tool for session in sessions for tool in session.tools]
    if options.layout is not None or not options.estimate or not tools:
        return False
    if any(tool.is_followed for tool in tools):
        return False
    posed = [tool for tool in tools if tool.has_pose.any()]
    if usable_frames(posed) < FEWEST_SCAN_FRAMES or len(posed) < len(tools):
        is_open = len(posed) < len(tools) and all(t.sensors.is_single.all() for t in tools)
    else:
        is_open = not is_thick(posed) or sum(int(m.usable.sum()) for m in posed) < RICH.count**2
    # The drawing's dipoles take a second, so they come last.
    return is_open and NominalBoard.of(sessions[0].setup).model is not None


def fit_to_drawing(
    sessions: Sequence[Session], generator: Generator, options: Options,
    progress: Progress | None = None,
) -> Calibration | None:  # fmt: skip
    """Fit the drawn board; None where its field cannot be the readings' and typed places can tell.

    Raises `FitError` with what was typed wrongly, or when unknown poses leave no such board.
    """
    _check_channels([tool for session in sessions for tool in session.tools])
    found, typed = [], []
    for whole in sessions:
        session = replace(whole, tools=tuple(thinned(whole.tools, MOST_READINGS)), reference=None)
        starts = _drawn_poses(session, generator.nominal)
        for tool, start in zip(session.tools, starts, strict=True):
            typed.append(bool(tool.has_pose.any()))
            if typed[-1] and (
                contradiction := check_typed(with_pose(tool), start, generator.nominal)
            ):
                if is_thick([with_pose(tool)]):
                    return None  # metal moves them as well, and a free field says so
                raise FitError(contradiction)
            found.append(with_pose(tool if typed[-1] else start))
    fewest = min(len(m.time) for m in found)
    if fewest < FEWEST_SCAN_FRAMES:
        raise FitError(
            f'a calibration needs at least {FEWEST_SCAN_FRAMES} frames whose coils the drawn '
            f'board places, got {fewest}{_few_words(generator)}'
        )
    noise_t = options.accuracy.flux_noise_t
    fit = DrawnFitter(found, typed, generator, options.estimate, noise_t).fit(progress)
    if fit.noise_t > MOST_NOISE * noise_t:
        if all(typed):
            return None
        raise FitError(
            f'no board like the drawn one explains the readings: {fit.noise_t:.2g} T are left, '
            f'{noise_t:.2g} T are noise. Is metal near, or are coils exchanged?'
        )
    names = [Path(session.path).name for session in sessions for _ in session.tools]
    made = with_provenance(_calibration(fit, found, typed, generator, options), names)
    return replace(made, model=at_start(made.model))


def _few_words(generator: Generator) -> str:
    """What few emitters leave open, in words; nothing where they place a coil."""
    count = len(generator.emitters)
    few = f'; {count} emitters cannot place a coil by itself, whose pose has {UNKNOWNS} unknowns'
    return few if count < UNKNOWNS else ''


def _check_channels(tools: Sequence[Measurements]) -> None:
    """Raise `FitError` where bodies share a channel, by which a model knows its coils."""
    body_of: dict[int, str] = {}
    for tool in tools:
        for channel in tool.sensors.channel.tolist():
            known = body_of.setdefault(channel, tool.body)
            if known != tool.body:
                raise FitError(
                    f'channel {channel} is a coil of {known} and of {tool.body}: what is learnt '
                    'of a coil is kept by its channel, so calibrate with one of them'
                )


def _drawn_poses(session: Session, nominal: FieldModel | None) -> list[Measurements]:
    """The tools at the poses where the drawn board puts most of their coils, each by itself.

    Where few emitters place no coil, that is where it puts all of them together. A turn about a
    single axis stays open, and is any.
    """
    assert nominal is not None
    settings = TrackerSettings(gate=NO_GATE, max_sigma_m=1.0)
    # Typed poses of any unit take no part.
    bare = (replace(tool, has_pose=np.zeros_like(tool.has_pose)) for tool in session.tools)
    tracked = track_session(replace(session, tools=tuple(bare)), nominal, settings)
    out = list[Measurements]()
    for tool in session.tools:
        series = [tracked.sensors[name].estimates for name in tool.sensors.name]
        # Coils that are a little off contradict their body, which is no fault of their places.
        known = np.array([[e.state in (OK, INCONSISTENT) for e in one] for one in series]).T
        places = np.array([[e.position for e in one] for one in series]).swapaxes(0, 1)
        axes = np.array([[e.axis for e in one] for one in series]).swapaxes(0, 1)
        enough = 2 * known.sum(axis=1) > len(series)
        position = np.full((len(tool.time), 3), np.nan)
        rotation = np.tile(np.eye(3), (len(tool.time), 1, 1))
        for row in np.flatnonzero(enough).tolist():
            own = known[row]
            there, arms = places[row, own], tool.sensors.position[own]
            ways, drawn = there - there.mean(axis=0), arms - arms.mean(axis=0)
            size = max(float((drawn**2).sum(axis=1).mean()), SAME_CENTRE_M**2)
            turn = nearest_rotation(
                axes[row, own].T @ tool.sensors.axis[own] + ways.T @ drawn / size
            )
            middles = there - arms @ turn.T
            position[row], rotation[row] = np.median(middles, axis=0), turn
            off = np.linalg.norm(middles - position[row], axis=1)
            enough[row] = np.median(off) < NEAR_M
        whole = tracked.bodies[tool.body].estimates if tool.body in tracked.bodies else ()
        for row, body in enumerate(whole):
            if not known[row].any() and body.state == OK and body.rotation is not None:
                position[row], rotation[row], enough[row] = body.position, body.rotation, True
        out.append(
            replace(tool, position=position, rotation=rotation, has_pose=enough, track=None)
        )
    return out


def check_typed(typed: Measurements, drawn: Measurements, nominal: FieldModel | None) -> str:
    """Return in words how far typed places are from where the drawn board puts them, if they are.

    Raises `FitError` with the size where that has a reason with a name.

    ``drawn`` are all frames of the same body at the poses that the drawn board gives them, which
    is the ``nominal`` one.
    """
    found = drawn.frames(np.isin(drawn.time, typed.time))
    known = found.has_pose
    places, there = (of_all.placed()[0][:, 0] for of_all in (typed, found))
    assert nominal is not None
    length = np.repeat(typed.sensors.length[:1], len(places))
    made, read = nominal.flux(places, typed.placed()[1][:, 0], length), typed.flux[:, 0]
    if words := _wiring_words(made, read, nominal.emitters):
        raise FitError(f'{typed.body}: {words}')
    if known.sum() < FEWEST_SCAN_FRAMES:
        return ''
    alike = np.einsum('fsi,fsi->fs', typed.placed()[1], found.placed()[1])[known]
    if np.median(alike) < 0.0:
        raise FitError(
            f'{typed.body}: the coil points the other way than typed, by '
            f'{DEGREES * np.arccos(np.clip(np.median(alike), -1.0, 1.0)):.0f} deg: is its axis '
            'reversed, or the probe upside down?'
        )
    middle, centre = places[known].mean(axis=0), there[known].mean(axis=0)
    if middle[2] < NO_HEIGHT_M and centre[2] - middle[2] > NEAR_M:
        at = f'{1e3 * abs(middle[2]):.0f} mm {"below" if middle[2] < 0.0 else "over"}'
        raise FitError(
            f'{typed.body}: the plate is typed {at} the board and lies {1e3 * centre[2]:.0f} mm '
            'above it: is the height missing, z reversed, or the plate upside down?'
        )
    gain = float(np.vdot(made, read).real / np.vdot(made, made).real)
    size = float(np.linalg.norm(read - gain * made) / np.linalg.norm(made))
    if abs(gain - 1.0) > max(OTHER_GAIN, 4.0 * size):
        raise FitError(
            f'{typed.body}: the readings are {gain:.2f} times what the drawn board gives at the '
            "typed places: is the probe's gain or the emitters' current stated wrongly?"
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
    which = f'one of the typed places {missed + 1} to {last + 1}'
    which = which if last > missed else f'the typed place {missed + 1}'
    if wrong[missed] <= MOST_ASTRAY * known.sum() and missed < len(places) - 1:
        raise FitError(
            f'{typed.body}: {which} was missed: from '
            f'there on each reading belongs to the next place, {1e3 * pitch:.0f} mm or more off'
        )
    arms, ways = places[known] - middle, there[known] - centre
    one, sizes, other = np.linalg.svd(ways[:, :2].T @ arms[:, :2])
    turn = np.eye(3)
    turn[:2, :2] = one @ other
    scale = float((arms @ turn.T * ways).sum() / (arms**2).sum())
    rest = np.linalg.norm(ways - scale * arms @ turn.T, axis=1)
    away = (
        f'{1e3 * np.median(off[known]):.0f} mm (median), up to {1e3 * off[known].max():.0f} mm, '
        'from where it was typed'
    )
    if np.mean(rest > NEAR_M) <= MOST_ASTRAY and sizes[1] > IN_A_LINE * sizes[0]:
        if abs(scale - 1.0) > OTHER_PITCH:
            raise FitError(
                f'{typed.body}: the places lie {scale:.3f} times as far apart as typed: '
                f'{1e3 * scale * pitch:.2f} mm where {1e3 * pitch:.2f} mm are typed'
            )
        raise FitError(
            f'{typed.body}: {_plate_words(turn, centre - middle)}: the drawn board puts the coil '
            f'{away}, and {1e3 * np.median(rest):.0f} mm with that undone'
        )
    near, order = cKDTree(places).query(there[known])
    if np.mean(near > NEAR_M) <= MOST_ASTRAY:
        rows = np.flatnonzero(known)
        first = int(np.flatnonzero(order != rows)[0])
        return (
            f'{typed.body}: the places are typed in another order: reading {rows[first] + 1} was '
            f'taken at place {order[first] + 1}; the drawn board puts the coil {away}'
        )
    return (
        f'{typed.body}: the drawn board puts the coil {away}, and no turn, mirror image, pitch or '
        'order of the places explains it: are they elsewhere?'
    )


def _wiring_words(made: ComplexArray, read: ComplexArray, emitters: Sequence[str]) -> str:
    """What emitters or phases explain readings (F, K) by those made at typed places, in words."""
    size = np.linalg.norm(made, axis=0)[:, None] * np.linalg.norm(read, axis=0)
    alike = made.conj().T @ read / np.maximum(size, 1e-300)
    own = np.diag(alike)
    lag = DEGREES * float(np.angle(own.sum()))
    if (np.abs(own) > ALIKE).all() and OTHER_PHASE < abs(lag) < 180.0 - OTHER_PHASE:
        return f'all readings are {lag:.0f} deg off in phase: is that of the fluxes turned?'
    weak = np.linalg.norm(read, axis=0) < (1.0 - ALIKE) * np.linalg.norm(made, axis=0)
    wrong = np.flatnonzero(weak | (own.real < ALIKE))
    names = ' and '.join(emitters[k] for k in wrong.tolist())
    if not 0 < len(wrong) <= min(2, len(own) // 3):
        return ''
    if weak[wrong].all():
        return f'{names} alone hardly read anything: dead?'
    if (own[wrong].real < -ALIKE).all():
        return f'{names} alone read the other way than drawn: wired in reverse?'
    if len(wrong) == 2 and (alike[wrong, wrong[::-1]].real > ALIKE).all():
        return f"{names} alone read as each other's coil: are the two exchanged?"
    return ''


def _plate_words(turn: Array, shift: Array) -> str:
    """How a plate stands that is turned or mirrored (3, 3) in its plane, and shifted (3,), m."""
    if np.linalg.det(turn) > 0.0:
        angle = DEGREES * np.arctan2(turn[1, 0], turn[0, 0])
        x, y, z = 1e3 * shift
        return f'the plate is turned by {angle:.0f} deg, and {x:.0f}, {y:.0f}, {z:.0f} mm away'
    if abs(turn[0, 1]) > abs(turn[0, 0]):
        return f'x and y are exchanged{"" if turn[0, 1] > 0.0 else ", and their signs"}'
    return f'the plate is mirrored, {"y" if turn[0, 0] > 0.0 else "x"} has the other sign'


def _calibration(
    fit: DrawnFit, found: Sequence[Measurements], typed: Sequence[bool], generator: Generator,
    options: Options,
) -> Calibration:  # fmt: skip
    """The result of a fit in the form of every calibration's."""
    jitter = OpticalNoise(float(fit.jitter[0]), float(fit.jitter[3]))
    accuracy = replace(
        options.accuracy, optical_position_m=jitter.position_m,
        optical_rotation_rad=jitter.rotation_rad,
    )  # fmt: skip
    now = tuple(part.now for part in fit.parts)
    steady = tuple(np.ones(len(m.time), dtype=bool) for m in found)
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
    stated = [m for m, one in zip(found, typed, strict=True) if one]
    nominal = generator.nominal
    model = replace(fit.model, effects=corrected)
    frame = (
        f'the frame is that of the drawing, to {1e3 * model.shift_sigma_m:.2f} mm along each axis'
    )
    return Calibration(
        model=model, fit=figures, held_out=tally.result(),
        layout=Layout('drawn', len(model.positions), 1.0, 0.0, 'nominal', words=WORDS),
        damping=0.0, n_measurements=sum(int(m.usable.sum()) for m in now),
        residuals=residuals(now, model),
        scan=Scan(now, accuracy, corrected, (), sensors if all(typed) else None),
        nominal_rmse_t=residuals(stated, nominal).rmse_t if all(typed) and nominal else None,
        undetermined=(frame, *_gaps(stated)), contradictions=_doubts(fit, generator),
        emitters=emitter_rows(fit, generator), more={
            'frame': {'shift_sigma_m': fit.frame_sigma[:3].tolist(),
                      'turn_sigma_rad': fit.frame_sigma[3:].tolist()},
            'plate': {
                'shift_m': fit.plate[:3].tolist(), 'turn_rad': fit.plate[3:6].tolist(),
                'scale': float(1.0 + fit.plate[6]),
            } if any(typed) else None,
        },
    )  # fmt: skip


def _gaps(typed: Sequence[Measurements]) -> Iterator[str]:
    """Yield a line where typed places are a lattice of which some have no reading."""
    for m in typed:
        places = m.position[m.usable.any(axis=1)]
        near = float(np.median(cKDTree(places).query(places, 2)[0][:, 1])) / 4.0
        order = np.argsort(places, axis=0)
        steps = np.diff(np.take_along_axis(places, order, axis=0), axis=0) > near
        line = np.cumsum(np.vstack([np.zeros((1, 3), bool), steps]), axis=0)
        places = np.unique(np.take_along_axis(line, np.argsort(order, axis=0), axis=0), axis=0)
        whole = math.prod((line[-1] + 1).tolist())
        if len(places) < whole <= (1 + MOST_GAPS) * len(places):
            yield (
                f'{m.body}: {whole - len(places)} of the {whole} places of the lattice have no '
                'reading, and the field is less known there'
            )


def _doubts(fit: DrawnFit, generator: Generator) -> tuple[str, ...]:
    """A line for a plate, and for each of its places, that is off by far more than such are."""
    lines, shared = [], float(np.median(fit.errors[:, 6]))
    if abs(shared) > CLEAR * LEVEL[0]:
        way = 'stronger' if shared > 0.0 else 'weaker'
        lines.append(
            f'all emitters come out {100 * abs(shared):.1f} % {way} than drawn (median): '
            "is the probe's gain or the current stated wrongly?"
        )
    typed = [part for part in fit.parts if part.is_typed]
    if not typed:
        return tuple(lines)
    place = np.concatenate([part.stated.position for part in typed])
    offset = np.concatenate([part.offset[:, :3] for part in typed])
    arms, ways = generator.centres - generator.middle, place - place.mean(axis=0)
    scale = float(fit.plate[6] - (arms * fit.errors[:, :3]).sum() / (arms**2).sum())
    along = (ways * offset).sum(axis=0)[:2] / np.maximum((ways**2).sum(axis=0)[:2], 1e-12)
    usual = float(np.hypot(PLATE[6], SCALE))
    sizes = {'': scale}
    if abs(along[0] - along[1]) > FAR * usual:
        sizes = dict(zip((' along x', ' along y'), scale + along, strict=True))
        offset[:, :2] -= along * ways[:, :2]
    if few := _few_words(generator):
        lines.append(few[2:])
    elif max(map(abs, sizes.values())) > FAR * usual:
        ways_off = ((k, 100 * abs(v), 'larger' if v > 0 else 'smaller') for k, v in sizes.items())
        said = ' and'.join(f'{k} {size:.1f} % {way}' for k, size, way in ways_off)
        lines.append(
            f'the plate comes out{said} than typed beside the board, and plate and board are true '
            f'to {100 * usual:.1f} %: is the pitch right? Measure it, and type the places anew'
        )
    away = np.linalg.norm(offset, axis=1)
    weight = np.concatenate([part.weights.max(axis=1) for part in typed])
    doubted = (away > FAR * PLACE[0]) | ((weight > 0.0) & (weight < OUTLIER_WEIGHT))
    worst = np.flatnonzero(doubted)
    for k in worst[np.argsort(-away[worst])][:MOST_LINES]:
        at = ', '.join(f'{one:.1f}' for one in 1e3 * place[k])
        fits = weight[k] > OUTLIER_WEIGHT
        how = f'is {1e3 * away[k]:.1f} mm off' if fits else 'does not fit at all'
        lines.append(f'the reading typed at {at} mm {how}: is the place right, and the order?')
    if len(worst) > MOST_LINES:
        lines.append(f'so are {len(worst) - MOST_LINES} more of {len(place)} places')
    return tuple(lines)


FAR, MOST_LINES = 4.0, 3
"""Standard deviations from which on a plate or place is doubted aloud; lines for single places."""
WORDS = 'those of the drawn coils, each a little off, and a weak layer'
"""The layout in words for a report."""
WAYS = (('left', 'right'), ('front', 'back'), ('down', 'up'))
"""Words for the ways along -x, x, -y, y, -z and z."""


def emitter_rows(fit: DrawnFit, generator: Generator) -> tuple[dict[str, object], ...]:
    """Return of each emitter how it differs from its drawing, with one sigma, and in words."""
    rows = []
    each = zip(generator.emitters, fit.errors, fit.sigma, fit.changes.tolist(), strict=True)
    for name, error, sigma, change in each:
        words = [
            f'sits {1e3 * abs(error[j]):.1f} ± {1e3 * sigma[j]:.1f} mm further '
            f'{WAYS[j][int(error[j] > 0.0)]} than drawn'
            for j in np.argsort(-np.abs(error[:3]))[:1]
            if abs(error[j]) > CLEAR * sigma[j]
        ]
        tilt, of_tilt = np.linalg.norm(error[3:5]), np.linalg.norm(sigma[3:5]) / np.sqrt(2.0)
        if tilt > CLEAR * of_tilt:
            words.append(f'is tilted by {DEGREES * tilt:.1f} ± {DEGREES * of_tilt:.1f} deg')
        if abs(error[6]) > CLEAR * sigma[6]:
            words.append(
                f'is {100 * abs(error[6]):.1f} ± {100 * sigma[6]:.1f} % '
                f'{"stronger" if error[6] > 0 else "weaker"}'
            )
        if abs(change) > LEAST_DRIFT:
            way = 'stronger' if change > 0.0 else 'weaker'
            words.append(f'became {100 * abs(change):.1f} % {way} while it was read')
        rows.append(
            {
                'shift_m': error[:3].tolist(), 'tilt_rad': error[3:5].tolist(),
                'strength': float(1.0 + error[6]),
                'uncertainty': {
                    'shift_m': sigma[:3].tolist(), 'tilt_rad': sigma[3:5].tolist(),
                    'strength': float(sigma[6]),
                },
                'words': f'{name} ' + (' and '.join(words) or 'is as drawn'),
            }
        )  # fmt: skip
    return tuple(rows)
