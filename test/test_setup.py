"""The setup document: what is read, and what is refused with the rule named."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from conftest import REPO

from anser_ros.errors import SetupError
from anser_ros.physics.volume import TrackedVolume
from anser_ros.refit.clouds import default_clouds, region_of
from anser_ros.sessions.nominal_board import NominalBoard, stated_volume, tracked_volume
from anser_ros.wire.setup import dump_setup, parse_setup, topic_of

DEMO = REPO / 'config' / 'demo_setup.yaml'


def document() -> dict:
    return {
        'schema': 'anser_setup/1',
        'frame_id': 'fg',
        'flux_rate_hz': 50.0,
        'flux_unit': 'T',
        'emitter': {
            'kind': 'square_spiral_pcb',
            'turns': 25,
            'coils': [
                {'name': f'coil{k}', 'centre_m': [0.1 * k, 0, 0], 'frequency_hz': 6000.0 + 200 * k}
                for k in range(3)
            ],
        },
        'sensors': [
            {
                'channel': 0, 'name': 'tool_a/0/x', 'body': 'tool_a',
                'position_m': [0, 0, 0.01], 'axis': [1.0, 0, 0], 'length_m': 0.008,
            },
            {
                'channel': 16, 'name': 'ref/0', 'body': 'fg',
                'position_m': [0.1, 0.1, 0.02], 'axis': [0.6, 0.0, 0.8],
            },
        ],
    }  # fmt: skip


def test_a_setup_survives_being_written_and_read():
    setup = parse_setup(yaml.safe_dump(document()))
    assert parse_setup(dump_setup(setup)) == setup
    assert setup.emitter.geometry == {'turns': 25}
    assert [s.name for s in setup.tool_sensors] == ['tool_a/0/x']
    assert [s.name for s in setup.reference_sensors] == ['ref/0']
    assert setup.bodies == ('tool_a',)
    assert setup.frequencies_hz == (6000.0, 6200.0, 6400.0)


def edited(path: tuple, value: object) -> str:
    root = document()
    place = root
    for key in path[:-1]:
        place = place[key]
    if value is None:
        del place[path[-1]]
    else:
        place[path[-1]] = value
    return yaml.safe_dump(root)


@pytest.mark.parametrize(
    ('path', 'value', 'message'),
    [
        (('schema',), 'anser_setup/9', 'schema must be'),
        (('flux_unit',), 'uT', 'flux_unit must be T'),
        (('frame_id',), 'world', "frame_id must be 'fg'"),
        (('flux_rate_hz',), None, 'lacks the key'),
        (('flux_rate_hz',), float('nan'), 'must be finite'),
        (('flux_rate_hz',), 'fast', 'must be a number'),
        (('emitter', 'coils'), [], 'at least one coil'),
        (('emitter', 'coils', 0, 'frequency_hz'), -5.0, 'must be finite and in'),
        (('emitter', 'coils', 1, 'name'), 'coil0', 'appears twice'),
        (('emitter', 'coils', 1, 'frequency_hz'), 6000.0, 'frequency_hz 6000.0 appears twice'),
        (('emitter', 'coils', 0, 'centre_m'), [1, 2], 'three numbers'),
        (('sensors',), [], 'at least one sensor'),
        (('sensors', 0, 'channel'), 70000, 'integer in'),
        (('sensors', 1, 'channel'), 0, 'appears twice'),
        (('sensors', 1, 'name'), 'tool_a/0/x', 'appears twice'),
        (('sensors', 0, 'name'), 'tool a', 'words joined by /'),
        (('sensors', 0, 'axis'), [0, 0, 2.0], 'unit vector'),
        (('sensors', 0, 'length_m'), -1.0, 'must be finite and in'),
        (('sensors', 0), 'coil', 'must be a mapping'),
        (('acuracy',), {'flux_noise_t': 1e-10}, "is 'accuracy' meant"),
        (('Volume',), {'low_m': [0, 0, 0.1]}, "is 'volume' meant"),
    ],
)
def test_a_broken_rule_is_named(path, value, message):
    with pytest.raises(SetupError, match=message) as caught:
        parse_setup(edited(path, value))
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize('text', ['', '[', '\x00', '- 1', 'schema: [', 'just words', '&a [*a]'])
def test_garbage_is_no_setup(text):
    with pytest.raises(SetupError):
        parse_setup(text)


def test_keys_of_somebody_else_are_kept():
    setup = parse_setup(edited(('clinic',), {'room': 3}))
    assert parse_setup(dump_setup(setup)).extra['clinic'] == {'room': 3}


def test_topics_are_legal_ros_names_that_no_two_sensors_share():
    assert topic_of('tool_b/y') == 'tool_b/y'
    assert topic_of('tool_a/0/x') == 'tool_a_0/x'
    assert topic_of('3') == 'sensor_3'
    root = document()
    root['sensors'].append({**root['sensors'][0], 'channel': 5, 'name': 'tool_a_0/x'})
    with pytest.raises(SetupError, match='topic'):
        parse_setup(yaml.safe_dump(root))


@pytest.mark.parametrize(
    ('volume', 'word'),
    [
        ('[]', 'volume must be a mapping'),
        ('{low_m: [-0.1, -0.1, 0.05]}', "volume lacks the key 'high_m'"),
        ('{low_m: [-0.1, -0.1], high_m: [0.1, 0.1, 0.3]}', 'volume.low_m must be a list of three'),
        ('{low_m: [-0.1, 0.1, 0.05], high_m: [0.1, 0.1, 0.3]}', 'must be below volume.high_m'),
        ('{low_m: [0, 0, 0.1], high_m: [1, 1, 1], floor_m: 1}', 'not floor_m'),
    ],
)
def test_volumes_that_are_none_are_refused(volume, word):
    with pytest.raises(SetupError, match=word) as caught:
        parse_setup(f'{DEMO.read_text()}\nvolume: {volume}\n')
    assert '\n' not in str(caught.value)


def test_a_stated_volume_is_read_and_written():
    text = f'{DEMO.read_text()}\nvolume: {{low_m: [-0.1, -0.12, 0.06], high_m: [0.1, 0.1, 0.3]}}\n'
    setup, default = parse_setup(text), parse_setup(DEMO.read_text())
    assert setup.volume == ((-0.1, -0.12, 0.06), (0.1, 0.1, 0.3))
    assert default.volume is None and not setup.has_same_board(default)
    assert parse_setup(dump_setup(setup)) == setup


def test_a_volume_may_reach_around_the_emitters():
    box = (-0.2, -0.2, -0.2), (0.2, 0.2, 0.2)
    setup = parse_setup(
        f'{DEMO.read_text()}\nvolume: {{low_m: {[*box[0]]}, high_m: {[*box[1]]}}}\n'
    )
    assert setup.volume == box
    samples = stated_volume(setup).samples()
    np.testing.assert_allclose([samples.min(axis=0), samples.max(axis=0)], box)


def test_without_a_stated_volume_it_follows_from_the_board():
    setup = parse_setup(DEMO.read_text())
    region = region_of(NominalBoard.of(setup).field)
    assert tracked_volume(setup) == TrackedVolume() == region.volume
    box = ((-0.1, -0.12, 0.06), (0.1, 0.1, 0.3))
    stated = replace(setup, volume=box)
    assert tracked_volume(stated) == stated_volume(stated) == TrackedVolume(*box)
    samples = stated_volume(stated).samples()
    np.testing.assert_allclose([samples.min(axis=0), samples.max(axis=0)], box)
    around = [c.positions for c in default_clouds(replace(region, stated=stated_volume(stated)))
              if c.overhead]  # fmt: skip
    assert not any(stated_volume(stated).contains(p) for p in np.concatenate(around))
    other = replace(setup, emitter=replace(setup.emitter, kind='somebody'))
    assert tracked_volume(other) == TrackedVolume()
