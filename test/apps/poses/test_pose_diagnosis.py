"""Sessions of poses with one thing wrong: it is named, with its size, and nothing else is."""

import json
from dataclasses import replace

import numpy as np
import pytest
from clean_poses import MOTIONS, STREAMS, clean_world
from pose_world import FRAME, SHIFT, World, named
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses import diagnosis
from anser_ros.apps.poses.cli.pose_session import pose_verdict
from anser_ros.apps.poses.corrector import corrected, to_document, to_model
from anser_ros.apps.poses.diagnosis import diagnose_poses, unconfirmed
from anser_ros.apps.poses.effect import Role, effect_with
from anser_ros.apps.poses.effects.field_distortion import FieldDistortion
from anser_ros.apps.poses.fit import fit_poses
from anser_ros.apps.poses.importing import write_pose_session
from anser_ros.apps.poses.search import with_noise
from anser_ros.apps.poses.sequence import PoseSession, sequence_of
from anser_ros.apps.poses.start import coarse_clock, first_fit, pose_problem
from anser_ros.cli.main import run_verb
from anser_ros.errors import DiagnosisError, PlausibilityError

pytestmark = pytest.mark.long


def hand_eyes(found):
    return [record for record in found.records if record.name == 'hand_eye']


def test_a_clean_session_has_hand_eye_alone_and_knows_how_well():
    world = World(1)
    found = diagnose_poses(world.session())
    assert named(found) == {}
    assert found.unexplained == 0.0
    for record, lever in zip(hand_eyes(found), world.levers, strict=True):
        off = np.array(record.parameters['lever_arm_m']) - lever
        assert np.all(np.abs(off) < 5 * np.array(record.uncertainty['lever_arm_m']))
        assert np.linalg.norm(off) < 3e-4
        turn = np.deg2rad(record.parameters['registration_rotation_deg'])
        assert (Rotation.from_rotvec(turn).inv() * FRAME).magnitude() < 1e-3
        np.testing.assert_allclose(
            record.parameters['registration_translation_m'], SHIFT, atol=2e-3
        )


MIDDLE = np.array([0.05, 0.02, -0.3])


def bent(sensor, place):
    away = (place - MIDDLE) / 0.06
    return place + 1.5e-3 * away[:, [0]] * away if sensor == 1 else place


def shrunk(sensor, place):
    return MIDDLE + 0.97 * (place - MIDDLE) if sensor == 1 else place


def twice(streams):
    for rows in streams['optical']:
        rows[3::4] = rows[2:-1:4][: len(rows[3::4])] if rows.ndim == 2 else rows[3::4]
    return streams


def lossy(streams):
    streams['sensor_0'][1][100:118] = -3.697314e28
    return streams


def mirrored(streams):
    rows = streams['optical']
    rows[1][::50] += [0.057, 0, 0]
    flipped = Rotation.from_quat(rows[2][::50]) * Rotation.from_rotvec([1.5, 0, 0])
    rows[2][::50] = flipped.as_quat()
    return streams


def leaning(streams):
    for name in ('sensor_0', 'sensor_1'):
        axis = Rotation.from_quat(streams[name][2]).as_matrix()[:, :, 2]
        streams[name][1] += 5e-3 * axis[:, [0]] * axis
    return streams


def swapped(streams):
    for one, other in zip(streams['sensor_0'], streams['sensor_1'], strict=True):
        one[300:], other[300:] = other[300:].copy(), one[300:].copy()
    return streams


def polled(step, rounded=np.ceil):
    def poll(streams):
        streams['sensor_0'][0] = rounded(streams['sensor_0'][0] / step) * step
        return streams

    return poll


def late(seconds, sensor='sensor_0'):
    def shift(streams):
        streams[sensor][0] = streams[sensor][0] + seconds
        return streams

    return shift


def carried(world, share):
    """The world with only a share of its turns."""
    turn = world._turn
    world._turn = lambda time: share * turn(time)
    return world


