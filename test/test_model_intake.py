"""Models and their uncertainty, whatever came first and however many wait."""

import numpy as np
import pytest

pytest.importorskip('sensor_msgs')

from dataclasses import replace

from tracking_world import certain_model

from anser_ros.nodes.model_clouds import ModelWriter
from anser_ros.nodes.model_intake import ModelIntake

MODEL = certain_model()
FIRST_NS = 1_750_000_000_000_000_000


def uncertain(n):
    modes = np.full((1, *MODEL.moments.shape), 1e-6 * (1 + n), dtype=complex)
    return replace(MODEL, moments=(1.0 + 1e-3 * n) * MODEL.moments, modes=modes)


def messages(numbers):
    """Uncertainty and dipoles of some models, with the stamps of their numbers."""
    writer = ModelWriter()
    errors = {n: writer.error(uncertain(n), 'fg', FIRST_NS + n, True) for n in numbers}
    return errors, {n: writer.dipoles(uncertain(n), 'fg', FIRST_NS + n) for n in numbers}


def size_of(given):
    return None if given.error is None else round(float(given.error.modes[0, 0, 0].real) / 1e-6)


def test_a_busy_tracker_that_reads_many_uncertainties_first_mixes_none_up():
    intake = ModelIntake()
    errors, models = messages(range(8))
    for n in (0, 2, 5, 7):  # the others change nothing about the uncertainty
        assert intake.take_error(errors[n]) is None
    assert [size_of(intake.take(models[n])) for n in range(8)] == [1, 1, 3, 3, 3, 6, 6, 8]


def test_an_uncertainty_that_comes_after_its_model_is_put_right():
    intake = ModelIntake()
    errors, models = messages(range(2))
    intake.take_error(errors[0])
    assert size_of(intake.take(models[0])) == 1
    assert size_of(intake.take(models[1])) == 1
    assert size_of(intake.take_error(errors[1])) == 2


def test_one_whose_model_was_lost_is_passed_over():
    intake = ModelIntake()
    errors, models = messages(range(4))
    for n in (0, 1, 3):
        intake.take_error(errors[n])
    assert [size_of(intake.take(models[n])) for n in (0, 3)] == [1, 4]
    assert intake.has_error


def test_what_is_not_said_yet_is_unknown():
    intake = ModelIntake()
    assert intake.take(messages([0])[1][0]).error is None
    assert not intake.has_error
