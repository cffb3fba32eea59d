"""Known metal: learning it, and following it by tools alone."""

import json
import re
from contextlib import redirect_stdout
from copy import deepcopy
from dataclasses import replace
from functools import partial
from io import StringIO
from types import SimpleNamespace

import known_metal_world as world
import numpy as np
import pytest
from tracking_world import NOISE_T, certain_model

from anser_ros.apps.lab import metal_follower, metal_learning, metal_track
from anser_ros.apps.lab.metal_follower import KnownMetalFollower, KnownMetalModels
from anser_ros.apps.lab.metal_lattice import Coils, KnownMetal, load_known_metal, moved
from anser_ros.apps.lab.metal_learning import learn_metal
from anser_ros.apps.lab.metal_track import Scene
from anser_ros.cli.main import main
from anser_ros.errors import BagError, FitError
from anser_ros.pose_states import MODEL_DOUBTFUL
from anser_ros.sessions.follower import with_references
from anser_ros.sessions.prepared import prepare
from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import save_model
from anser_ros.sessions.tracked_session import track_session
from anser_ros.tracking.estimate import TrackerSettings


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    """The lump on two ways, the board without it, and the board's model, as files."""
    folder, lump = tmp_path_factory.mktemp('known_metal'), world.lump()
    save_model(folder / 'model.yaml', certain_model())
    world.write(folder / 'scan.mcap', world.session(world.SWEEP, None, 10, 1))
    world.write(folder / 'sweep.mcap', world.session(world.SWEEP, lump, 38, 2, rate_hz=4.5))
    return folder