CASES = {
    'late': ({'offset': 0.04}, {'time_offset': ('offset_s', 0.04, 5e-4)}),
    'fast': (
        {'offset': 0.02, 'rate_ppm': 900.0},
        {'time_offset': ('offset_s', 0.02, 1e-3), 'clock_rate': ('rate_ppm', 900.0, 100.0)},
    ),
    'large': ({'scale': 1.012}, {'optical_scale': ('scale', 1.012, 1.5e-3)}),
    'jittery': ({'jitter': 0.01}, {'stamp_jitter': ('rms_s', 0.01, 0.0015)}),
    'filtered': ({'tau': 0.08}, {'tracker_lag': ('tau_s', 0.08, 0.02)}),
    'far_noise': (
        {'spread': lambda s, p: (np.linalg.norm(p, axis=1) / 0.3) ** 4},
        {'range_noise': ('exponent', 4.0, 1.2)},
    ),
    'noisy': (
        {'spread': lambda s, p: np.full(len(p), 3.0 if s == 1 else 1.0)},
        {'excess_noise': ('factor', 3.0, 0.8)},
    ),
    'stale': ({'after': twice}, {'stale_poses': ('fraction', 0.25, 0.05)}),
    'lossy': ({'after': lossy}, {'missing_poses': ('fraction', 0.03, 0.005)}),
    'bent': ({'bend': bent}, {'field_distortion': ('degree', 2, 0.1)}),
    'shrunk': ({'bend': shrunk}, {'field_distortion': ('degree', 0, 0.1)}),
    'mirrored': ({'after': mirrored}, {'outliers': ('fraction', 0.02, 0.005)}),
    'swapped': ({'after': swapped}, {'swapped_sensors': ('fraction', 0.5, 0.01)}),
}


@pytest.mark.parametrize(('wrong', 'expected'), CASES.values(), ids=CASES)
def test_one_thing_wrong_is_named_with_its_size(wrong, expected):
    world = World(2)
    vars(world).update(wrong)
    found = named(diagnose_poses(world.session()))
    assert set(found) == set(expected)
    for name, (key, value, tolerance) in expected.items():
        assert found[name].parameters[key] == pytest.approx(value, abs=tolerance)


@pytest.mark.parametrize('share', [0.2, 1.0])
def test_an_error_of_orientation_is_named_and_undone_if_it_is_no_lever_arm(share):
    world = carried(World(2), share)  # with a fifth of the turns nothing tells them apart
    world.after = leaning
    found = diagnose_poses(world.session())
    assert set(named(found)) == ({'orientation_error'} if share == 1.0 else set())
    for record, lever in zip(hand_eyes(found), world.levers, strict=True):
        for value, sigma, true in zip(
            record.parameters['lever_arm_m'], record.uncertainty['lever_arm_m'], lever, strict=True
        ):
            assert value is None or abs(value - true) < 4 * sigma
    if share == 1.0:
        assert 'sensor' not in named(found)['orientation_error'].parameters
        assert found.after.position_m < 0.6e-3 < found.before.position_m
        session = corrected(world.session(), to_model(found))
        again = diagnose_poses(session)
        assert named(again) == {} and again.before.position_m < 0.6e-3


def read_as(order, sign=1):
    def change(streams):
        for name in streams:
            if name != 'optical':
                turn = streams[name][2] * [sign, sign, sign, 1]
                streams[name][2] = turn[:, order]
        return streams

    return change


@pytest.mark.parametrize(
    ('change', 'convention'),
    [(read_as([0, 1, 2, 3], -1), 'conjugate'), (read_as([3, 0, 1, 2], -1), 'wxyz_conjugate')],
)
def test_another_order_or_sense_of_quaternions_is_named_and_undone(change, convention):
    world = World(3, duration=20.0, sensors=1)
    world.after = change
    found = diagnose_poses(world.session())
    assert set(named(found)) == {'frame_convention'}
    assert named(found)['frame_convention'].parameters['quaternion'] == convention
    assert 'two axes' not in pose_verdict(to_document(found))
    assert found.after.position_m < 1e-3


def test_another_sense_is_named_of_a_body_that_turns_too_little_for_places_to_tell():
    world = carried(World(2, sensors=1), 0.25)
    world.after = read_as([3, 0, 1, 2])
    found = diagnose_poses(world.session())
    assert named(found)['frame_convention'].parameters['quaternion'] == 'wxyz'


