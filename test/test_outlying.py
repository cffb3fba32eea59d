"""Readings that stand out from their neighbours in time, of bodies that move and that rest."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis_world import world
from injection_subject import NOISE_T
from scipy.spatial.transform import Rotation

from anser_ros.diagnosis.screening import clean_start, outlying_share
from anser_ros.physics.pose_track import PoseTrack

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
    cleaned = clean_start(problem)
    assert not cleaned.good[0][HIT, CHANNEL].any()
    assert outlying_share(problem, cleaned)[0] == pytest.approx(HIT.size / 500, abs=0.003)


def test_what_a_model_misses_at_a_place_is_no_contact_that_fails():
    moving, resting = session(False, missed), session(True, missed)
    assert outlying_share(moving, clean_start(moving))[0] > 0.9 * HIT.size / 500
    assert outlying_share(resting, clean_start(resting)) == (0.0, [])
