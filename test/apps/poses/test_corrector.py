"""A pose model applied: errors fall on poses that it has not seen, and it says where it can't."""

import copy
import json

import numpy as np
import pytest
import yaml
from conftest import spin_until
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from pose_world import World
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.corrector import (
    MODEL_SCHEMA,
    NO_POSE,
    OK,
    OUTSIDE,
    UNKNOWN,
    PoseCorrector,
    to_model,
)
from anser_ros.apps.poses.diagnosis import diagnose_poses
from anser_ros.apps.poses.importing import write_pose_session
from anser_ros.apps.poses.nodes.corrector import Corrector
from anser_ros.cli.main import main
from anser_ros.errors import ModelFileError
from anser_ros.field.model import EffectRecord

PLAIN = np.array([0.0, 0.0, 0.0, 1.0])  # no turn
MIDDLE = np.array([0.05, 0.02, -0.3])


@pytest.fixture(scope='module')
def bent():
    """A world with a distortion, its model, and a session of other poses without noise."""
    world = World(11, duration=25.0, sensors=1)
    world.offset = 0.03

    def bend(sensor, place):
        away = (place - MIDDLE) / 0.06
        return place + 1.5e-3 * away[:, [0]] * away

    world.bend = bend
    model = to_model(diagnose_poses(world.session()))
    return world, yaml.safe_load(yaml.safe_dump(model))


def misfit(one, other):
    """Distance, rms, that is left when one set of places is moved onto the other."""
    one, other = one - one.mean(axis=0), other - other.mean(axis=0)
    turn, _ = Rotation.align_vectors(other, one)
    return np.sqrt(np.mean(np.sum((turn.apply(one) - other) ** 2, axis=1)))


@pytest.mark.long
def test_errors_fall_and_stamps_move_to_the_references_clock(bent):
    world, model = bent
    corrector = PoseCorrector(model)
    instant = np.arange(0.3, 24.0, 0.31)
    true, turn = world.sensor(0, instant)
    poses = [
        corrector.correct('sensor_0', 10**9, place, q)
        for place, q in zip(world.bend(0, true), turn.as_quat(), strict=True)
    ]
    inside = np.array([pose.state == OK for pose in poses])
    assert inside.mean() > 0.8
    corrected = np.array([pose.position for pose in poses])[inside]
    # A map leaves what a registration takes up, a shift and a turn of the whole.
    before, after = (misfit(p, true[inside]) for p in (world.bend(0, true)[inside], corrected))
    assert after < 0.5 * before
    assert poses[0].stamp_ns == pytest.approx(10**9 - 3e7, abs=1.5e6)


def test_clocks_that_run_apart_are_corrected_where_their_rate_was_learnt():
    mount = EffectRecord('hand_eye', {'sensor': 'tip'}, {})
    rate = EffectRecord('clock_rate', {'rate_ppm': 1000.0, 'middle_s': 20.0, 'offset_s': 0.05}, {})
    own = EffectRecord('time_offset', {'sensor': 'tip', 'offset_s': 0.01}, {})
    second = 10**9
    support = {'low_m': [-1.0] * 3, 'high_m': [1.0] * 3}
    support |= {'first_ns': 100 * second, 'last_ns': 140 * second}
    document = {
        'schema': MODEL_SCHEMA, 'held_out_position_rmse_m': 1e-3,
        'held_out_orientation_rmse_rad': 1e-2, 'support': support,
        'effects': [
            {'name': r.name, 'parameters': r.parameters, 'uncertainty': {}}
            for r in (mount, rate, own)
        ],
    }  # fmt: skip

    def late(at):
        stamp = round(at * second)
        return stamp - PoseCorrector(document).correct('tip', stamp, np.zeros(3), PLAIN).stamp_ns

    assert late(120) == round(0.06 * second)  # the offset at the middle
    # The reference's time of a stamp t is middle + (t - middle) / 1.001.
    assert late(130) == pytest.approx(0.06 * second + 10 * second / 1001, abs=2)
    assert late(3600) == late(140) and late(5) == late(100)  # held: who knows what was set since
    for key in ('first_ns', 'last_ns'):
        support.pop(key)
    assert late(130) == round(0.06 * second)