def test_a_sensor_that_shares_no_time_with_the_reference_is_told():
    world = World(2, sensors=2)
    world.after = late(1000.0)
    found = diagnose_poses(world.session())
    assert found.left_out == ('sensor_0',)
    assert 'Left out' in pose_verdict(to_document(found))


def test_inches_are_named():
    world = World(3, duration=20.0, sensors=1)

    def inches(streams):
        streams['sensor_0'][1] = streams['sensor_0'][1] / 25.4
        return streams

    world.after = inches
    found = named(diagnose_poses(world.session()))
    assert found['frame_convention'].parameters['unit'] == 'inch taken for mm'


def test_files_that_do_not_belong_together_are_refused():
    one, other = (World(seed, duration=20.0, sensors=1).session() for seed in (4, 5))
    with pytest.raises(PlausibilityError, match='do not belong together'):
        diagnose_poses(replace(one, reference=other.reference))
    lost = replace(one.reference.rows(slice(0)), missing=np.arange(7.0))
    with pytest.raises(DiagnosisError, match='no pose of the reference, 7 missing'):
        diagnose_poses(replace(one, reference=lost))


def test_two_sensors_without_a_reference_are_compared_by_rigidity():
    world = World(6, duration=20.0)

    shift = late(0.03, 'sensor_1')
    world.after = lambda streams: shift({k: v for k, v in streams.items() if k != 'optical'})
    session = world.session()
    found = diagnose_poses(session)
    assert set(named(found)) == {'time_offset'}
    assert abs(named(found)['time_offset'].parameters['offset_s']) == pytest.approx(0.03, abs=2e-3)
    assert hand_eyes(found)[0].parameters['registration_translation_m'] is None
    alone = type(session)('x', 10**9, {'a': session.sensors['sensor_0']}, None)
    with pytest.raises(DiagnosisError, match='nothing to compare'):
        diagnose_poses(alone)


def test_a_lever_arm_that_the_motion_does_not_tell_is_not_given():
    world = carried(World(7, duration=20.0, sensors=1), 0.001)
    found = diagnose_poses(world.session())
    (record,) = hand_eyes(found)
    assert None in record.parameters['lever_arm_m']
    assert not record.evidence['observable']
    assert 'turn the body about two axes' in pose_verdict(to_document(found))


def test_the_command_writes_the_documents_that_are_promised(tmp_path, capsys):
    bag, out = tmp_path / 'a.mcap', tmp_path / 'out'
    write_pose_session(bag, World(8, duration=15.0, sensors=1).session())
    assert run_verb('diagnose', [str(bag), '--poses', '--out', str(out), '--json']) == 0
    document = json.loads(capsys.readouterr().out)
    assert document == json.loads((out / 'diagnosis.json').read_text())
    assert document['held_out']['flux_rms_before_t'] is None
    assert document['held_out']['position_rmse_after_m'] < 1e-3
    assert [effect['name'] for effect in document['effects']] == ['hand_eye']
    for row in document['noise']:
        assert 2e-4 < row['slow_m'] < 6e-4  # 3e-4, and what the reference adds between its poses
        assert row['turn_rad'] == pytest.approx(3e-3, rel=0.4)
    page = (out / 'report.html').read_text()
    assert 'Nothing was found.' in page and 'Bland' in page and page.count('<img') == 2
    x, _, z = document['effects'][0]['parameters']['lever_arm_m']
    assert f'{1e3 * x:.2f} ± ' in page and f'{1e3 * z:.2f} ± ' in page
    arguments = [str(bag), '--poses', '--out', str(out), '--tracked', 'tip=/tracked/sensor_0/pose']
    assert run_verb('evaluate', arguments) == 0
    evaluation = json.loads((out / 'evaluation.json').read_text())
    assert evaluation['sensors']['tip']['n'] > 250
    assert run_verb('diagnose', [str(bag), '--out', str(out)]) == 2
    assert '--model (or --poses)' in capsys.readouterr().err


