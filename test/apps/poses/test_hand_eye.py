"""Hand-eye: against exact truth, against Shah's closed form, and what motion can't tell."""

import json

import numpy as np
import pytest
from conftest import REPO
from pose_world import FRAME, SHIFT, World, write_tum
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.hand_eye import fit_hand_eye
from anser_ros.apps.poses.importing import write_pose_session
from anser_ros.apps.poses.sequence import PoseSession, sequence_of
from anser_ros.cli.main import run_verb
from anser_ros.errors import DiagnosisError

SEEDS = range(4000, 4004)  # nothing was chosen on them
OFFSET, RATE = 0.03, 800.0


def static_pairs(seed, turn=(0.5, 0.5, 0.5), count=25):
    """A session of poses at rest, with the sensor's place and mount on the body."""
    rng = np.random.default_rng(seed)
    body = Rotation.from_rotvec(rng.normal(0, 1, (count, 3)) * turn)
    place = rng.normal(0, 0.08, (count, 3)) + [0.05, 0.02, 0.3]
    lever, mount = rng.normal(0, 0.04, 3), Rotation.random(random_state=seed)

    def shaken(rad):
        return Rotation.from_rotvec(rad * rng.normal(size=(count, 3)))

    tracked = place + body.apply(lever) + 3e-4 * rng.normal(size=(count, 3))
    optical = FRAME.inv().apply(place - SHIFT) + 1e-4 * rng.normal(size=(count, 3))
    time = np.arange(count) * 1.0
    poses = sequence_of('s', time, tracked, (shaken(3e-3) * body * mount).as_quat())
    turns = (shaken(1e-3) * FRAME.inv() * body).as_quat()
    return PoseSession('pairs', 10**9, {'s': poses}, sequence_of('optical', time, optical, turns)
                       ), lever, mount  # fmt: skip


def shah(session):
    """Frames of ``A X = Z B`` by Shah's Kronecker product (J. Mechanisms Robotics 5, 2013)."""
    one, two = session.sensors['s'], session.reference
    products = sum(np.kron(b, a) for a, b in zip(one.rotation, two.rotation, strict=True))
    # tracked = frame optical mount, so vec(tracked mount^T) = (optical x 1) vec(frame)
    frame = np.linalg.svd(products)[0][:, 0].reshape(3, 3).T
    left, _, right = np.linalg.svd(frame * np.sign(np.linalg.det(frame)))
    frame = left @ right
    count = one.size
    rows = np.zeros((3 * count, 6))
    rows[:, :3] = (frame @ two.rotation).reshape(-1, 3)
    rows[:, 3:] = np.tile(np.eye(3), (count, 1))
    rest = (one.position - two.position @ frame.T).ravel()
    solution = np.linalg.lstsq(rows, rest, rcond=None)[0]
    return frame, solution[:3], solution[3:]


@pytest.mark.long
def test_frames_and_clocks_are_found_and_their_sigmas_are_honest():
    scores = {'lever': [], 'mount': [], 'place': [], 'turn': [], 'offset': [], 'rate': []}
    for seed in SEEDS:
        world = World(seed, sensors=1, duration=30.0)
        world.offset, world.rate_ppm = OFFSET, RATE
        found = fit_hand_eye(world.session())
        one = found.sensors['sensor_0']
        scores['lever'].append((one['lever_arm_m'] - world.levers[0]) / one['lever_arm_sigma_m'])
        off = Rotation.from_quat(one['mount_quaternion_xyzw']) * world.mounts[0].inv()
        scores['mount'].append(off.as_rotvec(degrees=True) / one['mount_rotation_sigma_deg'])
        scores['place'].append((found.translation_m - SHIFT) / found.translation_sigma_m)
        off = Rotation.from_matrix(found.rotation) * FRAME.inv()
        scores['turn'].append(off.as_rotvec() / found.rotation_sigma_rad)
        # The world counts from a second and half its length on, in the session's time.
        late = OFFSET + 1e-6 * RATE * (found.middle_s - 1.0 - world.duration / 2)
        scores['offset'].append((found.offset_s[0] - late) / found.offset_s[1])
        scores['rate'].append((found.rate_ppm[0] - RATE) / found.rate_ppm[1])
        assert found.undetermined == ()
        assert one['heldout_position_rmse_m'] < 1e-3
    every = np.concatenate([np.ravel(values) for values in scores.values()])
    assert 0.8 < np.sqrt(np.mean(every**2)) < 1.3
    assert max(np.abs(np.mean(np.array(v), axis=0)).max() for v in scores.values()) < 1.5


@pytest.mark.long
def test_static_pairs_agree_with_a_closed_form():
    ours, theirs = [], []
    for seed in SEEDS:
        session, lever, mount = static_pairs(seed)
        found = fit_hand_eye(session, pairs=True)
        frame, arm, place = shah(session)
        one = found.sensors['s']
        turned = Rotation.from_matrix(frame).inv() * Rotation.from_matrix(found.rotation)
        assert turned.magnitude() < 5e-3
        assert np.linalg.norm(one['lever_arm_m'] - arm) < 3e-4
        assert np.linalg.norm(found.translation_m - place) < 3e-3
        assert (Rotation.from_quat(one['mount_quaternion_xyzw']) * mount.inv()).magnitude() < 5e-3
        ours.append(np.linalg.norm(one['lever_arm_m'] - lever))
        theirs.append(np.linalg.norm(arm - lever))
        assert found.offset_s is None and 'the offset of the clocks' in found.undetermined[-1]
    assert np.mean(ours) < 5e-4 and np.mean(ours) < 1.3 * np.mean(theirs)