def test_outside_the_covariance_grows_and_what_is_no_pose_or_unknown_is_said(bent):
    corrector = PoseCorrector(bent[1])
    near = corrector.correct('sensor_0', 10**9, MIDDLE, PLAIN)
    far = corrector.correct('sensor_0', 10**9, np.array([0.6, 0.02, -0.3]), PLAIN)
    assert (near.state, far.state) == (OK, OUTSIDE)
    assert np.sqrt(far.covariance[0, 0]) > 0.02 > 10 * np.sqrt(near.covariance[0, 0])
    for place, turn in (
        (MIDDLE * np.nan, PLAIN),
        (np.full(3, -3.7e28), PLAIN),
        (MIDDLE, 0 * PLAIN),
    ):
        assert corrector.correct('sensor_0', 1, place, turn).state == NO_POSE
    assert corrector.correct('other', 1, MIDDLE, PLAIN).state == UNKNOWN


def map_record(degree, kind, coefficients, **uncertainty):
    parameters = {
        'degree': degree, 'kind': kind, 'sensor': 'sensor_0', 'centre_m': MIDDLE.tolist(),
        'size_m': 0.05, 'coefficients_mm': coefficients,
    }  # fmt: skip
    return {'name': 'field_distortion', 'parameters': parameters, 'uncertainty': uncertainty}


def test_what_is_no_model_of_poses_or_no_map_of_its_degree_is_refused(bent):
    with pytest.raises(ModelFileError, match='anser_pose_model/1'):
        PoseCorrector({'schema': 'anser_model/1'})
    with pytest.raises(ModelFileError, match='support'):
        PoseCorrector({k: v for k, v in bent[1].items() if k != 'support'})
    record = map_record(2, 'quadratic', [0.1] * 27)
    with pytest.raises(ModelFileError, match='27 coefficients_mm, such a map has 30'):
        PoseCorrector({**bent[1], 'effects': [record]})


def test_a_shrunk_space_is_stretched_about_its_own_point_with_its_variance(bent):
    record = map_record(0, 'scale', [1.5, 0.1, -0.2, 0.3], coefficients_mm=[0.3, 0.1, 0.1, 0.1])
    effects = [e for e in bent[1]['effects'] if e['name'] == 'hand_eye']
    plain, full = (
        PoseCorrector({**bent[1], 'effects': [*effects, *more]}) for more in ([], [record])
    )
    place = np.array([0.08, 0.0, -0.28])
    before, after = (one.correct('sensor_0', 1, place, PLAIN) for one in (plain, full))
    away = place - MIDDLE
    moved = 1.5e-3 * away / 0.05 + [1e-4, -2e-4, 3e-4]
    np.testing.assert_allclose(after.position - before.position, moved, atol=1e-12)
    variance = np.mean((0.3e-3 * away / 0.05) ** 2) + 1e-8
    assert after.covariance[0, 0] - before.covariance[0, 0] == pytest.approx(variance, rel=1e-9)


@pytest.mark.light
def test_the_node_corrects_what_comes_and_tells_what_does_not(ros, bent, tmp_path):
    path = tmp_path / 'model.yaml'
    path.write_text(yaml.safe_dump(bent[1]), encoding='utf-8')
    node = Corrector(parameter_overrides=[Parameter('model', value=str(path))])
    other = ros.create_node('listener')
    got = []
    other.create_subscription(
        PoseWithCovarianceStamped, '/anser/corrected/sensor_0/pose_with_covariance', got.append, 10
    )
    sender = other.create_publisher(PoseStamped, '/tracked/sensor_0/pose', qos_profile_sensor_data)
    message = PoseStamped()
    message.header.stamp.sec = 5
    message.pose.position.x, message.pose.position.z = 0.05, -0.3
    message.pose.orientation.w = 1.0

    def heard():
        ros.spin_once(other, timeout_sec=0.0)
        return got

    try:
        assert spin_until(node, lambda: sender.get_subscription_count() > 0)
        gone = PoseStamped()
        gone.pose.position.x = float('nan')
        sender.publish(gone)
        sender.publish(message)
        assert spin_until(node, heard)
        assert got[0].header.stamp.sec == 4
        assert 0 < got[0].pose.covariance[0] < 1e-4
        (status,) = node.part_statuses()
        assert status.message == OK
        assert status.values['poses_no_pose'] == 1
    finally:
        node.destroy_node()
        other.destroy_node()