def test_stamps_of_a_poll_are_told_from_those_that_jitter():
    world = World(12, duration=25.0, sensors=1)
    world.after = polled(0.0312, np.round)
    found = named(diagnose_poses(world.session()))
    assert set(found) == {'quantised_stamps'}
    assert found['quantised_stamps'].parameters['step_s'] == pytest.approx(0.0312, rel=0.01)
    # No rounding to the steps of a device's counter makes errors of more than half a step.
    world = World(12, duration=25.0, sensors=1)
    world.jitter, world.after = 0.005, polled(0.008, np.round)
    assert set(named(diagnose_poses(world.session()))) == {'stamp_jitter'}


@pytest.mark.parametrize('is_judged_alone', [True, False])
def test_what_makes_held_out_poses_worse_is_not_applied(is_judged_alone, monkeypatch):
    if not is_judged_alone:
        monkeypatch.setattr(diagnosis, 'unconfirmed', lambda *given: '')
    world = World(31, duration=25.0, sensors=2)

    def other_in_every_fifth_block(streams):
        for name in ('sensor_0', 'sensor_1'):
            time = streams[name][0]
            time += np.where((25 * time / 25.0).astype(int) % 5 == 3, -0.04, 0.02)
        return streams

    world.after = other_in_every_fifth_block
    found = diagnose_poses(world.session())
    assert 'time_offset' not in named(found)
    assert found.after.position_m <= 1.001 * found.before.position_m
    assert any('held-out poses are worse' in why for _, why in found.refused)


def test_a_body_at_rest_tells_no_lever_arm_and_breaks_nothing():
    world = World(3, duration=10.0, sensors=1)

    def rest(streams):
        shaken = np.random.default_rng(0)
        for rows in streams.values():
            rows[1] = rows[1][0] + 1e-5 * shaken.normal(size=rows[1].shape)
            rows[2] = np.tile(rows[2][0], (len(rows[2]), 1))
        return streams

    world.after = rest
    found = diagnose_poses(world.session())
    assert hand_eyes(found)[0].parameters['lever_arm_m'] == [None] * 3
    assert named(found) == {}  # noise has no extent that tells a unit, and no velocity


@pytest.mark.parametrize(('strain', 'expected'), [(0.0, {'time_offset'}), (0.02, set())])
def test_a_body_that_is_only_carried_tells_the_clock_where_that_leaves_nothing(strain, expected):
    world = carried(World(5, duration=30.0), 0.01)
    world.offset = 0.03
    world.bend = lambda sensor, place: place + sensor * strain * (place - MIDDLE)
    found = diagnose_poses(world.session())
    assert set(named(found)) == expected
    assert (found.unexplained > 0.5) == (not expected)


@pytest.mark.parametrize('sensors', [1, 2])
def test_a_scale_that_a_distortion_fakes_is_none(sensors):
    world = World(24, duration=30.0, sensors=sensors)
    strain = 3e-3 * np.random.default_rng(24).normal(size=(3, 3))
    world.bend = lambda sensor, place: place + (place - MIDDLE) @ strain
    fit = diagnose_poses(world.session()).fit
    assert not any(term.role is Role.SCALE for term in fit.terms)
    problem = replace(fit.state.problem)
    (scale,) = effect_with(Role.SCALE).sites(problem.setting)
    trial = fit_poses(problem, [*(t for t in fit.terms if t.role is not Role.MAP), scale])
    faked = np.sqrt(np.diag(trial.covariance)[-1])
    assert faked > 3 * np.sqrt(np.diag(trial.noise_covariance)[-1])
    assert abs(1e3 * np.trace(strain) / 3) < 3 * faked
    assert faked < 3.0  # 1e-3


