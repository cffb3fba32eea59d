"""Calibration from what leaves a free field open: a plate's places, and a tool moved by hand.

The worlds are boards whose coils are each a little off, by Biot and Savart along their tracks.
"""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from calibration_world import hand, tool_of
from conftest import REPO
from scipy.spatial.transform import Rotation

from anser_ros.calibration.calibrate import Options
from anser_ros.calibration.result import to_document
from anser_ros.calibration.sensor_parameters import KINDS
from anser_ros.cli.evaluate import why_withheld
from anser_ros.cli.main import main
from anser_ros.errors import FitError
from anser_ros.field.measurements import Measurements
from anser_ros.physics.board import loop_field
from anser_ros.physics.rotations import tilted
from anser_ros.physics.sensor import SensorTable
from anser_ros.sessions.calibration import calibrate_sessions
from anser_ros.sessions.nominal_board import board_of
from anser_ros.sessions.session import Session, load_session
from anser_ros.sessions.starting_model import load_model
from anser_ros.sessions.tracked_session import track_session

NOISE_T, START = 40e-12, 1_700_000_000_000_000_000
PROBE = SensorTable(
    np.zeros(1, int), ('probe/0/z',), ('probe',), np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]),
    np.zeros(1),
)  # fmt: skip


class World:
    """A board whose coils are off in place, tilt and strength, and in shape all alike."""

    def __init__(self, setup, seed):
        board = board_of(setup)
        artwork = np.array([[0.997, 0.005, 0.0], [0.005, 0.997, 0.0], [0.0, 0.0, 1.0]])
        self.setup, self.board = setup, replace(board, shape=board.shape @ artwork)
        rng = self.rng = np.random.default_rng(seed)
        count = len(self.board.names)
        self.shift = 4e-4 * rng.normal(size=(count, 3))
        self.turn = Rotation.from_rotvec(6e-3 * rng.normal(size=(count, 3))).as_matrix()
        self.strength = 1.0 + 0.012 * rng.normal(size=count)

    def field(self, points):
        """Fluxes density (P, K, 3), T."""
        board = self.board
        coils = zip(board.rotations, board.centres, self.shift, self.turn, strict=True)
        paths = [board.shape @ (own @ turn).T + at + off for turn, at, off, own in coils]
        made = [loop_field(path, points, board.current_a) for path in paths]
        return np.stack(made, axis=1) * self.strength[:, None]

    def flux(self, points, axes):
        """Noisy fluxes (F, S, K) of coils (F, S, 3)."""
        field = self.field(points.reshape(-1, 3)).reshape(*points.shape[:2], -1, 3)
        flux = np.einsum('fski,fsi->fsk', field, axes)
        parts = self.rng.normal(size=(2, *flux.shape))
        return flux + NOISE_T * (parts[0] + 1j * parts[1])

    def session(self, body, table, flux, position=None, rotation=None):
        """A session of one body, posed or not."""
        count = len(flux)
        posed = position is not None
        tool = Measurements(
            body, table, np.arange(float(count)), flux, np.ones(flux.shape[:2], bool),
            np.zeros(flux.shape[:2], int),
            position if posed else np.full((count, 3), np.nan),
            rotation if posed else np.full((count, 3, 3), np.nan), np.full(count, posed),
        )  # fmt: skip
        specs = tuple(
            replace(
                self.setup.tool_sensors[0], channel=i, name=name, body=body,
                position_m=tuple(table.position[i]), axis=tuple(table.axis[i]), length_m=0.0,
            )
            for i, name in enumerate(table.name)
        )  # fmt: skip
        return Session('own.mcap', replace(self.setup, sensors=specs), START, (tool,), None)

    def grid(self, heights=(0.084,)):
        """A plate of 7 x 7 places, typed as drawn, and put down 0.5 mm off."""
        rng, steps = self.rng, 0.04286 * (np.arange(7) - 3.0)
        typed = np.array([[x, y, z] for z in heights for y in steps for x in steps])
        turn = Rotation.from_rotvec(4e-3 * rng.normal(size=3)).as_matrix()
        true = typed @ turn.T + 5e-4 * rng.normal(size=3) + 1e-4 * rng.normal(size=typed.shape)
        axis = tilted(
            np.tile(turn[:, 2], (len(typed), 1)), 0.005 * rng.normal(size=(len(typed), 2))
        )
        flux = 1.01 * self.flux(true[:, None], axis[:, None])
        flat = np.tile(np.eye(3), (len(typed), 1, 1))
        return self.session('probe', PROBE, flux, typed, flat)

    def waved(self, seconds):
        """A tool of nine coils, each a little off, moved by hand without a camera."""
        rng, table = self.rng, tool_of(9)
        true = replace(
            table, position=table.position + 2e-4 * rng.normal(size=(9, 3)),
            axis=tilted(table.axis, 0.01 * rng.normal(size=(9, 2))),
        )  # fmt: skip
        position, turn = hand(np.arange(0.0, seconds, 0.1))
        flux = self.flux(*true.placed(position, turn.as_matrix()))
        return self.session('tool', table, flux * (1.0 + 0.01 * rng.normal(size=9))[:, None])

    def error_m(self, model):
        """How far coils are found off, m: as they are, and after one rigid registration."""
        places = self.rng.uniform([-0.11, -0.11, 0.1], [0.11, 0.11, 0.2], (200, 3))
        axes = self.rng.normal(size=(200, 3))
        axes /= np.linalg.norm(axes, axis=1)[:, None]
        step = 1e-5
        made = [
            model.flux(places + way, axes) for way in np.vstack([np.zeros(3), np.eye(3) * step])
        ]
        slope = [(one - made[0]).real / step for one in made[1:]]
        turns = [model.flux(places, np.eye(3)[[j]].repeat(200, 0)).real for j in range(3)]
        true = np.einsum('pki,pi->pk', self.field(places), axes)
        left = true - made[0].real
        steps = np.array(
            [
                np.linalg.lstsq(np.stack([*s, *t], axis=1), one, rcond=1e-6)[0][:3]
                for s, t, one in zip(np.stack(slope, 1), np.stack(turns, 1), left, strict=True)
            ]
        )
        found = places + steps
        return _rms(found - places), _rms(_registered(found, places) - places)