def test_a_model_corrects_and_judges_another_session(bent, tmp_path, capsys):
    world, model = bent
    other = World(12, duration=20.0, sensors=1)
    other.offset, other.bend = world.offset, world.bend
    bag, out, path = tmp_path / 'a.mcap', tmp_path / 'out', tmp_path / 'model.yaml'
    write_pose_session(bag, other.session())
    path.write_text(yaml.safe_dump(model), encoding='utf-8')
    plain = [str(bag), '--poses', '--out', str(out)]
    assert main(['evaluate', *plain]) == 0
    assert 'Nothing was searched for' in capsys.readouterr().out
    before = json.loads((out / 'evaluation.json').read_text())['held_out']
    assert before['position_rmse_after_m'] == before['position_rmse_before_m']
    assert main(['evaluate', *plain, '--model', str(path)]) == 0
    said = capsys.readouterr()
    assert 'before, mm' in said.out and 'lie outside the places' in said.err
    after = json.loads((out / 'evaluation.json').read_text())['held_out']
    assert after['position_rmse_before_m'] == pytest.approx(before['position_rmse_after_m'])
    assert after['position_rmse_after_m'] < 0.3 * after['position_rmse_before_m']
    rows = np.genfromtxt(out / 'poses.csv', delimiter=',', names=True, dtype=None)
    assert len(rows) == len(other.session().sensors['sensor_0'].time)
    time = 1e-9 * rows['stamp_ns'] - 2.0
    true, _ = other.sensor(0, time)
    places = np.stack([rows[f'{axis}_m'] for axis in 'xyz'], axis=1)
    inside = (time > 0.5) & (time < 19.0)
    assert misfit(places[inside], true[inside]) < 1.2e-3
    assert main(['diagnose', *plain, '--model', str(path)]) == 0
    document = json.loads((out / 'diagnosis.json').read_text())
    names = {effect['name'] for effect in document['effects']}
    assert not names & {'time_offset', 'field_distortion'}  # what is left is out of its support
    kept = yaml.safe_load((out / 'model.yaml').read_text())['effects']
    assert {e['name'] for e in kept} >= {e['name'] for e in model['effects']}
    for extra in (['--model', 'none.yaml'], ['--set', 'gate=3'], ['--resurveyed', 'tool']):
        assert main(['diagnose', *plain, *extra]) != 0
    assert main(['evaluate', *plain, '--baseline', str(bag)]) == 2
    assert 'leave out: --baseline' in capsys.readouterr().err
    other_sensor = copy.deepcopy(model)
    other_sensor['effects'][0]['parameters']['sensor'] = 'tip'
    path.write_text(yaml.safe_dump(other_sensor), encoding='utf-8')
    assert main(['evaluate', *plain, '--model', str(path)]) != 0
    assert 'the model knows tip, the session sensor_0' in capsys.readouterr().err
    path.write_text('schema: anser_model/1', encoding='utf-8')
    assert main(['evaluate', *plain, '--model', str(path)]) == 2
    assert f'{path}: its schema must be anser_pose_model/1' in capsys.readouterr().err


def test_a_map_of_points_is_applied_where_it_is_confirmed(tmp_path, capsys):
    rng = np.random.default_rng(5)
    true = np.stack(np.meshgrid(*2 * [np.linspace(-0.1, 0.1, 8)], [0.0]), -1).reshape(-1, 3)
    turn, shift = Rotation.from_rotvec([0.3, 1.0, -0.4]), np.array([0.4, 0.1, -0.2])
    for name, bend in (('bent', 0.03), ('noisy', 0.0)):
        tracked = turn.apply(true * [1.0 + bend, 1.0, 1.0] + 2e-4 * rng.normal(size=true.shape))
        tracked += shift
        for file, points in (('em', tracked), ('true', true)):
            np.savetxt(tmp_path / f'{file}.csv', points, delimiter=',', header='x_m,y_m,z_m',
                       comments='')  # fmt: skip
        out = tmp_path / name
        command = ['error_map', str(tmp_path / 'em.csv'), '--true', str(tmp_path / 'true.csv')]
        assert main([*command, '--register', '--sensor', 'tip', '--out', str(out)]) == 0
        said = capsys.readouterr().out
        assert ('nothing is corrected' in said) == (name == 'noisy')
        document = json.loads((out / 'error_map.json').read_text())
        assert document['confirmed'] == (name == 'bent')
        assert document['before']['out_of_plane_rmse_m'] == pytest.approx(2e-4, rel=0.3)
        corrector = PoseCorrector(yaml.safe_load((out / 'model.yaml').read_text()))
        fixed = np.array([corrector.correct('tip', 1, p, PLAIN).position for p in tracked])
        left = (fixed - shift) @ turn.as_matrix() - true
        rms = np.sqrt(np.mean(np.sum(left[:, :2] ** 2, axis=1)))
        assert rms < 4e-4
        np.testing.assert_array_equal(fixed, tracked) if name == 'noisy' else None
    away = corrector.correct('tip', 1, tracked[0] + 1.0, PLAIN)
    assert away.state == 'outside_support'