def test_a_scale_comes_first_and_then_what_a_distortion_adds_to_it():
    world = World(1, duration=60.0, sensors=4)
    world.scale = 1.012

    def bend(sensor, place):
        x, y, z = ((place - MIDDLE) / 0.08).T
        return place + 0.55e-3 * np.stack([x * y, z**2 - 0.5, x * z], axis=1)

    world.bend = bend
    found = named(diagnose_poses(world.session()))
    assert set(found) == {'optical_scale', 'field_distortion'}
    scale, sigma = found['optical_scale'].parameters, found['optical_scale'].uncertainty
    assert abs(scale['scale'] - 1.012) < 3 * sigma['scale'] < 0.012
    bend = found['field_distortion'].parameters
    assert bend['is_equal'] and 5e-4 < bend['rms_m'] < 3e-3
    # What the map strains unevenly is what a distortion fakes of the scale: a ninth, squared.
    strain = np.reshape(bend['coefficients_mm'][:9], (3, 3)) * 1e-3 / bend['size_m']
    strain = (strain + strain.T) / 2 - np.trace(strain) / 3 * np.eye(3)
    assert sigma['scale'] == pytest.approx(np.linalg.norm(strain) / 3, rel=0.05)


def test_what_two_sensors_of_three_have_is_theirs_and_says_where_they_are():
    world = World(14, duration=30.0, sensors=3)
    world.bend = lambda sensor, place: MIDDLE + (0.98 + 0.02 * (sensor == 2)) * (place - MIDDLE)
    maps = [r for r in diagnose_poses(world.session()).records if r.name == 'field_distortion']
    assert {r.parameters['sensor'] for r in maps} == {'sensor_0', 'sensor_1'}
    for record in maps:
        near = [np.linalg.norm(MIDDLE + world.levers[k]) for k in range(3)]
        own = near.pop(int(record.parameters['sensor'][-1]))
        said = record.parameters
        assert (said['distance_own_m'] > said['distance_others_m']) == (own > np.mean(near))


@pytest.mark.parametrize('far', [0.0, -0.16])
def test_no_sensor_is_noisy_for_its_distance_or_the_step_of_its_positions(far):
    world = World(5, duration=25.0, sensors=3, rate=40.0)
    world.levers[2], world.noise_m = [0.02, 0.0, far], 2e-5
    own = 4.0 if far == 0.0 else 1.0  # a sensor that is noisy where the others are
    world.spread = lambda sensor, place: (
        (own if sensor == 2 else 1.0) * (1 + 4 * (np.linalg.norm(place, axis=1) / 0.35) ** 4)
    )

    def after(streams):
        for name, rows in streams.items():
            rows[1] = rows[1] if name == 'optical' else np.round(rows[1] / 1e-4) * 1e-4
        return streams

    world.after = after
    assert ('excess_noise' in named(diagnose_poses(world.session()))) == (far == 0.0)


def test_a_clean_baseline_shows_metal_that_a_session_has_all_the_time(tmp_path):
    world = World(35, duration=50.0)
    world.offset = 0.02
    early = world.session()

    def cut(start, end):
        rows = {k: p.rows((p.time >= start) & (p.time < end)) for k, p in early.streams.items()}
        return replace(early, reference=rows.pop('optical'), sensors=rows)

    baseline, session = cut(0.0, 26.0), cut(26.0, 60.0)
    near = {
        k: replace(p, position=p.position + [0.004, 0.003, 0.0] * (p.time > 36)[:, None])
        for k, p in session.sensors.items()
    }
    found = diagnose_poses(replace(session, sensors=near), baseline=baseline)
    metal = named(found)['moving_metal'].parameters
    assert abs(metal['t_start_s'] - 36) < 3
    assert found.outside_m < 1e-3 < found.after.position_m and found.unexplained == 0.0
    assert min(part.view.time.min() for part in found.states[1].parts) > 25.9


def test_the_slow_beat_of_a_poll_is_no_rate_of_the_clock():
    world = World(206, duration=32.0, sensors=1, rate=1 / (2.0016 * 0.03))
    world.after = polled(0.03)
    assert 'clock_rate' not in named(diagnose_poses(world.session()))


def test_errors_of_a_poll_are_not_as_uncertain_as_random_ones():
    world = World(13, duration=40.0, sensors=1, rate=17.0)
    world.after = polled(0.03)
    offset = named(diagnose_poses(world.session()))['time_offset']
    sigma = offset.uncertainty['offset_s']
    assert sigma < 0.7 * 0.03 / np.sqrt(12 * 17 * 40)
    assert abs(offset.parameters['offset_s'] - 0.015) < 4 * sigma


