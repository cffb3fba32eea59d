"""Published protocols: against closed forms and truth, by MITK's names, and over sessions."""

import json

import numpy as np
import pytest
from pose_world import World, write_tum
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.assessment.distances import (
    Grid,
    distance_errors,
    grid_points,
    have_common_errors,
    point_to_point,
    rotation_errors,
    single_point,
    standing_alone,
)
from anser_ros.apps.poses.assessment.history import ALERT, FAIL, NOTE, PASS, judged
from anser_ros.apps.poses.assessment.protocols import assess_motion
from anser_ros.apps.poses.assessment.rest import StillPoint, metal_shifts, still_points
from anser_ros.apps.poses.hand_eye import fit_hand_eye
from anser_ros.apps.poses.importing import write_pose_session
from anser_ros.apps.poses.sequence import sequence_of
from anser_ros.cli.main import run_verb
from anser_ros.errors import FitError, ParameterError

pytestmark = pytest.mark.long

RATE = 20.0
STILL = np.array([0.0, 0.0, 0.0, 1.0])


def rng_of(seed):
    return np.random.default_rng(seed)


def point(place, turn=None):
    return StillPoint(0.0, 1.0, np.asarray(place), np.eye(3) if turn is None else turn, 0.0, 9)


def board(rows, columns, spacing=0.05):
    return np.array([[r * spacing, c * spacing, 0.0] for r in range(rows) for c in range(columns)])


def visited(points, turns, seed, noise_m=2e-4):
    """Poses of a tool that rests on points for two seconds each, and is lifted in between."""
    rng, places, ways = rng_of(seed), [], []
    for k, (here, turn) in enumerate(zip(points, turns, strict=True)):
        count = int(rng.uniform(34, 46))
        places += [here] * count
        ways += [turn] * count
        if k + 1 < len(points):
            between = (turns[k + 1] * turn.inv()).as_rotvec()
            for u in np.linspace(0, 1, 22)[1:-1]:
                lift = np.array([0, 0, 0.12 * u * (1 - u)])
                places.append(here + (points[k + 1] - here) * u + lift)
                ways.append(Rotation.from_rotvec(u * between) * turn)
    place = np.array(places)
    turn = Rotation.from_rotvec(2e-3 * rng.normal(size=place.shape)) * Rotation.concatenate(ways)
    place = place + noise_m * rng.normal(size=place.shape)
    return sequence_of('pen', np.arange(len(place)) / RATE, place, turn.as_quat())


def resting(place, time=None, turns=STILL):
    """Poses at places (n, 3), one each 50 ms, that never turn."""
    time = np.arange(len(place)) / RATE if time is None else time
    return sequence_of('pen', time, place, np.tile(turns, (len(place), 1)))


def write_poses(path, poses):
    return write_tum(path, poses, 1.7e9)  # a date, by which sessions are ordered


class TestPauses:
    @pytest.mark.parametrize('noise_m', [1e-4, 1.5e-3])
    def test_every_rest_is_one_point(self, noise_m):
        rng = rng_of(6)
        true = board(3, 4)
        turns = [Rotation.from_rotvec(rng.normal(0, 0.05, 3)) for _ in true]
        found = still_points(visited(true, turns, 6, noise_m))
        assert len(found) == 12
        place = np.array([p.position for p in found])
        assert np.abs(place - true).max() < 5 * noise_m / np.sqrt(20)
        assert all(0.5 < p.jitter_m / (noise_m * np.sqrt(3)) < 1.5 for p in found)

    def test_a_moving_tool_has_none(self):
        time = np.arange(0, 20, 0.05)
        place = np.stack([0.1 * np.sin(time), 0.1 * np.cos(time), 0 * time], axis=1)
        assert still_points(resting(place)) == []

    @pytest.mark.parametrize('interval_s', [0.02, 1.0])
    def test_a_scan_that_steps_on_with_every_pose_has_none(self, interval_s):
        place = board(31, 31, 0.01)
        assert still_points(resting(place, interval_s * np.arange(len(place)))) == []

    def test_all_poses_of_a_recording_at_rest_count(self):
        """As in MITK, which averages all samples of a point."""
        poses = visited(np.array([[0.1, 0.2, 0.3]]), [Rotation.identity()], 8)
        (found,) = still_points(poses)
        assert found.n == poses.size
        np.testing.assert_array_equal(found.position, poses.position.mean(axis=0))


