"""What a diagnosis says stays short, however much the records of its effects hold."""

import re

import matplotlib.pyplot as plt
import numpy as np
import pytest
from diagnosis_world import world

from anser_ros.cli.diagnose import course
from anser_ros.cli.diagnosis_words import MOST_CHARACTERS, paths, short_ones, value_text, verdict
from anser_ros.diagnosis.problem import evaluate
from anser_ros.effects.metal_path import StraightPath
from anser_ros.effects.registry import all_effects
from anser_ros.field.model import plain
from anser_ros.sessions.diagnosis import DEPENDENCIES, MODEL_FILE_ONLY


@pytest.fixture(scope='module')
def moving():
    """The record of metal that moves, as it stands in diagnosis.json."""
    effect = all_effects()['moving_metal']
    way = np.array([0.02, 0.0, -0.12, 0.07, 0.02, -0.09, 0.5, 1.9, 0.5])
    term = effect.starting(StraightPath(), way, 2.4, np.array([-2.0, -0.3]))
    record = effect.record(term, 1e-6 * np.eye(term.theta.size))
    short = {key: value for key, value in record.parameters.items() if key not in MODEL_FILE_ONLY}
    return {
        'name': record.name,
        'parameters': plain(short),
        'uncertainty': plain(dict(record.uncertainty)),
    }


def document(effects, fraction=0.23):
    return {
        'held_out': {
            'flux_rms_before_t': 1166e-12, 'flux_rms_after_t': 60e-12, 'flux_rms_floor_t': 60e-12,
            'position_rmse_before_m': 1.07e-3, 'position_rmse_after_m': 0.12e-3,
        },
        'effects': effects,
        'unexplained': {'fraction': fraction, 'depends_on': list(DEPENDENCIES)},
    }  # fmt: skip


def test_a_path_is_no_part_of_the_verdict(moving):
    assert 'path' in moving['parameters']
    text = verdict(document([moving], 0.0))
    assert len(text) < MOST_CHARACTERS
    assert 'moving_metal (start_m [0.02, 0, -0.12]' in text and 'time_s' not in text
    assert 'path' not in dict(short_ones(moving['parameters']))


def test_a_verdict_has_a_length(moving):
    """Effects of one kind are counted; where their names have no room, the table has them."""
    kinds = list(all_effects())
    for count in (0, 1, 2, 7, 60, 400):
        different = [{**moving, 'name': kinds[n % len(kinds)]} for n in range(count)]
        for effects in ([moving] * count, different):
            text = verdict(document(effects))
            assert len(text) < MOST_CHARACTERS
            assert not count or re.search(rf'lacks {count} effects?: ', text)
    assert 'moving_metal (7 times)' in verdict(document([moving] * 7))


def test_what_stays_unexplained_has_its_size():
    assert value_text([1.23456, [2, 'x']]) == '[1.235, [2, x]]', 'numbers have four digits'
    # All of very little is little: 61 pT over a noise of 60.
    given = document([])
    given['held_out']['flux_rms_after_t'] = 61e-12
    assert 'above the noise stays unexplained, 11 pT rms; it depends on' in verdict(given)


def test_a_path_is_drawn_with_its_uncertainty(moving):
    ((key, path),) = paths(moving['parameters'])
    assert key == 'path' and len(path['time_s']) == len(path['position_m'])
    problem = world(frames=40).problem()
    figure = course(path, moving['uncertainty'][key], evaluate(problem, ()))
    above, over = figure.axes
    drawn = {line.get_label(): line for line in above.lines}
    place = 1e3 * np.array(path['position_m'])
    np.testing.assert_allclose(drawn['path'].get_xydata(), place[:, :2])
    heights = {line.get_label(): line for line in over.lines}['z']
    np.testing.assert_allclose(heights.get_xydata(), np.c_[path['time_s'], place[:, 2]])
    assert len(over.collections) == 3, 'a band for each coordinate'
    plt.close(figure)
