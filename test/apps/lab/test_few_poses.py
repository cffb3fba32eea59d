"""Diagnosis of few poses of many sensors: simulated plates and helmets, through the commands."""

import json

import numpy as np
import pytest
from test_one_place import NAMES, TONES, resting
from test_still import CENTRES, recorded

from anser_ros.api.model import Model
from anser_ros.apps.lab import few_poses
from anser_ros.apps.lab.measured.recipe import write_frames
from anser_ros.cli.main import main
from anser_ros.sessions.session import load_session
from anser_ros.wire.setup import Coil, Emitter, SensorSpec, Setup

pytestmark = [pytest.mark.long, pytest.mark.timeout(1800)]  # a minute of a quiet machine
AT_REST = {'flux_noise_t': 1e-14, 'optical_position_m': 1e-6, 'optical_rotation_rad': 1e-6}
VOLUME = ((-0.3, -0.3, 0.05), (0.3, 0.3, 0.5))


def written(path, measured, names, tones, places, stated):
    """A session of these frames, of emitters without a drawing."""
    sensors = measured.sensors
    specs = tuple(
        SensorSpec(int(c), f'{measured.body}/{c}', measured.body, tuple(p), tuple(a), 0.0, w)
        for c, p, a, w in zip(
            sensors.channel,
            sensors.position.tolist(),
            sensors.axis.tolist(),
            windings_of(sensors),
            strict=True,
        )
    )
    coils = tuple(
        Coil(name, tuple(map(float, place)), 0.0, tone)
        for name, place, tone in zip(names, places, tones, strict=True)
    )
    setup = Setup('fg', 1.0, Emitter('unknown', {}, coils), specs, VOLUME, stated)
    quaternion = np.tile([0.0, 0.0, 0.0, 1.0], (len(measured.time), 1))
    write_frames(path, setup, measured.flux, {measured.body: (measured.position, quaternion)})
    return path


def windings_of(sensors):
    """Each sensor's points with their weights, as a setup states them; () for a single coil."""
    if sensors.windings is None:
        return [()] * len(sensors)
    rows = np.concatenate([sensors.windings.offset, sensors.windings.weight[:, :, None]], axis=2)
    return [tuple(tuple(point) for point in row if point[3]) for row in rows.tolist()]


def diagnosed(bag, folder):
    """What `anser diagnose` says with a model whose sensors are as stated."""
    model = folder / 'model.yaml'
    assert main(['calibrate', str(bag), '--estimate', 'none', '--out', str(model), '--force']) == 0
    assert main(['diagnose', str(bag), '--model', str(model), '--out', str(folder / 'out')]) == 0
    page = (folder / 'out' / 'report.html').read_text()
    return json.loads((folder / 'out' / 'diagnosis.json').read_text()), page


def test_a_plate_at_four_heights_has_its_errors_named(tmp_path):
    # Every other height is 2.5 mm too high and turned, the others are the other way round.
    off = np.outer([1.0, -1.0, 1.0, -1.0], [0.0, 0.0, 2.5e-3, 5e-3, 0.0, 0.0])
    measured, gains, _ = recorded(7, iron=False, per_side=4, off=off)
    stated = {'flux_noise_t': 1e-5, 'optical_position_m': 2e-3, 'optical_rotation_rad': 5e-3}
    bag = written(tmp_path / 'plate.mcap', measured, 'ab', (1.0, 2.0), CENTRES[:2], stated)
    document, page = diagnosed(bag, tmp_path)
    found = {effect['name']: effect for effect in document['effects']}
    spreads = ['sensor_gain_spread', 'sensor_axis_spread']
    assert list(found) == [*spreads, 'body_bend', 'body_placement']
    assert abs(found['sensor_gain_spread']['parameters']['spread'] / np.std(gains) - 1.0) < 0.3
    held = document['held_out']
    assert held['flux_rms_after_t'] < 0.7 * held['flux_rms_before_t']
    assert all(e['flux_rms_without_t'] > held['flux_rms_after_t'] for e in found.values())
    assert 'raises the log probability of all' in page and 'before, uT rms' in page
    assert 'stood further by x, mm' in page
    kept = Model.load(tmp_path / 'out' / 'model.yaml').field.effects
    assert [effect.name for effect in kept] == spreads


def test_a_helmet_at_rest_has_its_inverted_channels_named(tmp_path):
    turned, noisy = [3, 17, 40], [25]
    measured = resting(np.random.default_rng(5), inverted=turned, noisy=noisy)
    places = np.tile([0.0, 0.0, 0.14], (len(NAMES), 1))
    bag = written(tmp_path / 'helmet.mcap', measured, NAMES, TONES, places, AT_REST)
    assert few_poses.accepts(load_session(bag))
    document, _ = diagnosed(bag, tmp_path)
    found = {effect['name']: effect['parameters'] for effect in document['effects']}
    assert found['sensor_polarity']['channels'] == turned
    assert found['excess_noise']['channels'] == noisy
    assert (
        document['held_out']['flux_rms_after_t'] < 0.5 * document['held_out']['flux_rms_before_t']
    )


def test_calibrate_writes_places_and_what_is_inverted(tmp_path, capsys):
    measured = resting(np.random.default_rng(8), inverted=(2, 21), count=40)
    places = np.tile([0.0, 0.0, 0.1], (len(NAMES), 1))
    bag = written(tmp_path / 'rest.mcap', measured, NAMES, TONES, places, AT_REST)
    assert not load_session(bag).tools[0].sensors.is_single.any()
    out = ['--out', str(tmp_path / 'model.yaml'), '--report', str(tmp_path / 'report')]
    assert main(['calibrate', str(bag), *out]) == 0
    assert 'sensor_polarity' in capsys.readouterr().out
    document = json.loads((tmp_path / 'report' / 'calibration.json').read_text())
    assert [one['name'] for one in document['sources']] == list(NAMES)
    (polarity,) = document['effects']
    assert set(polarity['parameters']['channels']) <= {2, 21}
