"""The tip of a stylus: against exact truth, against another library, and what is refused."""

import json
import threading
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from conftest import REPO
from geometry_msgs.msg import PoseStamped
from pose_world import write_tum
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.assessment.pivot import PivotLimits, fit_pivot
from anser_ros.apps.poses.sequence import sequence_of
from anser_ros.cli.main import run_verb
from anser_ros.errors import FitError, SetupError
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.parameters import from_text
from anser_ros.nodes.tracker import TrackerParameters
from anser_ros.pose_states import OK
from anser_ros.tracking.estimate import PoseEstimate, Tip, no_pose
from anser_ros.wire.setup import dump_setup, parse_setup
from anser_ros.wire.setup_values import TipSpec, read_tips, with_tips

DEMO = (REPO / 'config' / 'demo_setup.yaml').read_text(encoding='utf-8')
SEEDS = range(2000, 2012)  # nothing was chosen on them


def pivoting(seed, axes=(1, 1, 1), tilt=0.35, wrong=0.0, noise_rad=2e-3, slips=0.0):
    """Poses of a tool whose tip rests in a dimple, with the tip (body) and the dimple."""
    rng = np.random.default_rng(seed)
    knots = np.arange(-2, 24, 0.8)
    turns = CubicSpline(knots, rng.normal(0, tilt, (knots.size, 3)) * np.array(axes))
    time = np.arange(0, 20, 0.04)
    turn = Rotation.random(random_state=seed) * Rotation.from_rotvec(turns(time))
    tip = rng.normal(0, 0.02, 3) + [0, 0, -0.15]
    dimple = rng.normal(0, 0.2, 3) + [0, 0, 0.2]
    place = dimple - turn.apply(tip) + 3e-4 * rng.normal(size=(time.size, 3))
    place[time > 20 * (1 - slips)] += [0.02, 0.0, 0.0]
    place[rng.random(time.size) < wrong] += rng.normal(0, 0.03, 3)
    turn = Rotation.from_rotvec(noise_rad * rng.normal(size=place.shape)) * turn
    return sequence_of('pen', time, place, turn.as_quat()), tip, dimple


def fitted(poses, **limits):
    return fit_pivot(poses, np.random.default_rng(1), PivotLimits(**limits))


@pytest.mark.long
@pytest.mark.parametrize(('wrong', 'noise_rad'), [(0.0, 2e-3), (0.3, 8e-3)])
def test_the_tip_is_found_and_its_sigma_is_honest(wrong, noise_rad):
    scores = []
    for seed in SEEDS:
        poses, tip, dimple = pivoting(seed, wrong=wrong, noise_rad=noise_rad)
        fit = fitted(poses)
        assert np.linalg.norm(fit.tip - tip) < 1e-3
        assert abs(fit.agrees.mean() - (1 - wrong)) < 0.1
        scores.append((fit.tip - tip) / fit.sigma)
        scores.append((fit.point - dimple) / np.sqrt(np.diag(fit.point_covariance)))
    # Three dimensions of twelve fits: chance alone makes 0.75 to 1.25.
    assert 0.7 < np.sqrt(np.mean(np.square(scores))) < 1.3


@pytest.mark.long
def test_noise_of_the_rotations_does_not_shorten_the_arm():
    """Turns known with an error make every plain fit too short; the mean of many tells."""
    along = []
    for seed in SEEDS:
        poses, tip, _ = pivoting(seed, noise_rad=0.03, tilt=0.25)
        fit = fitted(poses, sigma_m=0.01, rms_m=0.02)
        along.append((fit.tip - tip) @ tip / np.linalg.norm(tip))
    spread = np.std(along) / np.sqrt(len(along))
    shortened = 2 * 0.03**2 / 0.25**2 * 0.15 / 2
    assert abs(np.mean(along)) < 3 * spread < shortened