class TestHummel:
    def test_distances_and_descriptions_are_mitks(self):
        grid = Grid.of(90, None, 0.05)
        place = board(9, 10)
        place[0] += [0.0, 0.0012, 0.0]  # the first hole is nearer to its neighbour in the row
        found = distance_errors(place.reshape(9, 10, 3), grid, rng_of(1))
        assert {name: g.errors.size for name, g in found.items()} == {
            '5 cm distance errors': 161, '15 cm distance errors': 123,
            '30 cm distance errors': 66, 'accumulated distance errors': 81,
        }  # fmt: skip
        five = found['5 cm distance errors']
        assert five.descriptions[0] == 'Distance(1) 1/1 to 1/2'
        assert five.descriptions[81] == 'Distance(82) 1/1 to 2/1'
        assert five.descriptions[-1] == 'Distance(161) 8/10 to 9/10'
        assert five.signed[0] == pytest.approx(-1.2) and five.errors[0] == pytest.approx(1.2)
        assert np.count_nonzero(five.errors > 1e-9) == 2
        accumulated = found['accumulated distance errors']
        assert accumulated.descriptions[8] == 'Distance(9) 1/1 to 1/10'
        np.testing.assert_allclose(accumulated.errors[:9], 1.2)
        small = distance_errors(board(3, 4).reshape(3, 4, 3), Grid.of(12, None, 0.05), rng_of(1))
        words = small['5 cm distance errors'].descriptions
        assert len(words) == 17
        assert (words[0], words[-1]) == ('Distance 4/4 to 4/5', 'Distance 5/7 to 6/7')

    def test_points_in_another_order_are_refused(self):
        grid, place = Grid.of(25, None, 0.05), board(5, 5).reshape(5, 5, 3)
        turned = place.copy()
        turned[1::2] = turned[1::2, ::-1]
        points = [point(p) for p in turned.reshape(-1, 3)]
        with pytest.raises(FitError, match='--order serpentine'):
            grid_points(points, grid)
        np.testing.assert_array_equal(grid_points(points, grid, 'serpentine'), place)
        shuffled = [points[k] for k in rng_of(1).permutation(25)]
        with pytest.raises(FitError, match='row by row'):
            grid_points(shuffled, grid)
        with pytest.raises(ParameterError, match='--grid'):
            Grid.of(24, None, 0.05)
        small = [point(p) for p in board(3, 4)]
        with pytest.raises(FitError, match='--grid 3x4'):
            grid_points(small, Grid.of(12, (4, 3), 0.05))

    def test_the_interval_holds_what_repetition_gives(self):
        grid, true, rng = Grid.of(12, None, 0.05), board(3, 4).reshape(3, 4, 3), rng_of(8)
        noisy = true + rng.normal(0, 4e-4, (2000, *true.shape))
        many = np.abs(np.linalg.norm(np.diff(noisy, axis=2), axis=3) * 1e3 - 50)
        hits = []
        for _ in range(60):
            noisy = true + rng.normal(0, 4e-4, true.shape)
            found = distance_errors(noisy, grid, rng)['5 cm distance errors'].summary['Mean']
            hits.append(found.low < np.mean(many) < found.high)
        assert 0.83 < np.mean(hits) <= 1.0

    def test_a_distorted_field_makes_intervals_wide_enough(self):
        """Lines beside each other err alike then: drawing them again one by one is too sure."""
        grid, true = Grid.of(90, None, 0.05), board(9, 10)
        away = np.linalg.norm(true[:, None] - true[None], axis=2)
        root = 1e-3 * np.linalg.cholesky(np.exp(-50 * away**2) + 1e-9 * np.eye(90))

        def boards(seeds):
            for seed in seeds:
                smooth, noise = rng_of(seed).normal(size=(2, 90, 3))
                yield (true + root @ smooth + 3e-4 * noise).reshape(9, 10, 3)

        def sizes(place):
            return np.abs(np.linalg.norm(place[:, 3:] - place[:, :-3], axis=2) - 0.15) * 1e3

        mean = np.mean([sizes(place).mean() for place in boards(range(8000, 8400))])
        hits, alike = [], []
        for place in boards(range(8400, 8425)):
            alike.append(have_common_errors(place, grid))
            found = distance_errors(place, grid, rng_of(1))['15 cm distance errors']
            hits.append(found.summary['Mean'].low < mean < found.summary['Mean'].high)
        assert all(alike) and np.mean(hits) > 0.88
        quiet = true.reshape(9, 10, 3) + rng_of(3).normal(0, 3e-4, (9, 10, 3))
        assert not have_common_errors(quiet, grid)
        narrow = distance_errors(quiet, grid, rng_of(1))['15 cm distance errors'].summary['Mean']
        assert narrow.high - narrow.low < 0.5 * narrow.value

    def test_turns_of_the_ring(self):
        angles = np.cumsum([0.0, 11.25, 11.75, 10.25])
        turns = Rotation.from_rotvec(np.deg2rad(angles)[:, None] * [[0.0, 0.0, 1.0]])
        points = [point(np.zeros(3), m) for m in turns.as_matrix()]
        found = rotation_errors(points, 11.25, None, rng_of(1))
        np.testing.assert_allclose(found.signed, [0.0, 0.5, -1.0], atol=1e-9)
        assert found.descriptions[0] == 'Rotation Error ROT1 / ROT2'
        along = rotation_errors(points, 11.25, np.array([1.0, 0.0, 0.0]), rng_of(1))
        np.testing.assert_allclose(along.signed, found.signed, atol=1e-9)
        with pytest.raises(FitError, match='order of the holes'):
            rotation_errors(points, 11.25, np.array([0.0, 0.0, 1.0]), rng_of(1))

    def test_metal_shifts_a_tool_at_rest(self):
        rng = rng_of(9)

        def rest(shift):
            return resting([shift, 0.0, 0.2] + 2e-4 * rng.normal(size=(600, 3)))

        found = metal_shifts(rest(0.0), [rest(1e-3), rest(0.0)])
        assert found['position_shift_1_m'].low < 1e-3 < found['position_shift_1_m'].high
        assert found['position_shift_2_m'].low < 2e-5 < found['position_shift_1_m'].low


