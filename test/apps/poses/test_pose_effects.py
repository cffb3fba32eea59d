"""Single parts of the diagnosis of poses, each against what it has to be by definition."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from pose_world import FRAME, SHIFT, World
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.cli.pose_session import sizes
from anser_ros.apps.poses.diagnosis import depends_on
from anser_ros.apps.poses.effect import PoseSetting, Role, pose_effects
from anser_ros.apps.poses.effects.episodes import LooseMount, PoseMovingMetal
from anser_ros.apps.poses.effects.field_distortion import FieldDistortion, OrientationError
from anser_ros.apps.poses.effects.frames import PoseClockRate, PoseOpticalScale
from anser_ros.apps.poses.effects.stream import ReceiptJitter, power_law, stamp_step, sudden_poses
from anser_ros.apps.poses.fit import is_lever_determined
from anser_ros.apps.poses.hand_eye import one_clock
from anser_ros.apps.poses.problem import PoseNoise
from anser_ros.apps.poses.search import doubt, with_noise
from anser_ros.apps.poses.sequence import OpticalPath, PoseSession, sequence_of
from anser_ros.apps.poses.start import coarse_clock, first_fit, pose_problem, started
from anser_ros.field.model import EffectRecord
from anser_ros.physics.pose_track import PoseTrack

SETTING = PoseSetting(('sensor_0', 'sensor_1'), 0.0, 40.0, np.zeros(3), 0.06)


class Plain(SimpleNamespace):
    """Stands for residuals, by which episodes are found once."""

    __hash__ = object.__hash__


def test_the_clock_undoes_a_rate_exactly():
    true = np.linspace(0, 40, 9)
    stamps = true + 2.5e-3 * (true - 20)
    term = PoseClockRate().sites(SETTING)[0].with_theta(np.array([2.5]))
    np.testing.assert_allclose(PoseClockRate().clock(term, 'sensor_0', stamps), true, atol=1e-12)


# Clocks agree at the middle, or at the start: 20 s at 1000 ppm.
@pytest.mark.parametrize(
    ('offset_s', 'is_alike'), [(0.0, True), (0.02, True), (0.008, False), (-0.02, False)]
)
def test_clocks_that_were_set_alike_have_no_offset_beside_their_rate(offset_s, is_alike):
    rate = EffectRecord('clock_rate', {'rate_ppm': 1000.0, 'middle_s': 20.0}, {})
    offset = EffectRecord('time_offset', {'offset_s': offset_s}, {})
    found = one_clock([offset, rate], 40.0)
    assert [r.name for r in found] == ['time_offset', 'clock_rate'][is_alike:]
    assert found[-1].parameters['offset_s'] == offset_s


def test_a_poll_is_told_by_poses_that_share_a_stamp_or_by_its_beat():
    taken = np.arange(0, 20, 1 / 92)
    assert stamp_step(np.ceil(taken / 0.016) * 0.016) == pytest.approx(0.016)
    assert stamp_step(np.arange(0, 20, 0.016)) == 0.0  # the tracker's own rate
    taken = np.arange(0, 40, 1 / 32.5)
    assert stamp_step(np.ceil(taken / 0.03) * 0.03) == pytest.approx(0.03)
    own, rng = np.arange(1600), np.random.default_rng(1)
    assert stamp_step(0.025 * own[rng.random(own.size) > 0.02]) == 0.0  # lost at random
    assert stamp_step(0.025 * own[own // 64 % 5 != 3]) == 0.0  # blocks that are held out


@pytest.mark.parametrize('poses_a_step', [0.37161, 0.27639, 0.35, 0.25, 1 / 3])
def test_poses_are_thinned_out_of_step_with_a_poll(poses_a_step):
    # Two poses are 2 / 0.37161 = 5.38197 steps, which is 6 less the golden section.
    step = 0.016
    taken = np.arange(1800) * step / poses_a_step
    stamp = np.ceil(taken / step - 1e-9) * step
    place, turn = World(6, duration=float(taken[-1])).body(taken)
    poses = sequence_of('sensor_0', stamp, place, turn.as_quat())
    session = PoseSession('simulated', 10**9, {'sensor_0': poses}, poses)
    kept = np.searchsorted(stamp, pose_problem(session).sensors[0].time)
    late = stamp - taken
    assert 500 < kept.size <= 900
    assert late[kept].mean() == pytest.approx(late.mean(), abs=0.03 * step)


def test_at_rest_nothing_depends_on_speed():
    session = World(7, sensors=1).session()
    problem = pose_problem(session)
    still = replace(problem, path=replace(problem.path, is_at_rest=True))
    assert 'speed' not in depends_on(still.state(started(still, coarse_clock(still))))


def test_a_short_motion_with_little_error_gives_no_lever_arm():
    world = World(6, duration=12.0, sensors=1)
    world.noise_m, slow = 5e-5, world._turn
    world._turn = lambda time: 0.06 * slow(time)
    problem = pose_problem(world.session())
    fit = with_noise(first_fit(problem, coarse_clock(problem), False))
    assert not is_lever_determined(fit.state.parts[0], 0.0).any()


@pytest.mark.parametrize('shared', [True, False])
def test_jitter_of_stamps_is_known_as_well_as_that_of_so_many_poses_can_be(shared):
    rng = np.random.default_rng(8)
    sensors = []
    for k in range(2):
        time = np.sort(rng.uniform(0, 40, 300)) if k == 0 or not shared else sensors[0].view.time
        velocity = np.tile([0.0, 0.2, 0.0, 0.0, 0.0, 0.0], (300, 1))  # 2 mm in 10 ms
        sensors.append(SimpleNamespace(
            view=SimpleNamespace(sensor=f'sensor_{k}', time=time, velocity=velocity),
            used=np.ones(300, dtype=bool), noise=PoseNoise(1e-5, 1e-3, 0.01), stamp_gain=3000.0,
        ))  # fmt: skip
    streams = {s.view.sensor: s.view for s in sensors}
    residuals = SimpleNamespace(sensors=sensors, session=SimpleNamespace(sensors=streams))
    (record,) = ReceiptJitter().observed(residuals)
    # A standard deviation of n values is known to its 1 / sqrt(2 n).
    known = 0.01 / np.sqrt(2 * (300 if shared else 600))
    assert record.uncertainty['rms_s'] == pytest.approx(known, rel=1e-3)


def test_a_path_knows_the_noise_of_its_poses_at_a_point_of_the_body():
    rng, time = np.random.default_rng(4), np.cumsum(np.full(2000, 0.03))
    place, turn = World(5, duration=time[-1]).body(time)
    place = place + 2e-4 * rng.normal(size=place.shape)
    turn = Rotation.from_rotvec(2e-3 * rng.normal(size=place.shape)) * turn
    path = OpticalPath.through(PoseTrack(time, place, turn.as_quat()))
    lever = np.array([0.0, 0.1, 0.0])
    # A turn about two of three axes moves the point.
    expected = np.sqrt(2e-4**2 + (2e-3 * 0.1) ** 2 * 2 / 3)
    assert path.jitter(np.zeros(3)) == pytest.approx(2e-4, rel=0.05)
    assert path.jitter(lever) == pytest.approx(expected, rel=0.05)


def test_poses_of_nearly_one_stamp_do_not_bend_a_path():
    true = np.arange(100) / 20
    place, turn = World(5).body(true)
    stamps = np.where(np.arange(100) % 10 == 5, true - 0.0499, true)  # received early
    path = OpticalPath.through(PoseTrack(stamps, place, turn.as_quat()))
    found, _, _, known = path.at(true[10:-10] + 0.02)
    assert known.all()
    assert np.abs(found - World(5).body(true[10:-10] + 0.02)[0]).max() < 2e-3


def test_a_map_of_one_sensor_may_shift_it_and_one_of_all_may_not():
    effect, place = FieldDistortion(), np.array([[0.01, -0.02, 0.03], [0.0, 0.0, 0.0]])
    own, every = effect.at(SETTING, 2, 'sensor_1'), effect.at(SETTING, 2, None)
    assert own.theta.size == every.theta.size + 3 == 30
    shift = own.with_theta(np.r_[1.0, -2.0, 3.0, np.zeros(27)])
    moved = effect.corrected(shift, 'sensor_1', place, np.zeros((2, 3, 3))) - place
    np.testing.assert_allclose(moved, [[1e-3, -2e-3, 3e-3]] * 2)
    record = effect.record(shift, np.eye(30))
    assert record.parameters['strain'] == 0.0  # a shift strains nothing
    again = effect.term(record)
    assert again.site == own.site and np.array_equal(again.theta, shift.theta)


def test_an_orientation_error_is_an_even_function_of_the_axis_without_a_mean():
    effect, turns = OrientationError(), Rotation.random(20000, random_state=1)
    every, own, _ = effect.sites(SETTING)
    term = every.with_theta(np.random.default_rng(2).normal(size=15))
    place = np.zeros((20000, 3))
    moved = effect.corrected(term, 'sensor_0', place, turns.as_matrix())
    about = turns * Rotation.from_rotvec([0.0, 0.0, 0.7]) * Rotation.from_rotvec([np.pi, 0, 0])
    np.testing.assert_allclose(
        effect.corrected(term, 'sensor_0', place, about.as_matrix()), moved, atol=1e-12
    )
    assert np.linalg.norm(moved.mean(axis=0)) < 0.02 * np.sqrt(np.mean(moved**2))
    again = effect.term(effect.record(term, np.eye(15)))
    assert again.site == {} and np.array_equal(again.theta, term.theta)
    bend = FieldDistortion().at(SETTING, 2, None)
    assert effect.covers(term, own) and not effect.covers(own, term)
    assert not effect.covers(term, bend) and not bend.effect.covers(bend, term)
    assert not effect.covers(term, PoseOpticalScale().sites(SETTING)[0])


@pytest.mark.parametrize(
    ('last', 'pulled_m', 'named'),
    [
        (40.0, 1e-3, ['sensor_2']),  # the body tells, though the places are visited once
        (31.0, 1e-3, []),  # too short a stay to be told from a smooth distortion
        (40.0, 4e-3, []),  # all are off: a distortion of the volume, or the reference
    ],
)
def test_metal_deep_in_the_volume_is_told_by_the_other_sensors(last, pulled_m, named):
    records = episodes_of(((30, last, (pulled_m, pulled_m, 4e-3)),))
    assert [name for r in records for name in r.parameters['sensors']] == named


def test_metal_is_told_by_the_body_where_stamps_jitter_more_than_it_pulls():
    # One error of the stamps moves all sensors alike, so that it is in no difference of two.
    (record,) = episodes_of(((26, 38, (0.0, 0.0, 4e-3)),), shared_m=1e-3)
    assert record.parameters['sensors'] == ['sensor_2']
    assert record.parameters['t_start_s'] == pytest.approx(26.0, abs=1.1)
    assert not episodes_of(((26, 38, (4e-3, 4e-3, 4e-3)),), shared_m=1e-3)
    assert not episodes_of(((26, 38, (0.0, 0.0, 1.7e-3)),))  # the tracker's own error


def test_metal_at_one_sensor_leaves_the_episodes_of_others_at_other_times():
    away, near = (30, 40, (0.0, 0.0, 4e-3)), (4, 8, (4e-3, 0.0, 0.0))
    first, second = (r.parameters for r in episodes_of((near, away), returns=True))
    assert (first['sensors'], second['sensors']) == (['sensor_0'], ['sensor_2'])
    times = [first['t_start_s'], first['t_end_s'], second['t_start_s']]
    assert times == pytest.approx([4.0, 8.0, 30.0], abs=1.0)


def test_a_long_error_of_a_slow_tracker_is_an_episode_though_no_place_is_visited_twice():
    (record,) = episodes_of(((30, 40, (4e-3, 4e-3, 4e-3)),), returns=True, wide_m=0.2)
    assert record.parameters['t_start_s'] == pytest.approx(30.0, abs=1.1)
    assert not episodes_of(((30, 40, (4e-3, 4e-3, 4e-3)),))  # it may be the place


@pytest.mark.parametrize(('is_of_place', 'named'), [(False, ['sensor_0']), (True, [])])
def test_what_comes_again_at_a_place_is_no_loose_mount(is_of_place, named):
    rng, time = np.random.default_rng(6), np.arange(0, 60, 0.1)
    place = 0.06 * np.sin(np.outer(time, [0.21, 0.17, 0.13]))
    sensors = []
    for k in range(2):
        residual = 3e-4 * rng.normal(size=(time.size, 6))
        course = place[:, 0] / 0.06 if is_of_place else np.sin(0.43 * time)
        residual[:, 0] += (4e-3 if k == 0 else 0.0) * course
        every, same = np.ones(time.size, dtype=bool), np.tile(np.eye(3), (time.size, 1, 1))
        view = SimpleNamespace(
            sensor=f'sensor_{k}', time=time, measured=place, velocity=np.zeros((time.size, 6)),
            frame=np.eye(3), turn=same,
        )  # fmt: skip
        noise = PoseNoise(3e-4, 3e-4)
        sensors.append(Plain(view=view, residual=residual, noise=noise, used=every, out=~every))
    setting = PoseSetting(('sensor_0', 'sensor_1'), 0.0, 60.0, np.zeros(3), 0.1)
    records = LooseMount().observed(Plain(sensors=sensors, setting=setting))
    assert [r.parameters['sensor'] for r in records] == named


def episodes_of(spans, *, returns=False, shared_m=0.0, wide_m=0.0):
    """Moving metal of three sensors that are off by so much in some spans of 40 s.

    A body that ``returns`` is at each place again, and the metal is not. All sensors are off by
    ``shared_m`` in common. The body may be anywhere within ``wide_m`` each second.
    """
    rng, time = np.random.default_rng(5), np.arange(0, 40, 0.1)
    depth = 0.03 * np.sin(2 * time) if returns else 0.01 * time
    place = np.column_stack([0 * time, 0 * time, -depth])
    place += wide_m * np.repeat(rng.uniform(-1, 1, (40, 3)), 10, axis=0)
    shared = shared_m * np.repeat(rng.normal(size=(time.size // 5, 6)), 5, axis=0)
    sensors = []
    for k in range(3):
        residual = 3e-4 * rng.normal(size=(time.size, 6)) + shared
        for first, last, pulls in spans:
            residual[(time > first) & (time < last), 0] += pulls[k]
        still, noise = np.zeros((time.size, 6)), PoseNoise(3e-4, 3e-4)
        view = SimpleNamespace(
            sensor=f'sensor_{k}', time=time, measured=place, velocity=still,
            position=place - residual[:, :3],
        )  # fmt: skip
        every = np.ones(time.size, dtype=bool)
        sensors.append(Plain(view=view, residual=residual, noise=noise, used=every, out=~every))
    setting = PoseSetting(('sensor_0', 'sensor_1', 'sensor_2'), 0.0, 40.0, np.zeros(3), 0.1)
    return PoseMovingMetal().observed(Plain(sensors=sensors, setting=setting))


def test_the_exponent_of_noise_is_found_with_an_honest_sigma():
    # Samples so far apart that neighbours lie at quite other distances.
    found = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        distance = 0.3 + 0.1 * np.sin(np.arange(700) * 0.7 + rng.uniform(0, 6))
        noise = (distance / 0.3)[:, None] ** 4 * rng.normal(0, 3e-4, (700, 2))
        second = noise[1:-1] - 0.5 * (noise[:-2] + noise[2:])
        about = np.stack([distance[:-2], distance[1:-1], distance[2:]], axis=1)
        exponent, sigma, gain = power_law(np.sum(second**2, axis=1) / 3, about)
        assert gain > 25
        found.append((exponent - 4) / sigma)
    assert 0.4 < np.sqrt(np.mean(np.square(found))) < 1.6
    assert abs(np.mean(found)) < 0.9


def test_a_map_is_as_large_as_it_moves_the_poses_beside_a_rigid_motion():
    effect, rng = FieldDistortion(), np.random.default_rng(3)
    term = effect.at(SETTING, 1, None)
    place = np.column_stack([0.05 * rng.normal(size=(500, 2)), np.zeros(500)])
    turns = np.tile(np.eye(3), (500, 1, 1))
    views = [SimpleNamespace(sensor='sensor_0', measured=place, measured_rotation=turns)]
    stretch = np.zeros((3, 3))
    stretch[0, 0], stretch[1, 0], stretch[0, 1] = 2.0, 1.0, -1.0  # and a turn, which is none
    stretch[2, 2] = 50.0  # along an axis that no pose is off
    term = term.with_theta(stretch.ravel())
    record = effect.seen_at(effect.record(term, np.eye(9)), term, 0.01 * np.eye(9), views)
    expected = 2e-3 * np.std(place[:, 0]) / SETTING.size
    assert record.parameters['rms_m'] == pytest.approx(expected, rel=0.02)
    assert 0 < record.uncertainty['rms_m'] < 2e-4


def test_an_offset_of_all_sensors_that_is_less_than_known_is_doubted():
    for offset, is_doubted in ((0.0, True), (0.03, False)):
        world = World(4, duration=15.0, sensors=1)
        world.offset = offset
        problem = pose_problem(world.session())
        fit = with_noise(first_fit(problem, coarse_clock(problem), False))
        index = next(i for i, t in enumerate(fit.terms) if t.role is Role.OFFSET)
        assert bool(doubt(fit, index)) == is_doubted


def test_recordings_at_rest_one_after_the_other_are_compared_whole():
    # The reference is recorded for a second, and the tracker after it: they share no time.
    world, rng = World(5, duration=200.0, sensors=1), np.random.default_rng(5)
    streams = {'sensor_0': [], 'optical': []}
    for start in 10.0 * np.arange(12):
        place, turn = world.sensor(0, np.full(30, start))
        place = place + 2e-4 * rng.normal(size=place.shape)
        streams['sensor_0'].append((start + 2.0 + 0.05 * np.arange(30), place, turn.as_quat()))
        place, turn = world.body(np.full(20, start))
        rows = FRAME.inv().apply(place - SHIFT), (FRAME.inv() * turn).as_quat()
        streams['optical'].append((start + 0.05 * np.arange(20), *rows))
    made = {
        name: sequence_of(name, *(np.concatenate(v) for v in zip(*rows, strict=True)))
        for name, rows in streams.items()
    }
    session = PoseSession('', 10**9, {'sensor_0': made['sensor_0']}, made['optical'])
    problem = pose_problem(session)
    assert problem.path.is_at_rest
    assert problem.path.at(problem.sensors[0].time)[3].all()
    fit = with_noise(first_fit(problem, coarse_clock(problem), False))
    assert fit.state.rms()[0] < 1e-3


@pytest.mark.parametrize(
    ('parameters', 'sigmas', 'lines'),
    [
        (
            {'offset_s': 0.03005, 'middle_s': 7.0}, {'offset_s': 5.8e-5},
            ['offset: 30.05 ± 0.06 ms'],
        ),
        (
            {'kind': 'linear', 'degree': 1, 'rms_m': 0.002, 'coefficients_mm': [1.0] * 30},
            {'rms_m': 1e-4}, ['kind: linear', 'rms: 2.00 ± 0.10 mm'],
        ),
        (
            {'rms_s': 0.0069, 'by_sensor': {'tip': 0.0071}}, {'rms_s': 0.0002},
            ['rms: 6.9 ± 0.2 ms', 'by sensor: tip 7.10 ms'],
        ),
        ({'t_start_s': 6.73, 'sensors': ['tip']}, {'t_start_s': 0.5},
         ['start: 6.7 s', 'sensors: [tip]']),
        ({'spans': [[3.25, 5.91], [7.0, 8.0]], 'quaternion': 'wxyz'}, {},
         ['spans: 3.2 to 5.9, 7.0 to 8.0 s', 'quaternion: scalar first']),
        ({'times_s': {'tip': [1.5, 20.25], 'pen': []}, 'recordings': {'tip': [1, 3], 'pen': []}},
         {}, ['tip at 1.50 (recording 1), 20.25 (recording 3) s']),
    ],
)  # fmt: skip
def test_sizes_are_told_in_the_units_of_a_clinic(parameters, sigmas, lines):
    assert [line.replace('\xa0', ' ') for line in sizes(parameters, sigmas)] == lines


def test_every_name_says_what_to_do():
    named = [effect for effect in pose_effects().values() if not effect.role.is_frame]
    assert all(effect.words['summary'] and effect.words['advice'] for effect in named)


def test_an_error_that_comes_and_goes_gradually_is_no_outlier():
    size = np.zeros(60)
    size[8:17] = [1, 2, 4, 6, 8, 6, 4, 2, 1]
    size[[30, 40, 41, 42]] = 50  # one pose in the marker's other solution, and three in a row
    sensing = SimpleNamespace(
        used=size <= 3, out=size > 3, noise=PoseNoise(4e-4, 3e-3),
        residual=1e-3 * size[:, None] * np.eye(6)[0],
        view=SimpleNamespace(velocity=np.zeros((60, 6))),
    )  # fmt: skip
    assert np.flatnonzero(sudden_poses(sensing)).tolist() == [30, 40, 41, 42]


def test_errors_that_go_with_turns_are_in_the_sigma_of_a_lever_arm():
    found = []
    for seed in range(5):
        world = World(seed, duration=20.0, sensors=1)
        matrix = 2e-3 * np.random.default_rng(seed).normal(size=(3, 3))  # m a rad

        def after(streams, matrix=matrix):
            turns = Rotation.from_quat(streams['sensor_0'][2])
            streams['sensor_0'][1] += (turns.mean().inv() * turns).as_rotvec() @ matrix
            return streams

        world.after = after
        problem = pose_problem(world.session())
        fit = with_noise(first_fit(problem, coarse_clock(problem), False))
        index = next(i for i, t in enumerate(fit.terms) if t.role is Role.MOUNT)
        variance = np.diag(fit.covariance_of(index))[:3]
        error = fit.terms[index].theta[:3] - world.levers[0]
        found.append([error**2 / variance, error**2 / (variance + fit.faked_levers['sensor_0'])])
    without, honest = np.sqrt(np.mean(found, axis=(0, 2)))
    assert without > 4 and 0.5 < honest < 2.0  # of fifteen values
