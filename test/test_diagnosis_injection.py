"""Effects put into a small session in memory: those of the table are named, others are not.

The whole confusion table, on recorded sessions, is a benchmark (`bench/bench_diagnosis.py`).
"""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis_world import world
from injection import CATALOGUE, LISTED, SIZES, UNLISTED
from injection_subject import NOISE_T
from scipy.spatial.transform import Rotation

from anser_ros.diagnosis.diagnose import Diagnosis, diagnose
from anser_ros.diagnosis.screening import outlying_share, without_outliers
from anser_ros.effects.effect import all_effects
from anser_ros.physics.pose_track import PoseTrack


def found(names: str, seed: int, emitters: int = 2) -> tuple[Diagnosis, dict]:
    rng, target, truth = np.random.default_rng(seed), world(seed, 375, emitters), {}
    every = {**LISTED, **UNLISTED}
    for injection in sorted((every[n] for n in names.split('+')), key=lambda i: i.stage):
        truth |= injection.put(target, rng, SIZES['medium'])
    return diagnose(target.problem(), target.model), truth


@pytest.mark.long
def test_effects_of_the_table_are_named_and_nothing_else():
    result, truth = found('pickup+coil_drift', 1)
    assert sorted(f.record.name for f in result.findings) == sorted(truth)
    compared = 0
    for finding in result.findings:
        wanted, record = truth[finding.record.name], finding.record
        for key, sigma in record.uncertainty.items():
            if key in wanted:
                error = np.asarray(record.parameters[key]) - np.asarray(wanted[key])
                assert np.all(np.abs(error) < 5 * np.asarray(sigma)), (record.name, key)
                compared += 1
    assert compared == 3, 'amount and tau_s of the drift, phasor_t of the pickup'
    assert result.flux_rms_after_t < 1.1 * result.flux_rms_floor_t
    assert result.unexplained == 0.0


@pytest.mark.long
@pytest.mark.parametrize('name', ['quantised', 'channel_lag'])
def test_what_nothing_describes_stays_unexplained(name):
    result, _ = found(name, 5, emitters=4)
    assert not {f.record.name for f in result.findings} & set(CATALOGUE)
    assert result.unexplained > 0.9
    assert result.depends_on


def test_what_drifts_is_named_with_its_size():
    """The phase of one emitter, and the strength of all."""
    size = {'coil_phase_drift': 0.003, 'common_drift': 0.01}
    for name, amount in size.items():
        effect, made = all_effects()[name], world(1, 375, 3)
        term = effect.candidates(made.problem().apparatus)[-1].with_theta([amount, np.log(5.0)])
        factor = effect.emitter_matrix(term, made.tool.time, np.ones(3))
        for one in ('tool', 'reference'):
            old = getattr(made, one)
            setattr(made, one, replace(old, flux=np.einsum('fab,fsb->fsa', factor, old.flux)))
        [record] = [f.record for f in diagnose(made.problem(), made.model).findings]
        assert (record.name, record.parameters.get('coil')) == (name, term.site.get('coil'))
        assert record.parameters[effect.size] == pytest.approx(amount, rel=0.05)


def changed(factors: np.ndarray, gaps_t: float = 0.0, **spread: float) -> dict:
    """Records of a tool whose emitters are multiplied by factors (F or 1, K), by their labels."""
    made = world(3, 375, 3)
    made.tool = replace(made.tool, flux=made.tool.flux * factors[:, None])
    problem = replace(made.problem(), references=None)
    gaps = tuple(own + gaps_t for own in problem.gaps_t)
    problem = replace(problem, spread=replace(problem.spread, **spread), gaps_t=gaps)
    found = diagnose(problem, made.model).findings
    return {f.term.label if f.term else f.record.name: f.record.parameters for f in found}


def test_phases_of_all_emitters_are_named_one_by_one():
    phases = [0.004, -0.003, 0.006]
    named = changed(np.exp(1j * np.array([phases])))
    assert set(named) == {f'coil_phase (coil {k})' for k in range(3)}
    found = [named[f'coil_phase (coil {k})']['phase_rad'] for k in range(3)]
    np.testing.assert_allclose(found, phases, atol=3e-4)


