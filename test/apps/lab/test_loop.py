"""The whole loop: an effect in raw samples, found blind, corrected live; and what it says."""

import io
import itertools
import json

import numpy as np
import pytest
from rich.console import Console

from anser_ros.apps.lab.cli import loop
from anser_ros.apps.lab.cli.loop import (
    MISSED,
    NAMED,
    PARTLY,
    TONES_HZ,
    UNEXPLAINED,
    WRONG,
    ok_share,
    parameter_errors,
    table,
    verdict,
)
from anser_ros.cli.main import main
from anser_ros.cli.processes import SAMPLE_RATE_HZ
from anser_ros.effects.channels import FLUX, VOLTAGE
from anser_ros.effects.effect import all_effects, effect_named
from anser_ros.field.model import EffectRecord
from anser_ros.simulation.effects import CATALOGUE, compressing, draw
from anser_ros.wire.channel_calibration import parse_channels
from anser_ros.wire.setup import parse_setup
from anser_ros.wire.text_files import read_config

GAIN_SEED = 3


def test_an_effect_is_found_and_the_next_run_is_better(domain, tmp_path, capsys, monkeypatch):
    """Over a pseudo-terminal, DDS, bags and model files, each node in its own process."""
    arguments = ['--effect', 'sensor_gain', '--seed', str(GAIN_SEED), '--duration', '10']
    monkeypatch.setattr(loop, 'CLEAN_S', 2.0)
    assert main(['loop', *arguments, '--out', str(tmp_path), '--json']) == 0
    (found,) = json.loads(capsys.readouterr().out)['rounds']
    assert [effect['name'] for effect in found['found']] == [found['truth']['name']]
    assert found['verdict'] == NAMED
    gain = found['parameters']['gain']
    assert gain['error'] < 1e-3 < 0.1 * abs(gain['put_in'] - 1.0) + 1e-3
    held = found['first_run_held_out']
    assert held['flux_rms_after_t'] < 0.2 * held['flux_rms_before_t']
    if found['too_busy']:  # the loop says that its live figures are none
        return
    live = found['second_run_live']
    assert live['after']['position_rmse_m'] < 0.5 * live['ungated']['position_rmse_m']
    assert live['after']['orientation_rmse_rad'] < live['ungated']['orientation_rmse_rad']


def test_frames_that_a_tracker_never_saw_do_not_count_as_withheld():
    words = {
        'anser/tracker': {'frames': '10', 'frames_skipped': '7'},
        'anser/tracker: a': {'state': 'ok', 'frames_ok': '9', 'frames_residual': '1'},
        'anser/tracker: b': {'frames_ok': '10'},
        'anser/before/tracker: a': {'frames_ok': '1'},
    }
    assert ok_share(words, 'anser/tracker') == 19 / 20
    assert ok_share(words, 'anser/other') == 0.0


def diagnosis(*effects, unexplained=0.0):
    found = [
        {'name': name, 'parameters': parameters, 'uncertainty': {}} for name, parameters in effects
    ]
    return {'effects': found, 'unexplained': {'fraction': unexplained, 'depends_on': []}}


GAIN = {'name': 'sensor_gain', 'answers': ['sensor_gain'], 'parameters': {'channel': 3}}
STRANGE = {'name': 'crossover', 'answers': [], 'parameters': {'channel': 3}}
NOTHING = {'name': 'none', 'answers': [], 'parameters': {}}


@pytest.mark.parametrize(
    ('truth', 'found', 'said'),
    [
        (GAIN, diagnosis(('sensor_gain', {'channel': 3})), NAMED),
        (GAIN, diagnosis(('sensor_gain', {'channel': 4})), WRONG),
        (GAIN, diagnosis(('sensor_gain', {'channel': 3}), ('pickup', {})), WRONG),
        (GAIN, diagnosis(('sensor_gain', {'channel': 4}), unexplained=0.5), WRONG),
        (GAIN, diagnosis(unexplained=1.0), UNEXPLAINED),
        (GAIN, diagnosis(), MISSED),
        (STRANGE, diagnosis(unexplained=1.0), UNEXPLAINED),
        (STRANGE, diagnosis(('sensor_gain', {'channel': 3}), unexplained=0.2), PARTLY),
        (STRANGE, diagnosis(('sensor_gain', {'channel': 3})), WRONG),
        (NOTHING, diagnosis(), ''),
        (NOTHING, diagnosis(('sensor_gain', {'channel': 3})), WRONG),
    ],
)
def test_a_diagnosis_is_judged_by_name_and_place(truth, found, said):
    assert verdict(truth, found) == said