def test_a_slow_filter_whose_error_hides_the_lever_arm_is_found():
    world = World(260817, duration=40.0, sensors=1, rate=13.5, optical_rate=28.0)
    world.tau = 0.16
    assert set(named(diagnose_poses(world.session()))) == {'tracker_lag'}


@pytest.mark.parametrize('motion', ['in circles', 'far and near', 'about a tip', 'carried'])
def test_nothing_is_named_on_a_clean_session(motion):
    stream = STREAMS[list(MOTIONS).index(motion) % len(STREAMS)]
    assert named(diagnose_poses(clean_world(70, motion, stream).session())) == {}


def test_a_filter_that_takes_off_the_noise_of_the_reference_and_some_by_chance_is_none():
    # What it takes off is 0.201 mm, and the reference's noise 0.175 mm.
    world = clean_world(13842, 'with stops', 'irregular')
    assert named(diagnose_poses(world.session())) == {}


@pytest.mark.parametrize('size', [0.0, 2.0])
def test_a_map_has_to_take_its_size_off_the_errors_of_positions(size):
    world = World(5, duration=20.0, sensors=1)
    world.bend = lambda sensor, place: (
        place + 1e-3 * size * ((place - place.mean(axis=0)) / 0.06) ** 2
    )
    problem = pose_problem(world.session())
    rest = with_noise(first_fit(problem, coarse_clock(problem), False))
    term = FieldDistortion().at(problem.setting, 2, None)
    bent = fit_poses(rest.state.problem, [*rest.terms, term])
    why = unconfirmed(rest, bent, bent.terms[-1], bent.state.problem)
    assert why == ('' if size else 'takes less than 0.5 mm off the errors of positions')


def test_an_offset_of_seconds_is_found_by_the_shape_of_the_motion():
    world = World(2, duration=20.0, sensors=1)
    world.offset = 3.076
    found = named(diagnose_poses(world.session()))
    assert set(found) == {'time_offset'}
    assert found['time_offset'].parameters['offset_s'] == pytest.approx(3.076, abs=5e-4)


def test_what_fits_at_no_offset_is_refused_in_words_of_time():
    one, other = (World(seed, duration=15.0, sensors=1).session() for seed in (2, 3))
    with pytest.raises(PlausibilityError, match='best offset of their clocks, up to 16 s'):
        diagnose_poses(replace(one, reference=other.reference))


def at_rest(seed, count, length=5.0):
    """Recordings at rest with an error of their own each, and noise that grows with distance."""
    rng, streams = np.random.default_rng(seed), {}
    places = rng.normal(0, 0.08, (count, 3)) + [0.05, 0.02, -0.25]
    turns = Rotation.from_rotvec(rng.normal(0, 0.35, (count, 3)))
    for name, rate in (('sensor_0', 40), ('sensor_1', 40), ('optical', 20)):
        one = np.repeat(np.arange(count), int(rate * length))
        time = 15.0 * one + np.tile(np.arange(int(rate * length)), count) / rate
        place, turn = places[one], turns[one]
        if name == 'optical':
            place, turn, noise = FRAME.inv().apply(place - SHIFT), FRAME.inv() * turn, 3e-5
        else:
            place = place + turn.apply([0.03, -0.02, 0.05]) + rng.normal(0, 9e-4, (count, 3))[one]
            turn = Rotation.from_rotvec(rng.normal(0, 3e-3, (count, 3))[one]) * turn
            noise = 2e-4 * (np.linalg.norm(place, axis=1, keepdims=True) / 0.3) ** 5
        place = place + noise * rng.normal(size=place.shape)
        turn = Rotation.from_rotvec(1e-3 * rng.normal(size=place.shape)) * turn
        streams[name] = sequence_of(name, time + 1.0, place, turn.as_quat())
    reference = streams.pop('optical')
    return PoseSession('simulated', 10**9, streams, reference)


def test_bodies_at_rest_have_no_clock_however_many_and_noisy_they_are():
    for count in (6, 91):
        assert pose_problem(at_rest(5, count)).path.is_at_rest
    names = named(diagnose_poses(at_rest(5, 20)))
    assert not set(names) & {'time_offset', 'clock_rate', 'stamp_jitter', 'tracker_lag'}


