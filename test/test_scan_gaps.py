"""What a scan leaves open of the field: said by the model, and allowed for by a diagnosis."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from calibration_world import NOISE_T, scene

from anser_ros.calibration.calibrate import Options, _better, correct_scan, fit_scan
from anser_ros.calibration.held_out import factor_of
from anser_ros.calibration.layouts import Layout
from anser_ros.diagnosis.problem import Spread, build_problem, evaluate, expected_rms, rms
from anser_ros.errors import ModelFileError
from anser_ros.field.model import from_document, parse_gaps, to_document

LAYER = Layout('layer', 10, 1.5, 0.0)


@pytest.fixture(scope='module')
def scanned():
    """A scan that left out one side of its volume, and the model of it."""
    world = scene(np.random.default_rng(7), side=17)
    side = world.measurements.position[:, 0] > 0.04
    part = world.measurements.frames(np.flatnonzero(~side))
    options = Options(layout=LAYER)
    tones = (1000.0, 1100.0, 1200.0)
    generator = replace(world.generator, emitters=('a', 'b', 'c'), frequencies_hz=tones)
    found = fit_scan(correct_scan([part], generator, options), ['scan'], generator, options)
    return world, side, found.model


def test_a_model_says_where_its_scan_has_a_gap(scanned):
    world, side, model = scanned
    table = world.measurements.sensors
    points, axes = table.placed(world.position, world.rotation)
    true = world.flux(points.reshape(-1, 3), axes.reshape(-1, 3)).reshape(*points.shape[:2], -1)
    error = np.abs(model.flux(points, axes) - true) / np.sqrt(2.0)
    told = model.gaps.sigma_t(points, axes, table.length)
    far = world.position[:, 0] > 0.07
    assert told[far].mean() > 5.0 * told[~side].mean()
    ratio = np.sqrt(np.mean(error[far] ** 2) / np.mean(told[far] ** 2))
    assert 0.3 < ratio < 3.0


def test_a_reading_in_a_gap_counts_for_less(scanned):
    world, side, model = scanned
    spread = Spread(NOISE_T)
    sure, unsure = (
        evaluate(build_problem([world.measurements], None, None, one, None, spread), ())
        for one in (replace(model, gaps=None), model)
    )
    before, after = sure.parts[0].whitener.weight, unsure.parts[0].whitener.weight
    inner = np.abs(world.position - [-0.03, 0.0, 0.14]).max(axis=1) < 0.05
    assert after[inner].mean() > 0.9 * before[inner].mean()
    assert after[side].mean() < 0.7 * before[side].mean()
    assert expected_rms(sure) == pytest.approx(NOISE_T)
    assert expected_rms(unsure) > 1.2 * NOISE_T
    assert rms(unsure) == pytest.approx(rms(sure)), 'told in T, whatever the weights are'
    assert np.mean(unsure.parts[0].white ** 2) < 0.6 * np.mean(sure.parts[0].white ** 2)


def test_gaps_survive_the_models_file_and_broken_ones_are_refused(scanned):
    _, _, model = scanned
    again = from_document(to_document(model)).gaps
    assert np.array_equal(again.moments, model.gaps.moments)
    assert np.array_equal(again.positions, model.gaps.positions)
    with pytest.raises(ModelFileError, match='rows of at least 7 finite numbers'):
        parse_gaps([[0.0] * 6])
    with pytest.raises(ModelFileError, match='no table'):
        parse_gaps([[0.0] * 7, ['x']])


def test_blocks_that_were_held_out_say_how_much_too_small_a_covariance_is():
    expected = np.geomspace(1e-24, 1e-20, 40)
    assert factor_of(expected, 9.0 * expected) == pytest.approx(3.0)
    assert factor_of(expected, 0.1 * expected) == 1.0
    assert factor_of(expected[:5], 9.0 * expected[:5]) == 1.0


def test_a_third_of_the_dipoles_may_leave_a_seventh_more():
    def pair(score, dipoles):
        return None, SimpleNamespace(score_t=score, n_dipoles=dipoles)

    few, many = pair(1.1, 50), pair(1.0, 150)
    assert _better([few, many]) is few
    nearly_as_many = pair(1.1, 140)
    assert _better([nearly_as_many, many]) is many