class TestF2554:
    def test_a_scale_error_is_in_every_distance(self):
        true = rng_of(3).uniform(0, 0.3, (12, 3))
        measured = 1.01 * true @ Rotation.random(random_state=1).as_matrix()
        group, estimates = point_to_point([point(p) for p in measured], true, rng_of(1))
        first, second = np.triu_indices(12, 1)
        wanted = np.linalg.norm(true[first] - true[second], axis=1)
        np.testing.assert_allclose(group.signed, 1e3 * 0.01 * wanted, rtol=1e-9)
        mean = estimates['mean_error_m']
        assert mean.value == pytest.approx(0.01 * wanted.mean()) and mean.low > 0
        with pytest.raises(FitError, match='not in the order'):
            point_to_point([point(p) for p in measured[::-1] * [9, 1, 1]], true, rng_of(1))
        measured[3] += [0.0, 0.0, 0.02]
        number, before, after = standing_alone(measured, true)
        assert number == 3 and after < 0.5 * before
        assert standing_alone(np.delete(measured, 3, axis=0), np.delete(true, 3, axis=0)) is None
        with pytest.raises(FitError, match='the truth has 12'):
            point_to_point([point(p) for p in measured[:5]], true, rng_of(1))

    def test_readings_of_one_location(self):
        rng = rng_of(4)
        place = [0.1, 0.0, 0.2] + 3e-4 * rng.normal(size=(400, 3))
        group, estimates = single_point(resting(place), rng)
        assert group.summary['RMS'].low < 3e-4 * np.sqrt(3) * 1e3 < group.summary['RMS'].high
        assert 1e-3 < estimates['span_m'].value < 3e-3
        with pytest.raises(FitError, match='state the tip with --tip'):
            single_point(resting(300 * (place - place[0])), rng)


def test_latency_and_error_by_speed():
    world = World(4300, sensors=1, duration=25.0)
    world.offset = 0.04
    found = fit_hand_eye(world.session())
    estimates, groups = assess_motion(found, 'sensor_0', rng_of(1))
    latency = estimates['latency_s']
    assert latency.low < 0.04 < latency.high and latency.high - latency.low < 4e-3
    slow, fast = groups[0], groups[-1]
    assert fast.latency_s.low < 0.04 < fast.latency_s.high
    # What is late by 40 ms is off by as much of its way.
    assert fast.error_live_rms_m.value > 0.03 * fast.speed_low_m_s
    assert slow.error_rms_m.value < 1e-3 < fast.error_live_rms_m.value