def test_a_curve_that_does_not_hold_gives_way_to_a_step():
    step = np.where(np.arange(375)[:, None] > 150, [[1.006, 1.0, 1.0]], 1.0)
    assert set(changed(step)) == {'coil_fluctuation (coil 0)'}


def test_nothing_is_named_that_the_model_may_be_wrong_by():
    gain = np.full((1, 3), 1.001)
    assert set(changed(gain)) == {'common_gain'}
    assert not changed(gain, flux_t=2e-9)
    half = changed(gain, flux_t=2.5e-10)
    assert set(half) == {'common_gain'}, 'no model is wrong by one effect alone'
    assert not changed(gain, gaps_t=2e-9)
    hit = np.where(np.arange(375)[:, None] % 40, gain, [[1.1, 0.9, 1.0]])
    assert set(changed(hit, flux_t=6e-9)) == {'outliers'}, 'which are not the model'


def test_a_drift_that_goes_on_ends_where_it_did_at_the_longest_time_constant():
    effect, duration = all_effects()['common_drift'], 600.0
    [zero] = effect.candidates(replace(world(1, 60, 2).problem().apparatus, duration=duration))
    for tau_s, kept in ((6000.0, 1500.0), (100.0, 100.0), (0.01, 0.3)):
        free = zero.with_theta(np.array([0.02, np.log(tau_s)]))
        bounded = effect.bounded(free)
        assert np.exp(bounded.theta[1]) == pytest.approx(kept)
        end = [effect.emitter_matrix(t, np.array([duration]), np.ones(1)) for t in (free, bounded)]
        np.testing.assert_allclose(*end)


def test_a_number_of_every_frame_has_the_range_of_its_constant_effect():
    """Poses of other frames are no emitter that fluctuates by more than itself."""
    made = world(1, 375, 3)
    track, late = made.tool.track, np.roll(np.arange(made.tool.track.time.size), 40)
    made.track(PoseTrack(track.time, track.position[late], track.quaternion[late]))
    found = diagnose(made.problem(), made.model)
    assert not found.findings and 'plausible range' in next(c.reason for _, c in found.refused)


def test_a_moved_emitter_is_one_fault_where_its_gradient_is_hardly_known():
    rng, made = np.random.default_rng(5), world(5, 375, 4)
    effect, base = all_effects()['coil_moved'], made.model.dipoles
    term = effect.candidates(made.problem().apparatus)[1].with_theta([-0.003, 0.0, 0.003])
    moved = effect.sources(term, base, base, None)
    wrong = 1 + 0.6 * rng.normal(size=(1, len(made.reference.sensors), 1))
    for one, factor in (('tool', 1.0), ('reference', wrong)):
        old = getattr(made, one)
        at = made.true_pose() if one == 'tool' else (old.position, old.rotation)
        places, axes = (part.reshape(-1, 3) for part in old.sensors.placed(*at))
        change = factor * moved.flux(places, axes, None).reshape(old.flux.shape)
        setattr(made, one, replace(old, flux=old.flux + change))
    [record] = [f.record for f in diagnose(made.problem(), made.model).findings]
    assert (record.name, record.parameters['coil']) == ('coil_moved', 1)
    np.testing.assert_allclose(record.parameters['shift_m'], [-0.003, 0, 0.003], atol=1e-4)


def test_a_turn_of_an_emitter_that_nobody_sees_is_no_part_of_its_sigma():
    effect = all_effects()['coil_turned']
    term = effect.candidates(world(1, 60, 2).problem().apparatus)[0]  # its moment is along z
    record = effect.record(term.with_theta([0.01, 0.0, 0.02]), np.diag([1e-6, 4e-6, 9e-4]))
    sigma = np.degrees([1e-3, 2e-3, 0.0])
    np.testing.assert_allclose(record.uncertainty['rotation_deg'], sigma, atol=1e-9)
    np.testing.assert_allclose(
        record.parameters['rotation_deg'], np.degrees([0.01, 0, 0]), atol=1e-9
    )


