"""Sessions of poses with nothing wrong, and what looks like an effect in them: none is named."""

import pytest
from clean_poses import MOTIONS, STREAMS, clean_world
from pose_world import World

from anser_ros.apps.poses.diagnosis import diagnose_poses, unconfirmed
from anser_ros.apps.poses.effects.field_distortion import FieldDistortion
from anser_ros.apps.poses.fit import fit_poses
from anser_ros.apps.poses.search import with_noise
from anser_ros.apps.poses.start import coarse_offset, first_fit, pose_problem

pytestmark = pytest.mark.long


def names(found):
    return [record.name for record in found.records if record.name != 'hand_eye']


@pytest.mark.parametrize('motion', ['in circles', 'far and near', 'about a tip', 'carried'])
def test_nothing_is_named_on_a_clean_session(motion):
    stream = STREAMS[list(MOTIONS).index(motion) % len(STREAMS)]
    assert names(diagnose_poses(clean_world(11, motion, stream).session())) == []


def test_a_filter_that_takes_off_the_noise_of_the_reference_and_some_by_chance_is_none():
    # What it takes off is 0.201 mm, and the reference's noise 0.175 mm.
    world = clean_world(13842, 'with stops', 'irregular')
    assert names(diagnose_poses(world.session())) == []


@pytest.mark.parametrize('size', [0.0, 2.0])
def test_a_map_has_to_take_its_size_off_the_errors_of_positions(size):
    world = World(5, duration=20.0, sensors=1)
    world.bend = lambda sensor, place: (
        place + 1e-3 * size * ((place - place.mean(axis=0)) / 0.06) ** 2
    )
    problem = pose_problem(world.session())
    rest = with_noise(first_fit(problem, coarse_offset(problem), False))
    term = FieldDistortion().at(problem.setting, 2, None)
    bent = fit_poses(rest.state.problem, [*rest.terms, term])
    why = unconfirmed(rest, bent, bent.terms[-1], bent.state.problem)
    assert why == ('' if size else 'takes less than 0.5 mm off the errors of positions')