def test_turns_that_change_at_a_time_are_an_episode_of_the_sensor_that_turns_most():
    world = World(1, duration=86.0, sensors=2, rate=5.0)
    world.jitter = 0.017

    def after(streams):
        for name, degrees in (('sensor_0', 3.0), ('sensor_1', 0.5)):
            rows = streams[name]
            late = rows[0][:, None] > 68
            turn = Rotation.from_rotvec(late * np.deg2rad(degrees) * [0.6, -0.5, 0.62])
            rows[1] = rows[1] + 1e-3 * late * [0.6, 0.5, -0.6]
            rows[2] = (turn * Rotation.from_quat(rows[2])).as_quat()
        return streams

    world.after = after
    records = diagnose_poses(world.session()).records
    (metal,) = (r.parameters for r in records if r.name == 'moving_metal')
    assert metal['sensors'] == ['sensor_0']
    assert metal['t_start_s'] == pytest.approx(69, abs=2)
    assert metal['t_end_s'] == pytest.approx(87, abs=2)


def test_metal_at_a_place_is_named_at_every_visit_and_neither_as_noise_nor_as_a_map():
    world, middles = World(1, duration=90.0, sensors=2, rate=5.0), (15.0, 34.0, 55.0, 76.0)
    plain, spot = world._place, np.array([0.12, -0.02, 0.03])

    def place(time):
        away = np.min(np.abs(np.subtract.outer(time, middles)), axis=1)
        there = 1 / (1 + np.exp((away - 1.6) / 0.2))
        return plain(time) * (1 - there)[:, None] + there[:, None] * (spot + 0.2 * plain(time))

    def after(streams):
        for name, share in (('sensor_0', 1.0), ('sensor_1', 0.6)):
            rows = streams[name]
            body = world.body(rows[0])[0] - [0.05, 0.02, -0.3]
            near = share * np.exp(-(((body - spot) / 0.03) ** 2).sum(axis=1))[:, None]
            rows[1] = rows[1] + 0.015 * near * [0.7, 0.5, -0.5]
            turn = Rotation.from_rotvec(0.14 * near * [0.5, 0.5, 0.7])
            rows[2] = (turn * Rotation.from_quat(rows[2])).as_quat()
        return streams

    world.follow(place, world._turn)
    world.after = after
    records = [r for r in diagnose_poses(world.session()).records if r.name != 'hand_eye']
    assert {r.name for r in records} == {'moving_metal'}
    found = [(r.parameters['t_start_s'] + r.parameters['t_end_s']) / 2 - 1 for r in records]
    np.testing.assert_allclose(found, middles, atol=1)


def test_a_scale_of_all_sensors_is_named_as_such_beside_a_bend():
    world = World(1, duration=30.0, sensors=3, rate=20.0)
    world.scale = 1.012

    def bend(sensor, place):
        x, y, z = ((place - MIDDLE) / 0.08).T
        return place + 8e-4 * np.stack([x * y, z**2 - 0.5, x * z], axis=1)

    world.bend = bend
    found = named(diagnose_poses(world.session()))
    assert found['optical_scale'].parameters['scale'] == pytest.approx(1.012, abs=2e-3)
    assert set(found) <= {'optical_scale', 'field_distortion'}


@pytest.mark.parametrize('is_turned', [False, True])
def test_metal_that_stands_in_the_volume_turns_sensors_and_a_map_of_the_trackers_own_does_not(
    is_turned,
):
    world = World(977, duration=60.0)

    def distorted(streams):
        for name in ('sensor_0', 'sensor_1'):
            away = (streams[name][1] - [0.15, 0.02, -0.3]) / 0.12
            near = np.exp(-np.sum(away**2, axis=1, keepdims=True))
            streams[name][1] = streams[name][1] + 0.015 * near * [0.7, 0.5, -0.5]
            if is_turned:
                turn = Rotation.from_rotvec(np.deg2rad(8) * near * [0.5, 0.5, 0.7])
                streams[name][2] = (turn * Rotation.from_quat(streams[name][2])).as_quat()
        return streams

    world.after = distorted
    assert ('moving_metal' in named(diagnose_poses(world.session()))) == is_turned