@pytest.mark.parametrize('quarter', [0.0, 90.0])
def test_a_body_and_a_frame_that_stand_elsewhere_are_named_as_such(quarter):
    made, turn = world(1, 375, 3), Rotation.from_rotvec([1.0, quarter, 0.5], degrees=True)
    track, moved = made.tool.track, Rotation.from_rotvec([0.03, 0.0, -0.02])
    stated = moved * Rotation.from_quat(track.quaternion) * turn.inv()
    place = moved.apply(track.position) + [0.002, 0.0, -0.003]
    made.track(PoseTrack(track.time, place, stated.as_quat()))
    records = {f.record.name: f.record for f in diagnose(made.problem(), made.model).findings}
    assert set(records) == {'body_turned', 'registration'}
    found = records['body_turned'].parameters['rotation_deg']
    np.testing.assert_allclose(found, [1.0, quarter, 0.5], atol=0.1)
    found = records['registration'].parameters
    np.testing.assert_allclose(np.radians(found['rotation_deg']), [0.03, 0, -0.02], atol=2e-3)


def test_a_wrong_pose_that_a_larger_effect_hides_is_no_jitter_of_all_poses():
    made, moved = world(1, 375, 3), Rotation.from_rotvec([0.03, 0.0, -0.02])
    track = made.tool.track
    place = moved.apply(track.position) + [0.002, 0.0, -0.003]
    place[300] += 0.003
    made.track(
        PoseTrack(track.time, place, (moved * Rotation.from_quat(track.quaternion)).as_quat())
    )
    [finding] = diagnose(made.problem(), made.model).findings
    assert finding.record.name == 'registration'


CHANNEL, HIT = 2, np.arange(20, 500, 40)


def session(rests, change):
    """A clean session with changed fluxes; where the tool rests, a place and a pose a second."""
    made = world(seed=3)
    flux = made.tool.flux.copy()
    change(flux)
    made.flux(flux)
    if rests:
        tool, reference = made.tool, made.reference
        time = 25.0 * tool.time
        track = PoseTrack(time, tool.position, Rotation.from_matrix(tool.rotation).as_quat())
        made.tool = replace(tool, time=time, track=track)
        made.reference = replace(reference, time=time)
    return made.problem()


def missed(flux):
    """What a model of the field misses at some places: four times the noise in one sensor."""
    sign = np.random.default_rng(1).choice([-1.0, 1.0], size=(HIT.size, flux.shape[2]))
    flux[HIT, CHANNEL] += 4.0 * NOISE_T * sign * (1.0 + 1.0j)


def failing(flux):
    """A contact that fails."""
    flux[HIT, CHANNEL] = 0.0


@pytest.mark.parametrize('rests', [False, True])
def test_a_contact_that_fails_is_seen_whether_the_tool_moves_or_rests(rests):
    problem = session(rests, failing)
    cleaned = without_outliers(problem)
    assert not cleaned.good[0][HIT, CHANNEL].any()
    assert outlying_share(problem, cleaned)[0] == pytest.approx(HIT.size / 500, abs=0.003)


def test_what_a_model_misses_at_a_place_is_no_contact_that_fails():
    moving, resting = session(False, missed), session(True, missed)
    assert outlying_share(moving, without_outliers(moving))[0] > 0.9 * HIT.size / 500
    assert outlying_share(resting, without_outliers(resting)) == (0.0, [])


def noisy(flux):
    """A channel with twenty times the noise, and what a model misses slowly everywhere."""
    rng, slow = np.random.default_rng(4), np.sin(0.1 * np.arange(len(flux)))[:, None, None]
    flux += NOISE_T * slow
    flux[:, 1] += (
        20.0
        * NOISE_T
        * (rng.normal(size=flux[:, 1].shape) + 1j * rng.normal(size=flux[:, 1].shape))
    )


def test_noise_of_a_channel_is_named_beside_what_the_model_may_be_wrong_by():
    problem = replace(session(True, noisy), references=None)
    problem = replace(problem, spread=replace(problem.spread, flux_t=2.0 * NOISE_T))
    [record] = [f.record for f in diagnose(problem, world(3).model).findings]
    assert (record.name, record.channels) == ('excess_noise', [1])