def _rms(error):
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def _registered(places, onto):
    turn, _ = Rotation.align_vectors(onto - onto.mean(axis=0), places - places.mean(axis=0))
    return turn.apply(places - places.mean(axis=0)) + onto.mean(axis=0)


@pytest.fixture(scope='module')
def setup():
    return load_session(REPO / 'bags' / 'factory.mcap').setup


def calibrated(session):
    return calibrate_sessions([session], Options(estimate=KINDS))


@pytest.mark.parametrize(('heights', 'most_m'), [((0.084,), 2.5e-4), ((0.084, 0.15), 1e-4)])
def test_a_plate_of_typed_places_calibrates(setup, heights, most_m):
    world = World(setup, 5)
    result = calibrated(world.grid(heights))
    raw, registered = world.error_m(result.model)
    assert registered < most_m
    assert raw < 1e-3
    assert raw < 3.0 * np.sqrt(3.0) * result.model.shift_sigma_m + 3.0 * most_m
    assert result.better_than_nominal
    assert result.fit.noise_t < 1.5 * NOISE_T
    rows = to_document(result)['emitters']
    found = np.array([row['shift_m'] for row in rows])
    sigma = np.array([row['uncertainty']['shift_m'] for row in rows])
    assert (np.abs(found - world.shift) < 4.0 * sigma).mean() > 0.95
    assert np.corrcoef(found.ravel(), world.shift.ravel())[0, 1] > 0.6
    words = ' '.join(row['words'] for row in rows)
    assert re.search(r'coil\d sits 0\.\d ± 0\.\d mm further \w+ than drawn', words)
    assert 'frame' in result.undetermined[0]


@pytest.mark.parametrize(
    ('change', 'said'),
    [
        (
            lambda places: places * [0.98, 0.98, 1.0],
            r'the plate comes out [12]\.\d % larger than typed',
        ),
        (lambda places: places * [0.98, 1.0, 1.0], r'along x 1\.\d % larger and along y 0'),
        (lambda places: places + 3e-3 * np.eye(len(places))[24][:, None], r'mm is \d\.\d mm off'),
    ],
)
def test_a_pitch_or_a_place_that_is_a_little_wrong_is_said(setup, change, said):
    session = World(setup, 5).grid([0.084])
    (tool,) = session.tools
    some = calibrated(replace(session, tools=(tool.frames(np.arange(49) != 30),)))
    assert not some.contradictions
    assert '1 of the 49 places of the lattice have no reading' in ' '.join(some.undetermined)
    beside = tool.position + 2e-3 * np.eye(49)[24][:, None] * [1, 0, 0]
    beside = calibrated(wrongly(session, position=beside, flux=1.06 * tool.flux))
    assert 'of the lattice' not in ' '.join(beside.undetermined)
    assert re.search(r'all emitters come out \d\.\d % stronger', ' '.join(beside.contradictions))
    with pytest.raises(FitError, match='the drawn board, which such readings suffice for'):
        calibrate_sessions([session], Options(estimate=()))
    wrong = replace(session, tools=(replace(tool, position=change(tool.position)),))
    assert re.search(said, ' '.join(calibrated(wrong).contradictions))