@pytest.fixture(scope='module', autouse=True)
def small():
    """A small lattice of few frames, and a follower that decides soon among few places."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(metal_learning, 'COUNTS', (3, 3, 2))
        patch.setattr(metal_learning, 'SPACINGS_M', (0.02, 0.03))
        patch.setattr(metal_learning, 'TRIAL_FRAMES', 6)
        patch.setattr(metal_learning, 'TRIAL_ROUNDS', 6)
        patch.setattr(metal_learning, 'ROUNDS', 12)
        patch.setattr(metal_learning, 'FRAMES', 30)
        patch.setattr(metal_learning, 'SMOOTHED', 2)
        patch.setattr(metal_follower, 'CANDIDATES', 2)
        patch.setattr(metal_follower, 'TRIAL_S', 0.5)
        yield


@pytest.fixture(scope='module')
def seen():
    """What the refit would find, which takes half a minute to prepare, is stated."""
    with pytest.MonkeyPatch.context() as patch:
        tables = SimpleNamespace(excitation=world.excitation())
        patch.setattr(metal_learning, 'build_tables', lambda *given, report: tables)
        patch.setattr(
            metal_learning, 'LiveRefit', lambda *given, **told: world.RefitThatSees(world.SWEEP)
        )
        yield


def learn_words(bags, out):
    return [
        'known_metal', str(bags / 'sweep.mcap'), '--model', str(bags / 'model.yaml'),
        '--baseline', str(bags / 'scan.mcap'), '--name', 'lump', '--out', str(out),
    ]  # fmt: skip


@pytest.fixture(scope='module')
def learnt(bags, seen):
    """What the command says that it has learnt from the sweep, and writes into a new folder."""
    with redirect_stdout(StringIO()) as said:
        assert main([*learn_words(bags, bags / 'made' / 'lump.yaml'), '--json']) == 0
    return json.loads(said.getvalue()), load_known_metal(bags / 'made' / 'lump.yaml')


@pytest.fixture(scope='module')
def known(learnt) -> KnownMetal:
    """The lump, learnt from the sweep."""
    return learnt[1]


@pytest.mark.long
class TestLearning:
    def test_it_tells_where_the_lump_was_and_what_drove_it(self, learnt):
        said, known = learnt
        assert said['name'] == known.name == 'lump' and said['points'] == 18
        for name in ('misfit', 'strongest_t', 'nearest_m'):
            assert said[name] == getattr(known, name)
        places, turns = world.SWEEP(np.linspace(0.0, 8.0, 30))
        spheres = places[:, None] + world.lump()[0] @ turns.swapaxes(1, 2)
        field = world.anser_board().field(spheres.reshape(-1, 3))
        driven = np.sqrt((field**2).sum(axis=2).mean(axis=1).max())
        away = spheres.reshape(-1, 1, 3) - world.references().position
        assert len(known.lattice) == 18
        assert 0.0 < known.misfit < 0.03
        assert known.strongest_t == pytest.approx(driven, rel=0.3)
        assert known.nearest_m == pytest.approx(np.linalg.norm(away, axis=2).min(), abs=0.02)
        extent = places.max(axis=0) - places.min(axis=0)
        np.testing.assert_allclose(known.high - known.low, extent, atol=0.03)
        spacing = np.ptp(known.lattice.points, axis=0)[0] / 2
        assert spacing == pytest.approx(0.02), 'the lump is 10 cm wide, its currents less'

    def test_what_no_piece_explains_is_refused(self, bags, seen, monkeypatch):
        monkeypatch.setattr(metal_learning, 'TRIAL_ROUNDS', 1)
        monkeypatch.setattr(metal_learning, 'ROUNDS', 2)
        frames, rng = frames_of(bags, 8), np.random.default_rng(9)
        torn = []
        for frame in frames:
            reading, *tools = frame.readings
            signs = rng.choice([-1.0, 1.0], reading.change.shape)
            torn.append(
                frame._replace(readings=(reading._replace(change=reading.change * signs), *tools))
            )
        given = world.excitation(), certain_model().frequencies_hz, volume_of(bags), NOISE_T
        with pytest.raises(FitError, match=r'^no rigid piece of metal .* \d+% of it is left'):
            learn_metal(torn, *given, 'lump')

    def test_a_session_without_what_is_needed_is_refused(self, bags, seen):
        session, scan = load_session(bags / 'sweep.mcap'), load_session(bags / 'scan.mcap')
        prepared = prepare(session, certain_model(), scan)
        (tool,) = session.tools
        blind = replace(tool, has_pose=np.zeros_like(tool.has_pose), track=None)
        for wrong, words in (
            (replace(prepared, session=with_references(session, [])), 'there are none'),
            (replace(prepared, session=replace(session, reference=None)), 'there are none'),
            (replace(prepared, baseline=None), 'metal is learnt against --baseline'),
            (
                replace(prepared, session=replace(session, tools=(blind,))),
                'no tool has optical poses while metal is there',
            ),
            (
                replace(
                    prepared,
                    session=replace(session, reference=session.reference.frames(slice(0, 20))),
                ),
                'the references see metal in 20 frames, 30 are needed',
            ),
        ):
            with pytest.raises(BagError, match=words):
                metal_learning.learn(wrong, 'lump')


def volume_of(bags):
    return prepare(load_session(bags / 'scan.mcap'), certain_model()).volume


def frames_of(bags, count):
    """So many frames of the sweep, as they are learnt from."""
    scan = load_session(bags / 'scan.mcap')
    prepared = prepare(load_session(bags / 'sweep.mcap'), certain_model(), scan)
    refit = world.RefitThatSees(world.SWEEP)
    return metal_learning.metal_frames(prepared, refit, world.PHASE, count)


@pytest.mark.long
def test_frames_hold_what_metal_adds_to_references_and_tools(bags, seen):
    frames = frames_of(bags, 5)
    assert len(frames) == 5 and frames[0].time == 0.0 and len(frames[0].readings) == 2
    table, tool = world.references(), world.TOOL
    for frame in frames:
        place, turn = (one[0] for one in world.SWEEP(np.array([frame.time])))
        np.testing.assert_allclose(frame.place, place + world.HIDDEN, atol=0.03)
        position, rotation = (one[0] for one in world.tool_path(np.array([frame.time])))
        geometry = (table.position, table.axis), tool.placed(position, rotation)
        for reading, (at, axes) in zip(frame.readings, geometry, strict=True):
            np.testing.assert_allclose(reading.coils.at, at, atol=1e-5)
            true = world.metal_flux(world.lump(), place, turn, at, axes) / world.PHASE
            assert np.abs(reading.change - true).max() < 8 * NOISE_T
    assert frames[0].readings[0].shared.shape[1] == 0
    assert frames[0].readings[1].shared.shape == (2 * 9 * 8, 6 + 7 * 9)


def follower_of(known, made) -> KnownMetalFollower:
    model, tools = certain_model(), made.setup.refit.tools
    scene = Scene(known, model, world.excitation(), made.sensors, tools, NOISE_T)
    return KnownMetalFollower(scene, prepare(made, model).volume)


def stamp(made, row) -> int:
    return world.START_NS + round(made.tools[0].time[row] * 1e9)


def followed(subject, made, rows):
    """Run over frames: whether the metal was followed, and why no pose is given."""
    out = []
    for row in rows:
        model, withheld = subject.at(stamp(made, row))
        assert (model is not subject.model) == subject.is_followed
        subject.take(stamp(made, row), world.readings(made, row))
        out.append((subject.is_followed, withheld))
    return out


@pytest.fixture(scope='module')
def dive():
    return world.session(world.DIVE, world.lump(), 25, 4)


@pytest.fixture(scope='module')
def begun(known, dive):
    """A follower after nine frames of metal that comes nearer and nearer, and what it did."""
    subject = follower_of(known, dive)
    return subject, followed(subject, dive, range(9))


@pytest.fixture
def subject(begun):
    """A follower that follows the lump after nine frames."""
    return deepcopy(begun[0])


@pytest.mark.long
class TestFollowing:
    def test_metal_is_followed_until_it_is_driven_too_strongly(self, begun, subject, dive):
        run = begun[1] + followed(subject, dive, range(9, 25))
        assert [is_followed for is_followed, _ in run] == [False] * 7 + [True] * 18
        assert not any(withheld for _, withheld in run[:12])
        for _, withheld in run[-3:]:
            assert withheld is not None and withheld.state == MODEL_DOUBTFUL
            words = r'lump is driven [12]\.\d times as strongly as it was learnt'
            assert re.fullmatch(words, withheld.reason)

    def test_metal_nearer_to_a_coil_than_learnt_withholds_poses(self, subject, dive):
        assert subject.at(stamp(dive, 9))[1] is None
        subject._scene.known = replace(subject._scene.known, nearest_m=0.5)
        _, withheld = subject.at(stamp(dive, 9))
        assert withheld is not None and withheld.state == MODEL_DOUBTFUL
        words = r'a coil is \d+ mm from lump, nearer than it was learnt'
        assert re.fullmatch(words, withheld.reason)

    def test_metal_that_answers_otherwise_withholds_poses_and_is_given_up(self, subject, dive):
        (tool,) = dive.tools
        clean = world.session(world.DIVE, None, 13, 4).tools[0].flux
        flux = tool.flux.copy()
        flux[9:13] = clean[9:] - 1.6 * (tool.flux[9:13] - clean[9:])
        run = followed(subject, replace(dive, tools=(replace(tool, flux=flux),)), range(9, 13))
        assert not run[0][1], 'the first such frame is not known yet'
        withheld = run[1][1]
        assert withheld is not None and withheld.state == MODEL_DOUBTFUL
        words = r'lump leaves \d\.\d times as much of the readings as expected'
        assert re.fullmatch(words, withheld.reason)
        assert not run[-1][0], 'given up'

    def test_the_uncertainty_of_the_field_is_that_of_the_metal(self, subject, dive):
        scene, state = subject._scene, subject._chosen.state
        scene.misfit = 1e-6
        at, axes = world.TOOL.placed(dive.tools[0].position[8], dive.tools[0].rotation[8])
        model, placed = metal_track.field_of(scene, state, at, 24, 1.0)
        modes = [replace(model, moments=one, modes=None).flux(at, axes) for one in model.modes]
        which = np.r_[0:6, 12 : 12 + len(state.answers)]
        spread = 0.01 * state.covariance[np.ix_(which, which)]
        draws = np.random.default_rng(13).multivariate_normal(np.zeros(len(which)), spread, 200)
        coils, change = Coils(at, axes, None), []
        before = scene.setting.flux(scene.lattice(state.answers), placed, coils)
        for draw in draws:
            lattice = scene.lattice(state.answers + draw[6:])
            there = scene.setting.placed(lattice, moved(state.pose, draw[:6]))
            change.append(scene.setting.flux(lattice, there, coils) - before)
        told, drawn = (
            np.abs(values).ravel() @ np.abs(values).ravel() for values in (modes, change)
        )
        assert 2.0 * told / drawn == pytest.approx(1.0, rel=0.25)

    def test_a_gap_in_time_forgets(self, subject, dive):
        assert subject.is_followed
        later = stamp(dive, 8) + 600_000_000
        model, withheld = subject.at(later)
        assert model is subject.model and withheld is None and not subject.is_followed

    def test_frames_without_readings_are_a_gap_too(self, subject, dive):
        for row in range(9, 12):
            subject.take(stamp(dive, row), [])
            assert subject.is_followed
        for row in range(12, 21):
            subject.take(stamp(dive, row), [])
        assert not subject.is_followed

    def test_an_earlier_recording_is_begun_anew(self, subject, dive):
        run = followed(subject, dive, range(9))
        assert not run[0][0] and run[8][0], 'forgotten, and found again'


def jumping(time):
    """The approach, with a jump sideways."""
    place, turn = world.APPROACH(time)
    return place + (time > 2.5)[:, None] * [-0.1, 0.05, 0.01], turn


def body_errors(evaluation):
    """Errors of the body's poses over their sigmas, and in m; NaN where there is none."""
    (series,) = evaluation.bodies.values()
    sigma = np.array([one.sigma_position_m for one in series.estimates])
    return series.position_error / sigma, series.position_error


