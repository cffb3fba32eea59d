"""Faults in which many things change together and slowly, on the recorded path: no node, no clock.

A simulated frame goes through `Chain.step` as a recorded one does, so that minutes of a drift take
seconds, and each fault is tried at three sizes. The truth is exact.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
from table import Row

from anser_ros.apps.dashboard.cli.demo import METAL_RADIUS_M
from anser_ros.chain.chain import Chain
from anser_ros.chain.frame import ChainFrame, FrameReadings
from anser_ros.chain.model_half import ModelHalf
from anser_ros.chain.tracking_half import TrackingHalf
from anser_ros.cli.processes import BOARD_SEED
from anser_ros.field.nominal import nominal_model
from anser_ros.physics.dipole import flux_basis
from anser_ros.physics.rotations import rotation_of_vector
from anser_ros.physics.sensor import SensorTable, along_each_axis
from anser_ros.pose_states import OK
from anser_ros.refit.frame import Pace
from anser_ros.refit.live_refit import LiveRefit
from anser_ros.refit.tables import RefitTables, build_tables
from anser_ros.sessions.nominal_board import NominalBoard, board_of, tracked_volume
from anser_ros.sessions.session import sensor_table
from anser_ros.sessions.starting_model import load_model
from anser_ros.simulation.world import Approach, Lissajous, manufactured, steel_disc
from anser_ros.tracking.estimate import TrackerSettings
from anser_ros.tracking.tracker import Tracker
from anser_ros.wire.setup import Setup, parse_setup
from anser_ros.wire.text_files import config_path, read_config

FIRST_NS, BEGIN_S = 10**18, 5.0
FAR_M, MANY_SIGMAS, NOISE_T = 1e-3, 3.0, 60e-12
SETUP = parse_setup(read_config('demo_setup.yaml'))
TOOL, REFERENCE = sensor_table(SETUP.tool_sensors), sensor_table(SETUP.reference_sensors)
MODEL, NOMINAL = load_model(config_path('demo_model.yaml')), NominalBoard.of(SETUP)
ALL, SIDEWAYS = tuple(range(9)), np.array([0.6, 0.8, 0.0])
Field = Callable[[np.ndarray], np.ndarray]


@dataclass
class Trial:
    """What is simulated in F frames; faults change it.

    Of the tool ``position`` (F, 3), m, and ``rotation`` (F, 3, 3); ``places`` and ``axes`` (F, 9,
    3) of its coils; ``tool`` (F, 9, K) and ``reference`` (F, R, K) are fluxes without noise, T.
    """

    rng: np.random.Generator
    time: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    places: np.ndarray
    axes: np.ndarray
    tool: np.ndarray
    reference: np.ndarray
    settings: TrackerSettings
    refit: bool = True
    nominal: bool = False
    coils: tuple[int, ...] = ALL
    kept: np.ndarray | bool = True  # which frames come at all, (F,)

    @property
    def after(self) -> np.ndarray:
        """Time since the fault began, s; 0 before."""
        return np.maximum(self.time - BEGIN_S, 0.0)

    def noisy(self, flux: np.ndarray) -> np.ndarray:
        """Fluxes with the noise of a frame."""
        return flux + NOISE_T * (self.rng.standard_normal((*flux.shape, 2)) @ [1.0, 1.0j])


def field_of(setup: Setup) -> Field:
    """The field (P, 3, K) of a board."""
    board = board_of(setup)
    return lambda points: board.field(points).transpose(0, 2, 1).astype(complex)


@cache
def real_board(seed: int = BOARD_SEED) -> tuple[Setup, Field]:
    """A manufactured board."""
    setup = manufactured(SETUP, np.random.default_rng(seed))
    return setup, field_of(setup)


def read(field: Field, points: np.ndarray, axes: np.ndarray, table: SensorTable) -> np.ndarray:
    """Fluxes (..., S, K), T, of coils at points (..., S, 3)."""
    reach = (table.length / np.sqrt(12.0))[:, None] * axes
    ends = points + reach, points - reach
    flat = [field(end.reshape(-1, 3)).reshape(*points.shape, -1) for end in ends]
    return np.einsum('...ik,...i->...k', sum(flat) / 2.0, axes)


@cache
def made(seconds: float, rate_hz: float, up_m: float, metal: bool, seed: int) -> Trial:
    """A world without a fault."""
    time_s = np.arange(round(seconds * rate_hz)) / rate_hz
    path = Lissajous(centre_m=(0.0, 0.0, 0.15 + up_m), phase_rad=0.9 * seed)
    position, rotation = (np.array(v) for v in zip(*map(path, time_s), strict=True))
    turned, field = np.swapaxes(rotation, 1, 2), real_board()[1]
    places, axes = position[:, None] + TOOL.position @ turned, TOOL.axis @ turned
    tool = read(field, places, axes, TOOL)
    still = read(field, REFERENCE.position, REFERENCE.axis, REFERENCE)
    reference = np.tile(still, (len(time_s), 1, 1))
    if metal:
        visit = Approach(start_s=8.0, travel_s=3.0, stay_s=2.0, period_s=9.0)
        disc = steel_disc(visit, radius_m=METAL_RADIUS_M)
        alpha = disc.polarisability(np.array(SETUP.frequencies_hz))
        for f, now in enumerate(time_s):
            spheres = disc.centres(now)
            moments = (field(spheres) * alpha).reshape(-1, len(alpha))
            sources = along_each_axis(spheres)
            tool[f] += flux_basis(places[f], axes[f], TOOL.length, *sources) @ moments
            rest = REFERENCE.position, REFERENCE.axis, REFERENCE.length
            reference[f] += flux_basis(*rest, *sources) @ moments
    rng, settings = np.random.default_rng([seed, 7]), TrackerSettings(volume=tracked_volume(SETUP))
    return Trial(rng, time_s, position, rotation, places, axes, tool, reference, settings)


def trial(
    seconds: float = 30.0, rate_hz: float = 25.0, up_m: float = 0.0, metal: bool = False,
    seed: int = 1, **changes: Any,
) -> Trial:  # fmt: skip
    """A world of its own, to be changed."""
    one = made(seconds, rate_hz, up_m, metal, seed)
    rng = np.random.default_rng([seed, 7])
    return replace(one, rng=rng, tool=one.tool.copy(), reference=one.reference.copy(), **changes)


@cache
def tables() -> RefitTables:
    """The refit's tables."""
    return build_tables(MODEL, REFERENCE, SETUP.refit, NOMINAL.field)


