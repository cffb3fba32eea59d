"""Hostile input, kept as files and mutated: only errors of ours come out, in bounded time.

`corpus/` holds small files by what reads them; a file that once did harm is added there.
"""

from pathlib import Path

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tracking_world import triaxial_tool

from anser_ros.effects.correction import Correction
from anser_ros.effects.effect import all_effects
from anser_ros.errors import AnserError, ModelFileError, SetupError
from anser_ros.field.model import EffectRecord
from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import load_model
from anser_ros.wire.channel_calibration import parse_channels
from anser_ros.wire.protocols import FrameReader
from anser_ros.wire.setup import parse_setup
from anser_ros.wire.text_files import DEEPEST, MOST_CHARACTERS, read_yaml

CORPUS = Path(__file__).resolve().parent / 'corpus'
SENSORS = triaxial_tool()
SOME = settings(
    max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def files(kind):
    return sorted((CORPUS / kind).iterdir())


@st.composite
def mutated(draw, kind):
    """A file of the corpus with some bytes changed, cut out, or doubled."""
    data = bytearray(draw(st.sampled_from(files(kind))).read_bytes())
    for _ in range(draw(st.integers(0, 6))):
        if not data:
            break
        place = draw(st.integers(0, len(data) - 1))
        length = draw(st.integers(1, 24))
        change = draw(st.sampled_from(('set', 'cut', 'double')))
        if change == 'set':
            data[place : place + length] = draw(st.binary(min_size=1, max_size=length))
        elif change == 'cut':
            del data[place : place + length]
        else:
            data[place:place] = data[place : place + length]
    return bytes(data)


def harmless(use, name=''):
    """Only an error of ours may come out; what never ends, the time limit of tests ends."""
    try:
        use()
    except AnserError as error:
        assert '\n' not in str(error).strip(), (name, error)
        assert len(str(error)) < 2000, 'a message that repeats its input without end'


def read_serial(data, folder):
    reader = FrameReader()
    for start in range(0, len(data), 50):
        reader.feed(data[start : start + 50])
    assert len(reader._pending) <= len(data)


def read_setup(data, folder):
    parse_setup(data.decode('utf-8', 'replace'))


def read_model(data, folder):
    path = folder / 'model.yaml'
    path.write_bytes(data)
    load_model(path)


def read_session(data, folder):
    path = folder / 'bag.mcap'
    path.write_bytes(data)
    load_session(path)


def test_the_good_files_are_read(tmp_path):
    assert len(FrameReader().feed((CORPUS / 'serial' / 'good.bin').read_bytes())) == 6
    assert len(read_names(CORPUS / 'setups' / 'good.yaml')) == 2
    assert load_model(CORPUS / 'models' / 'good.yaml').emitters == ('a',)
    assert load_session(CORPUS / 'bags' / 'good.mcap').tools[0].time.size == 3


def read_names(path):
    return [sensor.name for sensor in parse_setup(path.read_text()).sensors]


READERS = {
    'serial': read_serial, 'setups': read_setup, 'models': read_model, 'bags': read_session
}  # fmt: skip


@pytest.mark.parametrize('kind', READERS)
def test_kept_files_do_no_harm(kind, tmp_path):
    for path in files(kind):
        harmless(lambda path=path: READERS[kind](path.read_bytes(), tmp_path), path.name)


@pytest.mark.parametrize('kind', READERS)
@SOME
@given(data=st.data())
def test_mutated_files_do_no_harm(kind, tmp_path, data):
    content = data.draw(mutated(kind))
    harmless(lambda: READERS[kind](content, tmp_path))


@pytest.mark.parametrize('name', ['traversal', 'absolute'])
def test_names_become_topics_and_never_files(name):
    with pytest.raises(AnserError):
        read_names(CORPUS / 'setups' / f'{name}.yaml')


@pytest.mark.filterwarnings('ignore:Mean of empty slice')
@pytest.mark.parametrize('value', ['words', None, -1, [[]], 1e400, {}])
def test_effects_with_parameters_that_make_no_sense(value):
    """A file may hold anything; a term that could be made of it is at least one."""
    keys = ('channel', 'channels', 'coil', 'coils', 'gain', 'offset_m', 'read_as', 'matrix')
    for name in all_effects():
        for parameters in ({}, dict.fromkeys(keys, value)):
            record = EffectRecord(name, parameters)
            harmless(lambda record=record: Correction.of((record,), SENSORS, (1e3, 2e3)), name)


def test_an_effect_that_is_none_is_named():
    for coil, gain, words in (
        ('coil3', 1.0, 'effect coil_gain: its parameters are malformed'),
        (0, float('nan'), 'effect coil_gain'),
    ):
        record = EffectRecord('coil_gain', {'coil': coil, 'gain': gain, 'phase_deg': 0.0})
        with pytest.raises(ModelFileError, match=words):
            Correction.of((record,), SENSORS, (1e3, 2e3))


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


def test_what_is_too_long_is_not_read_and_what_is_within_reason_is(monkeypatch):
    monkeypatch.setattr(yaml, 'parse', None)
    with pytest.raises(yaml.YAMLError, match='characters are too long'):
        read_yaml('x' * (MOST_CHARACTERS + 1))
    monkeypatch.undo()
    text = 'shared: &s [1, 2]\nfirst: *s\nsecond: {third: *s}\n'
    assert read_yaml(text)['second'] == {'third': [1, 2]}
    assert read_yaml('[' * (DEEPEST - 1) + ']' * (DEEPEST - 1)) is not None