@pytest.mark.long
class TestTracking:
    def test_its_poses_are_as_good_as_without_metal_and_honest(self, known):
        session, model = world.session(world.APPROACH, world.lump(), 50, 3), certain_model()
        tracked = track_session(session, model, models=partial(KnownMetalModels, known=known))
        frozen = track_session(session, model)
        late = np.arange(50) > 25
        score, error = body_errors(tracked)
        assert tracked.refit.states['followed'] >= 40
        assert np.isfinite(error).all() and score.max() < 3.0
        assert np.sqrt(np.mean(error[late] ** 2)) < 0.05e-3
        _, without = body_errors(frozen)
        assert np.isfinite(without[late]).mean() < 0.5, 'its poses are withheld'
        ungated = track_session(session, model, TrackerSettings(gate=np.inf))
        _, without = body_errors(ungated)
        assert np.sqrt(np.mean(error[late] ** 2)) < 0.1 * np.sqrt(np.mean(without[late] ** 2))

    def test_metal_that_jumps_is_caught_up_with_and_its_poses_are_honest(self, known):
        session = world.session(jumping, world.lump(), 50, 11)
        score, error = body_errors(
            track_session(session, certain_model(), models=partial(KnownMetalModels, known=known))
        )
        good = np.isfinite(error)
        assert good[:30].all() and good[-8:].all()
        assert score[good].max() < 3.0

    @pytest.mark.parametrize(
        'metal', [None, ('ferrite_steel', 0.06, 5)], ids=['no metal', 'other metal']
    )
    def test_without_the_metal_all_is_as_with_the_calibrated_model(self, known, metal):
        lump = None if metal is None else world.lump(*metal)
        session, model = world.session(world.APPROACH, lump, 12, 12), certain_model()
        tracked = track_session(session, model, models=partial(KnownMetalModels, known=known))
        frozen = track_session(session, model)
        assert tracked.refit.states == {'not_found': 12}
        both = {**tracked.bodies, **tracked.sensors}
        for name, series in {**frozen.bodies, **frozen.sensors}.items():
            others = both[name].estimates
            for one, other in zip(series.estimates, others, strict=True):
                assert one.state == other.state
                np.testing.assert_array_equal(one.position, other.position)
                np.testing.assert_array_equal(one.rotation, other.rotation)