def test_parameters_are_compared_where_both_have_them():
    truth = {
        'answers': ['static_metal'],
        'parameters': {'position_m': [0.0, 0.1, -0.1], 'radius_m': 0.03, 'channel': 1},
    }
    effect = {
        'name': 'static_metal',
        'parameters': {'position_m': [0.003, 0.1, -0.104], 'channel': 1},
        'uncertainty': {'position_m': [1e-3] * 3},
    }
    compared = parameter_errors(truth, {'effects': [effect, {**effect, 'name': 'pickup'}]})
    assert set(compared) == {'position_m'}
    assert compared['position_m']['error'] == pytest.approx(0.005)


def test_every_answer_is_an_effect_that_can_be_found():
    setup = parse_setup(read_config('demo_setup.yaml'))
    channels = parse_channels(read_config('demo_channels.yaml'))
    answers = {}
    for name in CATALOGUE:
        answers[name] = draw(name, setup, channels, np.random.default_rng(1)).answers
        assert set(answers[name]) <= set(all_effects()), name
    assert [name for name, known in answers.items() if not known] != [], 'none is a surprise'


def test_no_product_of_third_order_falls_onto_a_tone():
    for a, b, c in itertools.product(TONES_HZ, repeat=3):
        if c in (a, b):
            continue  # gives the other tone of the pair back: that is the compression itself
        product = a + b - c
        assert min(abs(product - tone) for tone in TONES_HZ) >= 100.0
    for triple in itertools.combinations_with_replacement(TONES_HZ, 3):
        folded = abs(sum(triple) - SAMPLE_RATE_HZ)
        assert min(abs(folded - tone) for tone in TONES_HZ) >= 50.0


def test_a_compressing_amplifier_is_what_the_catalogue_calls_saturation():
    """Samples of tanh, as the simulated unit makes them, against the effect that sees voltages."""
    omega = 2 * np.pi * np.array(TONES_HZ)
    weights = omega / omega.mean()
    rng = np.random.default_rng(4)
    amplitude = 1e-6 * rng.uniform(0.1, 0.4, omega.size)
    limit = 4e-6
    time_s = np.arange(4000) / SAMPLE_RATE_HZ
    waves = np.exp(1j * (time_s[:, None] * omega + rng.uniform(0, 2 * np.pi, omega.size)))
    volts = (waves @ (amplitude * weights)).real[:, None]
    bent = compressing(0, limit).volts(time_s, volts)[:, 0]
    seen = 2 * np.abs(waves.conj().T @ bent) / time_s.size / weights
    effect = effect_named('saturation')
    for sees, tolerance in ((VOLTAGE, 0.05), (FLUX, None)):
        parameters = {'channel': 0, 'full_scale_t': limit, 'shape': 'tanh', 'sees': sees}
        if sees == VOLTAGE:
            parameters['tone_weights'] = weights.tolist()
        term = effect.term(EffectRecord('saturation', parameters))
        flux = effect.compress(term, np.array([0]), amplitude[None, None].astype(complex))
        loss, wanted = amplitude - flux[0, 0].real, amplitude - seen
        error = np.abs(loss - wanted).max() / wanted.max()
        assert error < tolerance if tolerance else error > 0.1


def test_a_busy_machine_is_told_and_no_figure_shown():
    figures = {'position_rmse_m': 0.001234, 'orientation_rmse_rad': 0.01, 'published_share': 1.0}
    one = {
        'truth': GAIN, 'found': [], 'verdict': NAMED, 'too_busy': True,
        'parameters': {'gain': {'put_in': 1.02, 'found': 1.019, 'error': 1e-3, 'sigma': 1e-4}},
        'unexplained': {'fraction': 0.0},
        'second_run_live': dict.fromkeys(('ungated', 'before', 'after'), figures),
    }  # fmt: skip
    for busy in (True, False):
        console = Console(record=True, width=200, file=io.StringIO())
        table([{**one, 'too_busy': busy}], console)
        text = console.export_text()
        assert ('1.234' in text) is not busy
        assert ('machine too busy' in text) is busy
        assert 'gain: 1.02 put in, 1.019 found' in text


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['--effect', 'gremlin'], "invalid choice: 'gremlin'"),
        (['--duration', '3'], 'must be 10 to 600 s'),
        (['--seed', '0'], 'at least 1'),
    ],
)
def test_wrong_arguments_are_refused_in_a_line(tmp_path, capsys, arguments, message):
    assert main(['loop', *arguments, '--out', str(tmp_path)]) == 2
    text = capsys.readouterr().err
    assert message in text and text.count('\n') == 1
    assert not any(tmp_path.iterdir())