def test_an_emitter_that_warms_up_while_a_plate_is_read_is_learnt_beside_the_board(setup):
    world = World(setup, 5)
    session = world.grid([0.084])
    (tool,) = session.tools
    gain = np.ones((49, 1, 8))
    gain[:, 0, 3] += 0.03 * (1.0 - np.exp(-tool.time / 60.0))
    result = calibrated(wrongly(session, flux=tool.flux * gain))
    assert world.error_m(result.model)[1] < 3e-4
    rows = [str(row['words']) for row in to_document(result)['emitters']]
    assert re.search(r'coil3 .*became [12]\.\d % stronger while it was read', ' '.join(rows)), rows
    assert sum('while' in row for row in rows) == 1
    assert result.model.provenance['emitter_strengths'].startswith('those at the start')


def test_a_tool_moved_by_hand_calibrates_without_a_camera(setup):
    world = World(setup, 6)
    result = calibrated(world.waved(15.0))
    raw, registered = world.error_m(result.model)
    assert registered < 2e-4
    assert raw < 1.5e-3
    names = {effect.name for effect in result.model.effects}
    assert {'sensor_gain_spread', 'sensor_axis_spread', 'sensor_place_spread'} <= names


def test_two_bodies_whose_coils_have_the_same_channel_are_refused(setup):
    session = World(setup, 6).waved(2.0)
    other = replace(session, tools=tuple(replace(m, body='probe') for m in session.tools))
    with pytest.raises(FitError, match='channel 0 is a coil of tool and of probe'):
        calibrate_sessions([session, other], Options(estimate=KINDS))


@pytest.mark.parametrize(('emitters', 'seed'), [([1, 3, 6], 12), ([0, 1, 2, 4, 5, 7], 13)])
def test_a_board_of_few_emitters_calibrates_by_whole_tools(setup, emitters, seed):
    coils = tuple(setup.emitter.coils[k] for k in emitters)
    world = World(replace(setup, emitter=replace(setup.emitter, coils=coils)), seed)
    session = world.waved(12.0)
    model = calibrated(session).model
    tracked = track_session(session, model)
    words = ' '.join(why_withheld(model, tracked, session))
    few = r'coils are withheld, state ambiguous in (\d+) of \1 \(3 readings are too few'
    assert bool(words) == (len(emitters) < 5) == bool(re.search(few, words)), words
    series = tracked.bodies['tool']
    assert series.ok.mean() > 0.95
    position, _ = hand(session.tools[0].time / 10.0)
    found = [(e, p) for e, p in zip(series.estimates, position, strict=True) if e.state == 'ok']
    places, error = np.array([e.position for e, _ in found]), [e.position - p for e, p in found]
    assert _rms(np.array(error)) < 2e-3
    true = np.array([p for _, p in found])
    assert _rms(_registered(places, true) - true) < 6e-4
    sigma = np.array([e.sigma_position_m for e, _ in found])
    assert np.mean(np.linalg.norm(error, axis=1) > 3.0 * sigma) < 0.01


@pytest.mark.long
def test_the_command_calibrates_a_tool_that_was_waved(shared, tmp_path):
    folder, out = shared / 'sessions' / 'nocamera', tmp_path / 'model.yaml'
    waved = str(folder / 'waved_short.mcap')
    assert main(['calibrate', waved, '--out', str(out), '--report', str(tmp_path)]) == 0
    document = json.loads((tmp_path / 'calibration.json').read_text())
    emitter = document['emitters'][7]
    assert {'name', 'flux_rmse_t', 'tilt_rad', 'strength', 'uncertainty'} <= {*emitter}
    assert len(document['frame']['shift_sigma_m']) == len(document['frame']['turn_sigma_rad']) == 3
    session, true = load_session(folder / 'check_tool.mcap'), folder / 'check_tool_truth.npz'
    tracked = track_session(session, load_model(out)).sensors.values()
    error, sigma, known = [], [], []
    for series, places in zip(tracked, np.load(true)['p'].swapaxes(0, 1), strict=True):
        known.append(series.ok)
        found = [e for e, ok in zip(series.estimates, series.ok, strict=True) if ok]
        error.append((np.array([e.position for e in found]), places[series.ok]))
        sigma += [np.sqrt(np.trace(e.covariance[:3, :3])) for e in found]
    found, places = (np.concatenate(part) for part in zip(*error, strict=True))
    assert np.mean(known) > 0.99
    assert _rms(_registered(found, places) - places) < 1.3e-4
    assert _rms(found - places) < 6e-4
    assert np.mean(np.linalg.norm(found - places, axis=1) > 3.0 * np.array(sigma)) < 0.01