def tracked(t: Trial) -> tuple[list[tuple[float, float]], Counter[str]]:
    """Errors and sigmas (m) of all poses that are ok, and how often each state was."""
    half, table = None, TOOL.select(np.array(t.coils))
    if t.refit:
        half = ModelHalf(Pace())
        baseline = np.mean([t.noisy(t.reference[0]) for _ in range(50)], axis=0)
        half.follow_by(LiveRefit(MODEL, REFERENCE, baseline, SETUP.refit, tables=tables()))
    model = nominal_model(NOMINAL.board) if t.nominal else MODEL
    tracking = TrackingHalf(Tracker(model, table, t.settings), SETUP.refit.references_age_s)
    chain, rows = Chain(half, tracking), {TOOL.name[c]: c for c in t.coils}
    found, states, no_flags = [], Counter[str](), np.zeros(len(REFERENCE), int)
    for f in np.flatnonzero(np.ones(len(t.time), bool) & t.kept).tolist():
        tools = FrameReadings(table.channel, t.noisy(t.tool[f, t.coils]), no_flags[: len(table)])
        seen = FrameReadings(REFERENCE.channel, t.noisy(t.reference[f]), no_flags)
        frame = ChainFrame(FIRST_NS + round(1e9 * t.time[f]), tools, seen if t.refit else None)
        for one in chain.step(frame):
            states[one.state] += 1
            if one.state == OK:
                coil = one.rotation is None
                truth = t.places[f, rows[one.name]] if coil else t.position[f]
                error = float(np.linalg.norm(one.position - truth))
                found.append((error, one.sigma_position_m))
    return found, states


def bent(size: float, moved: tuple[int, ...], **world: Any) -> Trial:
    """Put some coils of the tool aside, mm."""
    t, aside = trial(**world), np.zeros((9, 3))
    aside[list(moved)] = 1e-3 * size * SIDEWAYS
    away = (t.after > 0.0)[:, None, None] * (aside @ np.swapaxes(t.rotation, 1, 2))
    field, straight = real_board()[1], t.places
    t.places = straight + away
    t.tool += read(field, t.places, t.axes, TOOL) - read(field, straight, t.axes, TOOL)
    return t


def slid(
    size: float, knock: bool = False, part: slice = slice(None), **world: Any
) -> Trial:  # fmt: skip
    """Move all references as one, or a part of them, mm/min, or mm at once."""
    t = trial(**{'seconds': 60.0, 'rate_hz': 10.0, **world})
    far = 1e-3 * size * ((t.after > 0.0) if knock else t.after / 60.0)
    moved = []
    for away in far.tolist():
        turn = rotation_of_vector(away * np.array([0.4, -0.6, 2.0]))
        places = REFERENCE.position @ turn.T + away * np.array([0.7, 0.5, -0.51])
        moved.append(read(real_board()[1], places, REFERENCE.axis @ turn.T, REFERENCE))
    t.reference[:, part] += (np.array(moved) - moved[0])[:, part]
    return t