class TestControl:
    QUIET = (1.00, 1.02, 0.98, 1.01, 0.99, 1.0)

    @pytest.mark.parametrize(
        ('value', 'earlier', 'tolerance', 'state'),
        [
            (1.01, QUIET, None, PASS), (1.1, QUIET, None, NOTE), (1.3, QUIET, None, ALERT),
            (0.7, QUIET, None, ALERT), (1.1, 5 * QUIET, None, ALERT), (1.01, QUIET, 0.5, FAIL),
            (9.0, QUIET[:4], None, PASS),
            (9.0, QUIET[:4], 2.0, FAIL), (float('nan'), QUIET, None, FAIL),
            (1.02, (0.9, 1.0, 0.95, 1.02, *[1.01] * 7), None, NOTE),
        ],
    )  # fmt: skip
    def test_states(self, value, earlier, tolerance, state):
        assert judged(value, earlier, tolerance).state == state

    @pytest.mark.parametrize('earlier', [6, 25])
    def test_sessions_in_order_pass(self, earlier):
        """Of four independent figures: a note once in 22 sessions, an alert once in 370."""
        rng, states = rng_of(6000), []
        for _ in range(1500):
            figures = rng.normal(10.0, 1.0, (4, earlier + 1))
            found = [judged(f[-1], f[:-1], None, 4) for f in figures]
            # Runs on one side come besides.
            words = [v.state for v in found if 'in a row' not in v.words]
            states.append(max(words, key=(PASS, NOTE, ALERT).index, default=PASS))
        assert 0.01 < np.mean([s != PASS for s in states]) < 0.07
        assert np.mean([s == ALERT for s in states]) < 0.008

    def test_sessions_in_a_folder(self, tmp_path, capsys):
        rng = rng_of(12)
        history = tmp_path / 'qa'

        def session(day, noise_m, *options):
            place = [0.1, 0.0, 0.2] + noise_m * rng.normal(size=(120, 3))
            poses = resting(place, np.arange(0, 6, 0.05) + 1000 * day)
            path = write_poses(tmp_path / f'{day}.tum', poses)
            command = ['rest', path, '--history', str(history), '--json', *options]
            code = run_verb('accuracy', command)
            said = capsys.readouterr()
            return code, json.loads(said.out)['qa'] if not code else said.err

        for day in range(1, 8):
            code, qa = session(day, 2e-4)
            assert code == 0 and qa['earlier_sessions'] == day - 1
        name = 'position_jitter_rms_m'
        assert qa['figures'][name]['state'] in (PASS, NOTE)
        assert session(8, 2e-4, '--limit', f'{name}=1e-4')[1]['figures'][name]['state'] == FAIL
        qa = session(9, 1.5e-3)[1]
        assert qa['state'] == ALERT and qa['figures'][name]['state'] == ALERT
        assert 'above the mean' in qa['figures'][name]['words']
        out = tmp_path / 'stuck'
        qa = session(10, 0.0, '--out', str(out))[1]
        assert qa['state'] == ALERT and 'below' in qa['figures'][name]['words']
        page = (out / 'report.html').read_text(encoding='utf-8')
        assert 'is the sensor stuck?' in page and 'Over sessions' in page
        # Neither what failed nor the alert makes limits wider; a repeat takes its own place.
        assert session(10, 2e-4)[1]['figures'][name]['sessions'] == 7
        assert session(10, 2e-4)[1]['earlier_sessions'] == 9
        code, words = session(11, 2e-4, '--limit', 'speed=1')
        assert code == 2 and "no figure 'speed'" in words
        (history / 'z.json').write_text('{}')
        assert 'not an entry of a history' in session(12, 2e-4)[1]