@pytest.mark.parametrize(
    ('turn', 'open_axes', 'words'),
    [((0.0, 0.0, 0.5), 'z', 'about one axis only'), ((0.0, 0.0, 0.0), 'x, y, z', 'hardly turned')],
)
def test_what_the_motion_leaves_open_is_said_and_not_given(turn, open_axes, words):
    session, lever, _ = static_pairs(3, turn)
    found = fit_hand_eye(session, pairs=True)
    (said,) = (w for w in found.undetermined if w.startswith('s: its lever arm'))
    assert f'along {open_axes} of the body' in said and words in said
    for axis, value, true in zip('xyz', found.sensors['s']['lever_arm_m'], lever, strict=True):
        if axis in open_axes:
            assert np.isnan(value)
        else:
            assert abs(value - true) < 2e-3
    assert np.isnan(found.translation_m).any()


def test_a_body_that_moves_too_shortly_has_no_rate():
    world = World(4100, sensors=1, duration=4.0)
    world.noise_m, world.noise_rad = 2e-3, 2e-2
    found = fit_hand_eye(world.session())
    assert found.rate_ppm is None and found.offset_s is not None
    assert any(words.startswith('the rate of the clocks') for words in found.undetermined)


@pytest.mark.long
def test_the_command_takes_a_bag_or_files(tmp_path, capsys):
    world = World(4200, sensors=2, duration=12.0)
    session = world.session()
    bag = tmp_path / 'session.mcap'
    write_pose_session(bag, session)
    assert run_verb('handeye', [str(bag), '--out', str(tmp_path / 'o'), '--json']) == 0
    document = json.loads(capsys.readouterr().out)
    assert json.loads((tmp_path / 'o' / 'handeye.json').read_text()) == document
    assert set(document['sensors']) == {'sensor_0', 'sensor_1'}
    matrix = np.array(document['registration_matrix'])
    np.testing.assert_allclose(matrix[:3, :3], FRAME.as_matrix(), atol=5e-3)
    np.testing.assert_allclose(matrix[:3, 3], SHIFT, atol=2e-3)
    assert abs(document['clock']['offset_s']) < 1e-3
    assert '<img' in (tmp_path / 'o' / 'report.html').read_text(encoding='utf-8')
    for name, poses in (('em', session.sensors['sensor_1']), ('optical', session.reference)):
        write_tum(tmp_path / f'{name}.tum', poses)
    files = [str(tmp_path / 'em.tum'), '--reference', str(tmp_path / 'optical.tum')]
    assert run_verb('handeye', [*files, '--json']) == 0
    (one,) = json.loads(capsys.readouterr().out)['sensors'].values()
    np.testing.assert_allclose(one['lever_arm_m'], world.levers[1], atol=1e-3)
    wild = np.loadtxt(tmp_path / 'em.tum')
    wild[40:60, 1] += 0.1
    np.savetxt(tmp_path / 'em.tum', wild, fmt='%.9f')
    assert run_verb('handeye', [*files, '--out', str(tmp_path / 'wild')]) == 0
    document = json.loads((tmp_path / 'wild' / 'handeye.json').read_text())
    left_out = document['sensors']['em']['n_compared'] - document['sensors']['em']['n']
    assert 20 <= left_out < 40
    assert f'em: {left_out} of ' in capsys.readouterr().out
    assert run_verb('handeye', [files[0]]) == 2
    assert 'no second stream' in capsys.readouterr().err
    assert run_verb('handeye', [str(bag), *files[1:]]) == 2
    assert run_verb('handeye', [*files, '--optical', '/optical/x/pose']) == 2
    assert 'need a bag' in capsys.readouterr().err


def test_millimetres_under_heads_of_metres_are_said_or_refused(tmp_path, capsys):
    session = World(4200, sensors=1, duration=12.0).session()
    streams = {'em': session.sensors['sensor_0'], 'optical': session.reference}
    for name, poses in streams.items():
        for ending, scale in (('m', 1.0), ('mm', 1e3)):
            write_tum(tmp_path / f'{name}_{ending}.tum', poses, scale=scale)

    def told(em, optical):
        files = [str(tmp_path / f'em_{em}.tum'), '--reference']
        code = run_verb('handeye', [*files, str(tmp_path / f'optical_{optical}.tum'), '--json'])
        out, said = capsys.readouterr()
        return code, out, said

    code, plain, said = told('m', 'm')
    assert code == 0 and 'positions in mm' not in said
    code, out, said = told('mm', 'm')
    assert code == 0 and 'positions in mm, as they extend' in said and 'times as far' in said
    for key in ('registration_matrix', 'registration_translation_m'):
        np.testing.assert_allclose(json.loads(out)[key], json.loads(plain)[key], atol=1e-6)
    for em in ('m', 'mm'):
        code, _, said = told(em, 'mm')
        assert code == 2 and 'the reference: positions span' in said and 'millimetres?' in said


@pytest.mark.long
def test_fluxes_are_tracked_with_a_model(capsys):
    model = str(REPO / 'config' / 'demo_model.yaml')
    command = [str(REPO / 'bags' / 'moving.mcap'), '--model', model, '--json']
    assert run_verb('handeye', command) == 0
    document = json.loads(capsys.readouterr().out)
    # The simulated camera reports the tool's own pose in the board's frame.
    np.testing.assert_allclose(document['registration_matrix'], np.eye(4), atol=2e-3)
    np.testing.assert_allclose(document['sensors']['tool_a']['lever_arm_m'], 0.0, atol=1e-3)
    assert abs(document['clock']['offset_s']) < 5e-3


def test_pairs_must_be_pairs():
    session, _, _ = static_pairs(1)
    short = session.sensors['s'].rows(np.arange(20))
    with pytest.raises(DiagnosisError, match='the n-th with the n-th'):
        fit_hand_eye(PoseSession('p', 0, {'s': short}, session.reference), pairs=True)