def gained(percent: float, gate: float = 4.0, drifts: bool = False, **world: Any) -> Trial:
    """Multiply what all coils of the tool read, under a gate that is set."""
    t = trial(**world)
    share = np.clip(t.after / 15.0, 0.0, 1.0) if drifts else t.after > 0.0
    t.tool *= (1.0 + percent / 100.0 * share)[:, None, None]
    t.settings = replace(t.settings, gate=float(gate))
    return t


def exchanged(every: float, order: tuple[int, ...], gate: float = 4.0, **world: Any) -> Trial:
    """Exchange channels in one frame of so many, under a gate that is set."""
    t = trial(**world)
    frames = (t.after > 0.0) & (np.arange(len(t.time)) % int(every) == 0)
    t.tool[frames] = t.tool[frames][:, order]
    t.settings = replace(t.settings, gate=float(gate))
    return t


def faded(
    size: float, emitters: tuple[int, ...] = (3,), references: int = 0, **world: Any
) -> Trial:
    """Let emitters, or the gains of the first references, drift, percent a minute."""
    t = trial(**world)
    gain = 1.0 + size / 6000.0 * t.after[:, None, None]
    if references:
        t.reference[:, :references] *= gain
        return t
    gain = np.where(np.isin(np.arange(t.tool.shape[2]), emitters), gain, 1.0)
    t.tool, t.reference = t.tool * gain, t.reference * gain
    return t


def skipping(size: float, **world: Any) -> Trial:
    """Let the references drift, percent a minute, while stretches of up to a second are lost."""
    t = faded(size, references=32, **world)
    ends, frames = t.rng.integers(1, 25, len(t.time)).cumsum(), np.arange(len(t.time))
    t.kept = np.searchsorted(ends, frames, 'right') % 2 == 0
    return t


def emitter_slid(size: float, **world: Any) -> Trial:
    """Let an emitter slide, mm in 30 s."""
    t, (setup, _) = trial(**{'seconds': 40.0, 'rate_hz': 12.5, **world}), real_board()
    for f in np.flatnonzero(t.after > 0):
        coils, far = list(setup.emitter.coils), 1e-3 * size * min(t.after[f] / 30.0, 1.0)
        coils[4] = replace(coils[4], centre_m=tuple(coils[4].centre_m + far * SIDEWAYS))
        field = field_of(replace(setup, emitter=replace(setup.emitter, coils=tuple(coils))))
        t.tool[f] = read(field, t.places[f], t.axes[f], TOOL)
        t.reference[f] = read(field, REFERENCE.position, REFERENCE.axis, REFERENCE)
    return t


def nominal_on(seed_of_board: float, **world: Any) -> Trial:
    """Track on a real board by its drawing."""
    t = trial(**{'seconds': 20.0, **world}, refit=False, nominal=True)
    t.tool = read(real_board(int(seed_of_board))[1], t.places, t.axes, TOOL)
    return t


@dataclass(frozen=True)
class Drift:
    """A fault on the recorded path, and the sizes that it is tried at."""

    name: str
    what: str
    make: Callable[..., Trial]
    sizes: tuple[float, ...]

    def rows(self, seed: int) -> list[Row]:
        """Return what came of it at each size."""
        return [self._row(size, seed) for size in self.sizes]

    def _row(self, size: float, seed: int) -> Row:
        found, states = tracked(self.make(size, seed=seed))
        wrong = [(e, s) for e, s in found if e > max(MANY_SIGMAS * s, FAR_M)]
        error, sigma = max(wrong, default=(None, None))
        said = ', '.join(f'{state} {n}' for state, n in states.most_common() if state != OK)
        name, what = f'{self.name}-{size:g}', f'{self.what}: {size:g}'
        return Row('recorded', name, what, said, None, len(found), len(wrong), error, sigma, 0.0)