def refused(arguments, words, capsys):
    assert main(arguments) == 2
    said = capsys.readouterr()
    assert said.err.startswith(f'anser {arguments[0]}: ') and words in said.err
    assert said.out == '' and said.err.count('\n') == 1


@pytest.mark.long
class TestCommands:
    def test_evaluate_says_in_how_many_frames_it_was_followed(
        self, bags, known, capsys, monkeypatch
    ):
        monkeypatch.setattr('anser_ros.cli.evaluate.write_figures', lambda *given, **told: [])
        world.write(bags / 'short.mcap', world.session(world.APPROACH, world.lump(), 12, 3))
        words = ['evaluate', str(bags / 'short.mcap'), '--model', str(bags / 'model.yaml')]
        out = bags / 'followed'
        words += ['--known-metal', str(bags / 'made' / 'lump.yaml'), '--out', str(out)]
        assert main(words) == 0
        states = json.loads((out / 'evaluation.json').read_text())['refit']['states']
        assert states == {'followed': 4, 'not_found': 8}
        said = 'known metal: not_found in 8 frames, followed in 4 frames'
        assert said in ' '.join(capsys.readouterr().out.split())
        assert (out / 'poses.csv').read_text().count('\n') > 12 * 9

    @pytest.mark.parametrize(
        ('change', 'value', 'words'),
        [
            ('--baseline', 'sweep.mcap', 'baseline'),
            ('--baseline', 'none.mcap', 'none.mcap: no such bag'),
            ('--model', 'none.yaml', 'none.yaml: No such file'),
            ('--name', ' ', '--name must not be empty'),
            ('--out', 'scan.mcap/x.yaml', 'scan.mcap'),
            ('known_metal', 'plain.mcap', 'there are none'),
        ],
    )
    def test_what_nothing_is_learnt_from_is_a_line(
        self, bags, seen, monkeypatch, capsys, change, value, words
    ):
        monkeypatch.chdir(bags)
        if not (bags / 'plain.mcap').exists():
            made = world.session(world.SWEEP, None, 3, 1)
            world.write(bags / 'plain.mcap', replace(made, reference=None))
        arguments = learn_words(bags, bags / 'new.yaml')
        arguments[arguments.index(change) + 1] = value
        refused(arguments, words, capsys)
        assert not (bags / 'new.yaml').exists()

    @pytest.mark.parametrize(
        ('others', 'words'),
        [
            (['--refit', '--baseline', 'scan.mcap'], 'leave out --refit, --baseline'),
            (['--witnesses'], 'leave out --witnesses'),
            (['--in-phase'], 'leave out --in-phase'),
            (['--known-metal', 'none.yaml'], 'none.yaml: No such file'),
            (['--known-metal', 'model.yaml'], "its schema must be 'anser_known_metal/1'"),
            (['--known-metal', 'scan.mcap'], 'scan.mcap: not'),
        ],
    )
    def test_what_is_not_evaluated_with_it_is_a_line(
        self, bags, known, monkeypatch, capsys, others, words
    ):
        monkeypatch.chdir(bags)
        arguments = ['evaluate', 'sweep.mcap', '--model', 'model.yaml', '--out', 'refused']
        refused([*arguments, '--known-metal', 'made/lump.yaml', *others], words, capsys)
        assert not (bags / 'refused').exists()