class TestCommand:
    def test_a_board_in_one_recording_and_in_one_a_point(self, tmp_path, capsys):
        rng = rng_of(15)
        true = board(3, 4) + rng.normal(0, 3e-4, (12, 3))
        turns = [Rotation.identity()] * 12
        one = write_poses(tmp_path / 'board.tum', visited(true, turns, 15))
        out = tmp_path / 'o'
        assert run_verb('accuracy', ['grid', one, '--out', str(out), '--json']) == 0
        document = json.loads(capsys.readouterr().out)
        assert json.loads((out / 'accuracy.json').read_text()) == document
        assert document['groups']['5 cm distance errors']['statistics']['N'] == 17
        assert len(document['points']) == 12
        assert '<img' in (out / 'report.html').read_text(encoding='utf-8')
        many = [
            write_poses(tmp_path / f'{k:02d}.tum', visited(true[[k]], turns[:1], 100 + k))
            for k in range(12)
        ]
        assert run_verb('accuracy', ['grid', *many, '--json']) == 0
        other = json.loads(capsys.readouterr().out)['groups']['5 cm distance errors']
        for a, b in zip(
            other['errors'], document['groups']['5 cm distance errors']['errors'], strict=True
        ):
            assert a['description'] == b['description']
            assert a['signedError'] == pytest.approx(b['signedError'], abs=0.3)
        rows = '\n'.join(','.join(map(str, 1e3 * p)) for p in board(3, 4))
        (tmp_path / 'truth.csv').write_text(f'x_mm,y_mm,z_mm\n{rows}\n')
        truth = ['--truth', str(tmp_path / 'truth.csv')]
        assert run_verb('accuracy', ['point-to-point', one, *truth]) == 0
        (tmp_path / 'truth.csv').write_text(f'\ufeffx_mm,y_mm,z_mm\n{rows}\n', encoding='utf-8')
        assert run_verb('accuracy', ['point-to-point', one, *truth]) == 0
        (tmp_path / 'truth.csv').write_text('x_mm,y_mm,z_mm\n' + 'nan,0,0\n' * 12)
        assert run_verb('accuracy', ['point-to-point', one, *truth]) == 2
        assert 'rigid_fit_m' in capsys.readouterr().out

    @pytest.mark.parametrize(
        ('options', 'words'),
        [
            (['grid', 'board.tum', '--grid', '3by4'], '--grid takes'),
            (['grid', 'board.tum', '--grid', '2x4'], 'a board of 2 x 4 holes needs 8'),
            (['rest', 'board.tum'], 'needs a tool that stays in place'),
            (['rest', 'board.tum', 'board.tum'], 'rest takes one recording'),
            (['metal', 'board.tum'], 'without metal first'),
            (['dynamic', 'board.tum'], 'needs a moving reference'),
            (['point-to-point', 'board.tum'], '--truth FILE.csv'),
            (['rotation', 'board.tum', '--axis', '1,2'], '--axis takes three numbers'),
            (['grid', 'board.tum', '--limit', 'x'], '--limit takes'),
            (['grid', 'board.tum', '--pause-s', '-1'], '--pause-s must be positive'),
        ],
    )
    def test_what_is_not_right_is_said_in_a_line(
        self, options, words, tmp_path, monkeypatch, capsys
    ):
        monkeypatch.chdir(tmp_path)
        write_poses(tmp_path / 'board.tum', visited(board(3, 4), [Rotation.identity()] * 12, 1))
        assert run_verb('accuracy', options) == 2
        last = capsys.readouterr().err.strip().splitlines()[-1]
        assert words in last and last.startswith('anser accuracy: ')

    def test_points_against_the_optical_reference(self, tmp_path, capsys):
        rng = rng_of(21)
        true = rng.uniform(-0.1, 0.1, (8, 3)) + [0, 0, 0.3]
        turns = list(Rotation.from_rotvec(rng.normal(0, 0.4, (8, 3))))
        world = World(1, sensors=1)
        body = visited(true, turns, 3, 0.0)
        world.duration = float(body.time[-1])
        turned = Rotation.from_quat(body.quaternion)
        lever = np.array([0.02, 0.01, -0.03])
        place = body.position + turned.apply(lever) + 2e-4 * rng.normal(size=body.position.shape)
        tracked = sequence_of('pen', body.time, place, body.quaternion)
        session = world.session()
        session = type(session)('bag', 10**9, {'pen': tracked}, body)
        write_pose_session(tmp_path / 'a.mcap', session)
        command = ['point-to-point', str(tmp_path / 'a.mcap'), '--json']
        assert run_verb('accuracy', command) == 0
        document = json.loads(capsys.readouterr().out)
        assert document['groups']['point to point distance errors']['statistics']['Mean'] < 0.3
        assert len(document['points']) == 8