ONE, PARALLEL, EMITTERS, DRIFTS = (4,), (2, 8), tuple(range(8)), (2.0, 5.0, 15.0)
BENDS, SLIDES, GATES = (1.0, 3.0, 8.0), (3.0, 15.0, 60.0), (8.0, 100.0, 1e6)
PARTS, ALWAYS = (3.0, 30.0, 60.0), (1.0, 2.0, 5.0)
SMALL_BENDS, SLOW_DRIFTS = (0.8, 1.6, 3.0), (0.5, 1.0, 2.0)
GAINS, EVERY = (1.0, 1.5, 2.0), (2.0, 5.0, 20.0)
RECORDED = (
    Drift('still', 'nothing, seed of the way', lambda size, **w: trial(**w), (1.0,)),
    Drift('bent-tip', 'three coils of nine aside, mm', partial(bent, moved=ALL[:3]), BENDS),
    Drift('bent', 'six coils of nine aside, mm', partial(bent, moved=ALL[:6]), BENDS),
    Drift('bent-end', 'the other six aside, mm', partial(bent, moved=ALL[3:]), BENDS),
    Drift('bent-high', 'six coils of nine aside, high up, mm',
          partial(bent, moved=ALL[:6], up_m=0.15), SMALL_BENDS),
    Drift('bent-two', 'one of two coils aside, high up, mm',
          partial(bent, moved=ONE, coils=(0, 4), up_m=0.15), SMALL_BENDS),
    Drift('slide', 'all references slide, mm/min', slid, SLIDES),
    Drift('slide-slow', 'the same for minutes', partial(slid, seconds=200.0, rate_hz=5.0),
          (1.0, 3.0)),
    Drift('slide-metal', 'the same near moving metal', partial(slid, metal=True), SLIDES),
    Drift('slide-part', 'a quarter of the references slide, mm/min',
          partial(slid, part=slice(8)), PARTS),
    Drift('slide-most', 'three quarters of them', partial(slid, part=slice(24)), PARTS),
    Drift('slide-most-metal', 'the same near moving metal',
          partial(slid, part=slice(24), metal=True), PARTS),
    Drift('knock', 'all references are knocked aside, mm', partial(slid, knock=True),
          (0.6, 2.0, 20.0)),
    Drift('gain-high', 'gain of the tool, high up, %', partial(gained, up_m=0.1), GAINS),
    Drift('gain-drift', 'the same, drifting', partial(gained, up_m=0.1, drifts=True), GAINS),
    Drift('gain-coil', 'one coil, high up, %', partial(gained, up_m=0.1, coils=ONE), GAINS),
    Drift('gain-coils', 'two coils, high up, %', partial(gained, up_m=0.1, coils=ALL[:2]), GAINS),
    Drift('gain-1', 'gain of the tool 1 %, gate', partial(gained, 1.0), (8.0, 20.0, 50.0)),
    Drift('gain-2', 'gain of the tool 2 %, gate', partial(gained, 2.0), (8.0, 20.0, 50.0)),
    Drift('gain-3', 'gain of the tool 3 %, gate', partial(gained, 3.0), GATES),
    Drift('swap', 'two coils are swapped, gate',
          partial(exchanged, 1.0, (4, 1, 2, 3, 0, 5, 6, 7, 8)), GATES),
    Drift('permuted', 'clusters permuted in one frame of',
          partial(exchanged, order=(3, 4, 5, 6, 7, 8, 0, 1, 2)), EVERY),
    Drift('exchanged', 'two clusters exchanged in one frame of',
          partial(exchanged, order=(3, 4, 5, 0, 1, 2, 6, 7, 8)), EVERY),
    Drift('turned-over', 'two coils alone exchanged in one frame of',
          partial(exchanged, order=(1, 0, *ALL[2:]), coils=ALL[:2]), EVERY),
    Drift('parallel', 'two parallel coils exchanged in one frame of',
          partial(exchanged, order=(0, 1, 8, 3, 4, 5, 6, 7, 2), coils=PARALLEL), ALWAYS),
    Drift('references-slow', 'references drift, all coils, %/min',
          partial(faded, references=32), SLOW_DRIFTS),
    Drift('drift-one', 'emitter drifts, one coil, %/min', partial(faded, coils=ONE), DRIFTS),
    Drift('drift-parallel', 'the same, two coils', partial(faded, coils=PARALLEL), DRIFTS),
    Drift('references-one', 'references drift, one coil, %/min',
          partial(faded, references=32, coils=ONE), DRIFTS),
    Drift('references-parallel', 'the same, two coils',
          partial(faded, references=32, coils=PARALLEL), DRIFTS),
    Drift('references-skipped', 'the same, all coils, frames lost', skipping, DRIFTS),
    Drift('references-metal', 'references drift, one coil, near moving metal',
          partial(faded, references=32, coils=ONE, metal=True), DRIFTS),
    Drift('fade-one', 'an emitter falls, no references, %/min', partial(faded, refit=False),
          DRIFTS),
    Drift('fade-all', 'all emitters fall, no references, %/min',
          partial(faded, emitters=EMITTERS, refit=False), DRIFTS),
    Drift('emitter-slide', 'an emitter slides, mm in 30 s', emitter_slid, (2.0, 6.0, 15.0)),
    Drift('emitter-slide-alone', 'the same, no references',
          partial(emitter_slid, refit=False), (2.0, 6.0, 15.0)),
    Drift('nominal-on', 'the drawing on a real board, seed', nominal_on, (1.0, 2.0, 3.0)),
)  # fmt: skip
"""What slides, bends and drifts together."""
