"""`anser diagnose` on simulated bags: a clean one passes, a wrong gain is named and mended."""

import itertools
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import REPO

from anser_ros.cli.diagnosis_words import MOST_CHARACTERS, short_ones, value_text, verdict
from anser_ros.cli.main import main
from anser_ros.effects.effect import all_effects
from anser_ros.effects.moving_metal import StraightPath
from anser_ros.errors import PlausibilityError
from anser_ros.field.model import plain
from anser_ros.sessions import diagnosis as sessions_diagnosis
from anser_ros.sessions.diagnosis import DEPENDENCIES, MODEL_FILE_ONLY
from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import load_model
from anser_ros.wire.bag import read_bag
from anser_ros.wire.bag_writer import SessionWriter

BAGS, MODEL = REPO / 'bags', REPO / 'config' / 'demo_model.yaml'
CHANNEL, GAIN = 4, 0.97
HELD_OUT = {
    'flux_rms_before_t', 'flux_rms_after_t', 'flux_rms_floor_t', 'position_rmse_before_m',
    'position_rmse_after_m', 'orientation_rmse_before_rad', 'orientation_rmse_after_rad',
}  # fmt: skip


def rewritten(name: str, path: Path, gain: float = 1.0, step: int = 1) -> Path:
    """A shipped session: every so many frames, and one channel's readings too small."""
    bag = read_bag(BAGS / f'{name}.mcap')
    with SessionWriter(path) as writer:
        writer.write_setup(bag.setup_text, int(bag.tool.stamp_ns[0]))
        gains = np.where(bag.tool.channel == CHANNEL, gain, 1.0)[:, None]
        frames = zip(bag.tool.stamp_ns.tolist(), bag.tool.flux, strict=True)
        for stamp, flux in itertools.islice(frames, 0, None, step):
            writer.write_readings(bag.setup.tool_sensors, stamp, flux * gains)
        for body, track in bag.optical.items():
            for stamp, position, quaternion in zip(
                track.stamp_ns.tolist(), track.position, track.quaternion, strict=True
            ):
                writer.write_pose(f'/optical/{body}/pose', stamp, position, quaternion)
    return path


def run(bag: Path, out: Path, model: Path = MODEL, *more: str) -> dict:
    assert main(['diagnose', str(bag), '--model', str(model), '--out', str(out), *more]) == 0
    document = json.loads((out / 'diagnosis.json').read_text())
    assert len(verdict(document)) < MOST_CHARACTERS
    return document


@pytest.mark.long
def test_a_clean_session_has_no_effect(tmp_path):
    document = run(BAGS / 'moving.mcap', tmp_path, MODEL, '--baseline', str(BAGS / 'factory.mcap'))
    assert document['schema'] == 'anser_diagnosis/1'
    assert set(document['held_out']) == HELD_OUT
    assert document['effects'] == []
    assert document['unexplained']['fraction'] == 0.0


@pytest.mark.long
def test_a_wrong_gain_is_named_and_the_model_corrects_it(tmp_path):
    bag = rewritten('moving', tmp_path / 'gain.mcap', GAIN)
    document = run(bag, tmp_path / 'out')
    (effect,) = document['effects']
    assert effect['name'] == 'sensor_gain'
    assert effect['parameters']['channel'] == CHANNEL
    found, sigma = effect['parameters']['gain'], effect['uncertainty']['gain']
    assert abs(found - GAIN) < max(1e-3, 4 * sigma)
    held = document['held_out']
    assert held['flux_rms_after_t'] < 0.1 * held['flux_rms_before_t']
    assert held['flux_rms_after_t'] < effect['flux_rms_without_t']
    assert held['position_rmse_after_m'] < 0.16e-3
    page = (tmp_path / 'out' / 'report.html').read_text()
    assert 'sensor_gain' in page
    assert 'http' not in page.replace('http-equiv', '')
    again = run(bag, tmp_path / 'again', tmp_path / 'out' / 'model.yaml')
    assert again['effects'] == [], 'the corrected model leaves nothing to find'


@pytest.mark.long
def test_metal_that_moves_is_found_and_its_verdict_is_short(tmp_path, capsys):
    document = run(rewritten('metal', tmp_path / 'thinned.mcap', step=5), tmp_path / 'out')
    names = [effect['name'] for effect in document['effects']]
    assert 'moving_metal' in names
    said = [line for line in capsys.readouterr().out.split('\n') if 'residual on' in line]
    assert len(said) == 1 and 100 < len(said[0]) < MOST_CHARACTERS


@pytest.mark.parametrize('reverses', [True, False])
def test_reversed_phases_are_told_before_any_effect(reverses, monkeypatch):
    class Searches(Exception):
        """What comes after the check."""

    def search(problem, model, progress):
        raise Searches

    monkeypatch.setattr(sessions_diagnosis, 'diagnose', search)
    session, model = load_session(BAGS / 'moving.mcap'), load_model(MODEL)
    phases = np.exp(0.01j * np.arange(len(model.emitters)))
    [tool] = session.tools
    flux = tool.flux * phases
    tool = replace(tool, flux=flux.conj() if reverses else flux)
    session, model = (
        replace(session, tools=(tool,)),
        replace(model, moments=model.moments * phases),
    )
    with pytest.raises(PlausibilityError if reverses else Searches):
        sessions_diagnosis.diagnose_session(session, model)


def test_the_session_needs_poses(tmp_path, capsys):
    bag = read_bag(BAGS / 'moving.mcap')
    path = tmp_path / 'blind.mcap'
    with SessionWriter(path) as writer:
        writer.write_setup(bag.setup_text, int(bag.tool.stamp_ns[0]))
        stamp = int(bag.tool.stamp_ns[0])
        writer.write_readings(bag.setup.tool_sensors, stamp, bag.tool.flux[0])
    assert load_session(path).tools[0].track is None
    assert main(['diagnose', str(path), '--model', str(MODEL), '--out', str(tmp_path)]) == 2
    assert 'at least 30 frames with an optical pose, got 0' in capsys.readouterr().err


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
