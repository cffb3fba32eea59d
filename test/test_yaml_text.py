"""YAML from anybody: bombs, abysses and tags are refused at once; documents of ours are read."""

import pytest
import yaml

from anser_ros.errors import ModelFileError, SetupError
from anser_ros.sessions.starting_model import load_model
from anser_ros.wire.channel_calibration import parse_channels
from anser_ros.wire.setup import parse_setup
from anser_ros.wire.text_files import DEEPEST, MOST_CHARACTERS, read_yaml


def bomb(levels=40):
    """Text whose aliases stand for 2^levels items."""
    lines = ['a0: &a0 [x, x]']
    lines += [f'a{i}: &a{i} [*a{i - 1}, *a{i - 1}]' for i in range(1, levels)]
    return '\n'.join(lines)


HOSTILE = {
    'aliases written out': bomb(),
    'nested deeper': '[' * 200_000,
    'deeper than': '- ' * 100_000,
    'levels': '{a: ' * 50_000,
    'contains itself': 'a: &a [*a]',
    'python/object': '!!python/object/apply:os.system ["true"]',
    'constructor': '!mine {a: 1}',
}


@pytest.mark.parametrize('words', HOSTILE)
def test_hostile_text_is_refused_at_once(words, tmp_path):
    with pytest.raises(yaml.YAMLError, match=words):
        read_yaml(HOSTILE[words])
    for read, error in ((parse_setup, SetupError), (parse_channels, SetupError)):
        with pytest.raises(error, match='not YAML'):
            read(HOSTILE[words])
    path = tmp_path / 'model.yaml'
    path.write_text(HOSTILE[words])
    with pytest.raises(ModelFileError, match='not YAML'):
        load_model(path)


def test_a_text_that_is_too_long_is_not_read(monkeypatch):
    monkeypatch.setattr(yaml, 'parse', None)
    with pytest.raises(yaml.YAMLError, match='characters are too long'):
        read_yaml('x' * (MOST_CHARACTERS + 1))


def test_aliases_and_depth_within_reason_are_read():
    text = 'shared: &s [1, 2]\nfirst: *s\nsecond: {third: *s}\n'
    assert read_yaml(text)['second'] == {'third': [1, 2]}
    assert read_yaml('[' * (DEEPEST - 1) + ']' * (DEEPEST - 1)) is not None
