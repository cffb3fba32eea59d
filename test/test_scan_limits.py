"""What a scan cannot tell: it is said, a model is made all the same, and poses own up to it."""

import numpy as np
import pytest
from calibration_world import Errors, moved_scan, scene, tool_of

from anser_ros.calibration.population import Likelihood, Population
from anser_ros.calibration.result import undetermined_words
from anser_ros.calibration.sensor_fit import SensorFitter
from anser_ros.calibration.sensor_parameters import KINDS, SURVEYED_M
from anser_ros.settings import Accuracy

pytestmark = pytest.mark.long


def surveyed(seed, coils, seconds, turn_rad, errors, flat=False):
    """A joint fit of a scan by a hand, and what is true of it."""
    rng = np.random.default_rng(seed)
    world, table = scene(rng, side=4), tool_of(coils)
    told, truth = moved_scan(world, table, rng, seconds, errors, turn_rad, flat)
    return SensorFitter([told], KINDS, world.generator, Accuracy()).fit(), truth


def test_a_camera_that_jitters_shifts_neither_field_nor_tool_and_its_limits_are_known():
    found, truth = surveyed(307, 3, 20.0, 0.6, Errors(jitter=4.3))
    assert np.abs(found.errors_of('tool').lever_arm - truth.lever).max() < 1e-4
    assert 5e-6 < found.shift_sigma_m < 5e-5
    sigma = np.sqrt(np.diag(found.posterior.covariance))
    lever, offset = (sigma[found.parameters.rows(kind)] for kind in ('lever_arm', 'time_offset'))
    # 500 poses of 0.25 mm and 1.4 mrad by a hand at 0.11 m/s and 0.64 rad/s.
    assert 6e-5 < offset[0] < 1e-4
    assert lever.min() > 2.4e-5
    assert lever.max() < 4e-5
    assert (np.abs(found.errors_of('tool').lever_arm - truth.lever) < 3.0 * lever).all()


def test_a_scan_without_turns_tells_no_lever_arm_and_poses_know_it():
    found, _ = surveyed(22, 3, 6.0, 0.01, Errors())
    assert 'lever_arm' in found.undetermined
    line = 'lever_arm: the scan determines it only to 5 mm; the value of the setup is kept'
    assert line in undetermined_words(found)
    assert 0.2e-3 < found.shift_sigma_m <= 1.01 * SURVEYED_M
    population = Population(found.parameters)
    size = len(found.parameters)
    nothing, much = (Likelihood(told * np.eye(size), np.zeros(size)) for told in (0.0, 1e14))
    assert population.shift_sigma_m(nothing, population.fit(nothing)) == SURVEYED_M
    assert population.shift_sigma_m(much, population.fit(much)) < 1e-5, 'its setup knew the coils'


def test_a_scan_of_seconds_tells_nothing_of_the_sensors_and_takes_the_setup():
    found, _ = surveyed(23, 9, 2.0, 0.6, Errors())
    assert set(found.undetermined) == set(KINDS) and not found.evidence
    assert len(undetermined_words(found)) == len(KINDS)
    own = found.errors_of('tool')
    assert (own.gain == 1.0).all() and not own.place.any() and not own.lever_arm.any()
    assert found.kept[0].sum() >= 45


def test_of_one_coil_in_seconds_what_is_not_told_stays_at_the_setups():
    found, _ = surveyed(31, 1, 8.0, 0.6, Errors())
    assert {'axes', 'lever_arm'} <= set(found.undetermined)
    assert not set(found.undetermined) & set(found.evidence)
    assert np.abs(found.errors_of('tool').lever_arm).max() < 1e-9


def test_a_flat_scan_says_what_it_cannot_give():
    found, _ = surveyed(24, 3, 6.0, 0.6, Errors(), flat=True)
    assert 'lever_arm' in found.undetermined and 'lever_arm' not in found.evidence
    assert 0.2e-3 < found.shift_sigma_m <= 1.01 * SURVEYED_M
