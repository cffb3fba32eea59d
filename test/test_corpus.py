"""Hostile input, kept as files and mutated: only errors of ours come out, in bounded time.

`corpus/` holds small files by what reads them; a file that once did harm is added there.
"""

import socket
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tracking_world import triaxial_tool

from anser_ros.effects.correction import Correction
from anser_ros.effects.registry import all_effects
from anser_ros.errors import AnserError, ModelFileError
from anser_ros.field.model import EffectRecord
from anser_ros.sessions.model_file import load_model
from anser_ros.sessions.session import load_session
from anser_ros.wire.frame_reader import FrameReader
from anser_ros.wire.setup import parse_setup

CORPUS = Path(__file__).resolve().parent / 'corpus'
SENSORS = triaxial_tool()
LONGEST_S = 1.0
"""Longest processor time, s, that any of these small files may take."""
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


def harmless(use):
    """Only an error of ours may come out, and soon."""
    begin = time.process_time()
    try:
        use()
    except AnserError as error:
        assert '\n' not in str(error).strip(), error
        assert len(str(error)) < 2000, 'a message that repeats its input without end'
    assert time.process_time() - begin < LONGEST_S


def read_serial(data):
    reader = FrameReader()
    for start in range(0, len(data), 50):
        reader.feed(data[start : start + 50])
    assert len(reader._pending) <= len(data)


def read_setup(data):
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


@pytest.mark.parametrize('path', files('setups'), ids=lambda path: path.stem)
def test_setups(path):
    harmless(lambda: read_setup(path.read_bytes()))
    if path.stem in ('traversal', 'absolute'):  # names become topics, and never files
        with pytest.raises(AnserError):
            read_names(path)


@pytest.mark.parametrize('path', files('models'), ids=lambda path: path.stem)
def test_models(path, tmp_path):
    harmless(lambda: read_model(path.read_bytes(), tmp_path))


@pytest.mark.filterwarnings('ignore:Mean of empty slice')
@pytest.mark.parametrize('name', sorted(all_effects()))
@pytest.mark.parametrize('value', ['words', None, -1, [[]], 1e400, {}])
def test_effects_with_parameters_that_make_no_sense(name, value):
    """A file may hold anything; a term that could be made of it is at least one."""
    keys = ('channel', 'channels', 'coil', 'coils', 'gain', 'offset_m', 'read_as', 'matrix')
    for parameters in ({}, dict.fromkeys(keys, value)):
        record = EffectRecord(name, parameters)
        harmless(lambda record=record: Correction.of((record,), SENSORS, (1e3, 2e3)))


@pytest.mark.parametrize('path', files('bags'), ids=lambda path: path.stem)
def test_bags(path, tmp_path):
    harmless(lambda: read_session(path.read_bytes(), tmp_path))


@pytest.mark.parametrize('path', files('serial'), ids=lambda path: path.stem)
def test_serial(path):
    harmless(lambda: read_serial(path.read_bytes()))


@SOME
@given(data=mutated('serial'))
def test_mutated_serial(data):
    harmless(lambda: read_serial(data))


@SOME
@given(data=mutated('setups'))
def test_mutated_setups(data):
    harmless(lambda: read_setup(data))


@SOME
@given(data=mutated('models'))
def test_mutated_models(data, tmp_path):
    harmless(lambda: read_model(data, tmp_path))


@SOME
@given(data=mutated('bags'))
def test_mutated_bags(data, tmp_path):
    harmless(lambda: read_session(data, tmp_path))


def heard(client, server):
    """What a client gets of a server that says the same again and again."""
    for _ in range(100):
        server.send(b'pose')
        try:
            return client.recv(4)
        except TimeoutError:
            continue
    return b''


def test_whatever_a_client_says_to_openigtlink():
    from anser_ros.nodes.output_parts.igtl_server import IgtlServer

    server = IgtlServer('127.0.0.1', 0, lambda header: b'answer')
    try:
        for path in files('igtl'):
            with socket.create_connection(('127.0.0.1', server.port), timeout=5.0) as client:
                client.sendall(path.read_bytes())
                client.settimeout(0.05)
                assert heard(client, server) == b'pose', path
    finally:
        server.close()


def test_an_effect_that_is_none_is_named():
    for parameters, words in (
        (
            {'coil': 'coil3', 'gain': 1.0, 'phase_deg': 0.0},
            'effect coil_gain: its parameters are malformed',
        ),
        ({'coil': 0, 'gain': float('nan'), 'phase_deg': 0.0}, 'effect coil_gain'),
    ):
        with pytest.raises(ModelFileError, match=words):
            Correction.of((EffectRecord('coil_gain', parameters),), SENSORS, (1e3, 2e3))