def test_another_library_finds_the_same():
    """scikit-surgerycalibration's algebraic one-step calibration, on poses without outliers."""
    pivot = pytest.importorskip('sksurgerycalibration.algorithms.pivot')
    poses, tip, _ = pivoting(7)
    matrices = np.tile(np.eye(4), (poses.size, 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = poses.rotation, poses.position
    theirs, point, _ = pivot.pivot_calibration(matrices, {'method': 'aos'})
    fit = fitted(poses)
    assert np.linalg.norm(fit.tip - theirs.ravel()) < 5e-5
    assert np.linalg.norm(fit.point - point.ravel()) < 5e-5
    assert np.linalg.norm(fit.tip - tip) < 3e-4


@pytest.mark.parametrize(
    ('motion', 'words'),
    [
        ({'axes': (0, 0, 1)}, 'about one axis only, z in its own frame'),
        ({'axes': (1, 0, 0.05)}, 'about one axis only, x in its own frame'),
        ({'tilt': 0.03}, 'tilt it by 25 deg or more to all sides'),
        ({'slips': 0.48, 'wrong': 0.2}, 'agree on one tip|about one point'),
    ],
)
def test_poor_motion_is_refused_and_what_is_missing_is_said(motion, words):
    with pytest.raises(FitError, match=words):
        fitted(pivoting(3, **motion)[0])


def test_what_is_no_pivot_is_refused():
    poses, _, _ = pivoting(4)
    with pytest.raises(FitError, match='a pivot calibration needs at least 30'):
        fitted(poses.rows(np.arange(20)))
    with pytest.raises(FitError, match='mm only along'):
        fitted(poses, sigma_m=1e-6)
    rng = np.random.default_rng(1)
    free = sequence_of('pen', poses.time, rng.normal(0, 0.1, (poses.size, 3)), poses.quaternion)
    with pytest.raises(FitError, match='do not turn about one point'):
        fitted(free)


def test_a_tip_moves_as_its_body_does():
    rng = np.random.default_rng(5)
    factor = rng.normal(0, 1, (6, 6)) * np.repeat([3e-4, 4e-3], 3)[:, None]
    turn = Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix()
    body = PoseEstimate(
        'pen', 7, OK, np.array([0.1, 0.2, 0.3]), turn[:, 2], turn, factor @ factor.T, 1e-9,
        1.0, 'model',
    )  # fmt: skip
    unknown = np.diag([1e-8, 4e-8, 9e-8])
    tip = Tip('pen/tip', np.array([0.02, -0.01, -0.15]), unknown)
    found = tip.of_body(body)
    assert (found.name, found.stamp_ns, found.state) == ('pen/tip', 7, OK)
    steps = rng.normal(size=(40000, 6)) @ factor.T
    arms = tip.position + rng.normal(size=(40000, 3)) * np.sqrt(np.diag(unknown))
    turns = Rotation.from_rotvec(steps[:, 3:]) * Rotation.from_matrix(turn)
    drawn = np.concatenate(
        [body.position + steps[:, :3] + turns.apply(arms) - found.position, steps[:, 3:]], axis=1
    )
    scale = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(
        np.cov(drawn.T) / np.outer(scale, scale),
        found.covariance / np.outer(scale, scale), atol=0.03,
    )  # fmt: skip
    assert np.linalg.norm(drawn[:, :3].mean(axis=0)) < 2e-5
    assert found.sigma_position_m == pytest.approx(np.sqrt(np.trace(found.covariance[:3, :3])))
    lost = tip.of_body(no_pose('pen', 8, 'residual', 'model', 'bent'))
    assert (lost.state, lost.reason) == ('residual', 'bent') and np.isnan(lost.position).all()


class TestDocument:
    SPEC = TipSpec((0.01, -0.02, -0.15), (4e-8, 1e-9, 0.0, 5e-8, 0.0, 6e-8))

    def test_tips_go_into_a_document_and_nothing_else_changes(self):
        text = with_tips(DEMO, {'tool_a': self.SPEC})
        assert text.startswith(DEMO.rstrip())
        setup = parse_setup(text)
        assert setup.tips == {'tool_a': self.SPEC}
        assert setup.identity == parse_setup(DEMO).identity
        assert parse_setup(dump_setup(setup)).tips == setup.tips
        again = with_tips(text, {'tool_a': TipSpec((0.0, 0.0, 0.1))})
        assert read_tips(again) == {'tool_a': TipSpec((0.0, 0.0, 0.1))}
        assert again.count('tips:') == 1

    @pytest.mark.parametrize(
        ('value', 'words'),
        [
            ('{pen: {position_m: [0, 0, 0.1]}}', 'no such body that moves; there are: tool_a'),
            ('{tool_a: {position_m: [0, 0, 150.0]}}', 'must be finite and in'),
            ('{tool_a: {position_m: [0, 0, 15.0]}}', 'is in m'),
            ('{tool_a: {place_m: [0, 0, 0.1]}}', 'only the keys .*, not place_m'),
            ('{tool_a: {position_m: [0, 0, 0.1], covariance_m2: [1.0]}}', 'six numbers'),
            ('{tool_a: {position_m: [0, 0, 0.1], covariance_m2: [1.0e-8, 0, 0, -1.0e-8, 0, 0]}}',
             'negative'),
        ],
    )  # fmt: skip
    def test_what_is_no_tip_is_refused(self, value, words):
        with pytest.raises(SetupError, match=words):
            parse_setup(f'{DEMO}\ntips: {value}\n')

    def test_a_tip_takes_no_sensors_topic(self):
        text = DEMO.replace('name: tool_a/0/x', 'name: tool_a/tip')
        assert text != DEMO
        with pytest.raises(SetupError, match='tool_a/tip'):
            parse_setup(with_tips(text, {'tool_a': self.SPEC}))


def test_the_command_writes_the_tip_and_refuses_in_a_line(tmp_path, capsys):
    poses, tip, _ = pivoting(9)
    setup = Path(tmp_path / 'setup.yaml')
    setup.write_text(DEMO, encoding='utf-8')
    recording = write_tum(tmp_path / 'pivot.tum', poses)
    options = [recording, '--setup', str(setup), '--body', 'tool_a', '--out', str(tmp_path / 'o')]
    assert run_verb('pivot', [*options, '--json']) == 0
    document = json.loads(capsys.readouterr().out)
    assert np.linalg.norm(np.array(document['tip_m']) - tip) < 3e-4
    written = parse_setup(setup.read_text(encoding='utf-8')).tips['tool_a']
    np.testing.assert_allclose(written.position_m, document['tip_m'])
    np.testing.assert_allclose(written.covariance, document['covariance_m2'], atol=1e-14)
    assert yaml.safe_load((tmp_path / 'o' / 'tips.yaml').read_text())['tips'].keys() == {'tool_a'}
    assert '<img' in (tmp_path / 'o' / 'report.html').read_text(encoding='utf-8')
    before = setup.read_text(encoding='utf-8')
    poor = write_tum(tmp_path / 'poor.tum', pivoting(9, axes=(0, 0, 1))[0])
    assert run_verb('pivot', [poor, *options[1:]]) == 2
    said = capsys.readouterr().err
    assert 'about one axis only' in said.strip().splitlines()[-1]
    assert setup.read_text(encoding='utf-8') == before
    assert run_verb('pivot', []) == 2
    assert run_verb('pivot', [recording, '--setup', str(setup), '--body', 'pen']) == 2
    assert 'no such body' in capsys.readouterr().err


def test_positions_in_millimetres_are_named_and_what_is_no_pose_is_counted(tmp_path, capsys):
    poses, tip, _ = pivoting(9)
    wrong = write_tum(tmp_path / 'mm.tum', replace(poses, position=1e3 * poses.position))
    assert run_verb('pivot', [wrong]) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert 'positions span' in said and said.endswith('millimetres?')
    gone = np.arange(poses.size) % 5 == 0
    some = np.where(gone[:, None], np.nan, poses.position)
    recording = write_tum(tmp_path / 'gaps.tum', replace(poses, position=some))
    assert run_verb('pivot', [recording, '--json']) == 0
    out, said = capsys.readouterr()
    assert f'{gone.sum()} of {poses.size} poses of tool have no numbers' in said
    document = json.loads(out)
    assert (document['n_missing'], document['n']) == (gone.sum(), poses.size - gone.sum())
    assert np.linalg.norm(np.array(document['tip_m']) - tip) < 3e-4


def test_a_file_of_tips_that_is_not_there_is_the_callers_fault(tmp_path):
    tips_of = partial(from_text, 'tips_file', parse=read_tips, none={})
    with pytest.raises(SetupError, match='tips_file'):
        tips_of(str(tmp_path / 'none.yaml'))
    assert tips_of(TrackerParameters.tips_file) == {}


def test_the_command_takes_poses_from_the_graph(ros, tmp_path, capsys):
    poses, tip, _ = pivoting(11)
    node = ros.create_node('pen')
    publisher = node.create_publisher(PoseStamped, '/pen/pose', qos.STREAM)
    done = threading.Event()

    def publish():
        while not publisher.get_subscription_count() and not done.wait(0.05):
            pass
        for stamp, place, turn in zip(poses.time, poses.position, poses.quaternion, strict=True):
            message = PoseStamped()
            message.header.stamp.sec = 100 + int(stamp)
            message.header.stamp.nanosec = int(1e9 * (stamp % 1))
            p, q = message.pose.position, message.pose.orientation
            p.x, p.y, p.z = map(float, place)
            q.x, q.y, q.z, q.w = map(float, turn)
            publisher.publish(message)
            if done.wait(0.002):
                break

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        command = ['--live', '--topic', '/pen/pose', '--seconds', '2', '--json']
        assert run_verb('pivot', command) == 0
        document = json.loads(capsys.readouterr().out)
        assert np.linalg.norm(np.array(document['tip_m']) - tip) < 1e-3
    finally:
        done.set()
        thread.join()
        node.destroy_node()