def wrongly(session, **parts):
    (tool,) = session.tools
    return replace(session, tools=(replace(tool, **parts),))


def test_what_was_typed_wrongly_is_named_with_its_size(setup):
    session = World(setup, 7).grid()
    (tool,) = session.tools
    with pytest.raises(
        FitError, match=r'1\.3\d\d times as far apart as typed: 4\d\.\d\d mm where 31'
    ):
        calibrated(wrongly(session, position=tool.position * [0.7408, 0.7408, 1.0]))
    with pytest.raises(FitError, match=r'0\.001 times as far apart as typed: 4\d\.\d\d mm'):
        calibrated(wrongly(session, position=1e3 * tool.position))
    over = np.diag([1.0, -1.0, -1.0])
    below = {'position': tool.position @ over + [0, 0, 0.168], 'rotation': tool.rotation @ over}
    for wrong in ({'flux': -tool.flux}, below):
        with pytest.raises(FitError, match=r'points the other way than typed, by 1[78]'):
            calibrated(wrongly(session, **wrong))
    with pytest.raises(FitError, match=r'are 1\.2\d times what the drawn board gives'):
        calibrated(wrongly(session, flux=1.22 * tool.flux))
    coils = np.arange(8)
    for words, flux in {
        r'coil0 and coil1 alone .* exchanged\?': tool.flux[:, :, np.r_[1, 0, 2:8]],
        r'coil3 alone .* in reverse\?': tool.flux * np.where(coils == 3, -1.0, 1.0),
        r'coil3 alone .* dead\?': tool.flux * np.where(coils == 3, 0.02, 1.0),
        r'coil3 gives nothing but noise.*dead': tool.flux * np.where(coils == 3, 1e-6, 1.0),
        'coil3 gives nothing but': tool.flux * np.where(coils == 3, np.nan, 1.0),
        'are 90 deg off in phase': 1j * tool.flux,
    }.items():
        valid = np.isfinite(flux).all(axis=2)
        with pytest.raises(FitError, match=words):
            calibrated(wrongly(session, flux=flux, valid=valid))
    rest = tool.frames(np.delete(np.arange(49), 16))
    same = {key: getattr(tool, key)[:48] for key in ('time', 'position', 'rotation')}
    with pytest.raises(FitError, match=r'one of the typed places 1\d to 1\d was missed'):
        calibrated(replace(session, tools=(replace(rest, **same),)))
    quarter = tool.position @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    shuffled = np.random.default_rng(0).permutation(tool.position)
    wrongs = {
        r'mirrored, x has the other sign: .* \d+ mm \(median\), .* \d mm with': [-1, 1, 1]
        * tool.position,
        r'mirrored, y has the other sign': tool.position * [1, -1, 1],
        r'x and y are exchanged: .* \d mm with that undone': tool.position[:, [1, 0, 2]],
        r'exchanged, and their signs': tool.position[:, [1, 0, 2]] * [-1, -1, 1],
        r'plate is turned by (89|9\d) deg, and -?\d, -?\d, -?\d mm away': quarter,
        r'plate is turned by -?\d deg, and 2\d, -?\d, -?\d mm away': tool.position - [0.025, 0, 0],
        r'typed 84 mm below the board and lies 8\d mm above': tool.position * [1, 1, -1],
        r'typed 0 mm over the board .* the height missing': tool.position * [1, 1, 0],
        r'another order: reading \d+ was taken at place \d+; .* up to \d+ mm': shuffled,
    }
    for words, position in wrongs.items():
        with pytest.raises(FitError, match=words):
            calibrated(wrongly(session, position=position))


def test_readings_of_no_such_board_are_refused(setup):
    session = World(setup, 8).grid()
    (tool,) = session.tools
    other = 1.0 + 0.03 * np.random.default_rng(8).normal(size=tool.flux.shape)
    with pytest.raises(FitError, match='one plane'):
        calibrated(wrongly(session, flux=tool.flux * other))
    session = World(setup, 8).waved(8.0)
    (tool,) = session.tools
    with pytest.raises(FitError, match=r'no board like the drawn one|frames whose coils'):
        calibrated(wrongly(session, flux=tool.flux[:, :, [1, 0, 2, 3, 4, 5, 6, 7]]))
