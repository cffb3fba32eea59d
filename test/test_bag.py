"""Bags read without ROS: whole, cut, damaged, and with content that is refused by name."""

import runpy
from pathlib import Path

import numpy as np
import pytest
from conftest import REPO
from tracking_world import flux_points

from anser_ros.errors import BagError
from anser_ros.sessions.session import load_session
from anser_ros.wire.bag import Salvage, iter_messages, read_bag
from anser_ros.wire.bag_writer import SessionWriter
from anser_ros.wire.points import encode_flux
from anser_ros.wire.recorded import unit_quaternions

START = 1_700_000_000_000_000_000
STEP = 40_000_000
FRAMES = 400
SETUP = """
schema: anser_setup/1
flux_rate_hz: 25.0
emitter:
  kind: square_spiral_pcb
  coils:
  - {name: a, centre_m: [0, 0, 0], frequency_hz: 6000}
  - {name: b, centre_m: [0.1, 0, 0], frequency_hz: 6200}
sensors:
- {channel: 4, name: t/y, body: t, position_m: [0, 0, 0.01], axis: [0, 1, 0]}
- {channel: 2, name: t/z, body: t, position_m: [0, 0, 0], axis: [0, 0, 1]}
- {channel: 9, name: r, body: fg, position_m: [0.1, 0, 0], axis: [1, 0, 0]}
"""


def cloud(channels, frame: int, emitters: int = 2) -> tuple:
    flux = np.array([[100 * c + k + 1j * frame for k in range(emitters)] for c in channels]) * 1e-9
    fields, step, data = encode_flux(flux_points(flux, channels=channels))
    return fields, step, len(channels), data


def write(path: Path, frames: int = 50, setup: str | None = SETUP) -> Path:
    with SessionWriter(path) as writer:
        if setup is not None:
            writer.write_setup(setup, START)
        for frame in range(frames):
            stamp = START + frame * STEP
            writer.write_flux('/anser/tool/flux', stamp, *cloud([2, 4], frame))
            writer.write_flux('/anser/reference/flux', stamp, *cloud([9], frame))
            for half in (0, STEP // 2):
                x = 0.01 * (frame * STEP + half) * 1e-9
                writer.write_pose('/optical/t/pose', stamp + half, [x, 0, 0.1], [0, 0, 0, 1.0])
    return path


@pytest.fixture(scope='module')
def whole(tmp_path_factory) -> Path:
    return write(tmp_path_factory.mktemp('bag') / 'whole.mcap', FRAMES)


def test_a_session_is_read_in_the_order_of_the_setup(whole):
    session = load_session(whole)
    tool = session.tools[0]
    assert tool.sensors.name == ('t/y', 't/z')
    assert tool.flux.shape == (FRAMES, 2, 2)
    np.testing.assert_allclose(tool.flux[3, :, 1], [401e-9 + 3e-9j, 201e-9 + 3e-9j], rtol=1e-6)
    np.testing.assert_allclose(tool.position[:-1, 0], 0.01 * tool.time[:-1], atol=1e-12)
    assert tool.usable.all()
    assert session.reference.flux.shape == (FRAMES, 1, 2)
    assert session.lost == ''


def test_a_folder_with_one_bag_is_a_bag(whole):
    assert read_bag(whole.parent).tool.stamp_ns.size == FRAMES


@pytest.mark.parametrize('share', [0.3, 0.5, 0.7, 0.9, 0.98])
def test_a_cut_bag_is_read_as_far_as_it_goes(whole, tmp_path, share):
    data = whole.read_bytes()
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes(data[: int(len(data) * share)])
    salvage = Salvage()
    try:
        messages = list(iter_messages(cut, salvage))
    except BagError as error:
        assert 'no message can be read' in str(error)
        return
    everything = 1 + 4 * FRAMES
    assert 0 < len(messages) <= everything
    assert len(messages) == everything or salvage.lost.startswith('the bag breaks off after')
    stamps = [message.log_time_ns for message in messages]
    assert stamps == sorted(stamps)
    assert len(messages) > everything * (share - 0.35)


@pytest.mark.long
def test_damage_inside_never_crashes_and_never_reads_wrong(whole, tmp_path):
    data, rng = whole.read_bytes(), np.random.default_rng(5)
    good = read_bag(whole).tool
    table = dict(zip(good.stamp_ns.tolist(), good.flux, strict=True))
    path = tmp_path / 'damaged.mcap'
    for _ in range(25):
        broken = bytearray(data)
        for place in rng.integers(0, len(data), size=3):
            broken[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(broken)
        try:
            bag = read_bag(path)
        except BagError:
            continue
        if bag.tool is not None:
            for stamp, flux in zip(bag.tool.stamp_ns.tolist(), bag.tool.flux, strict=True):
                np.testing.assert_array_equal(flux, table[stamp])


@pytest.mark.parametrize(
    ('make', 'message'),
    [
        (lambda p: p.write_bytes(b''), 'the file is empty'),
        (lambda p: p.write_bytes(b'hello world, no bag at all'), 'not an MCAP file'),
        (lambda p: p.write_bytes(b'\x89MCAP0\r\n'), 'no message can be read'),
        (lambda p: write(p, setup=None), 'no setup'),
        (lambda p: write(p, setup='schema: other'), 'schema must be'),
        (lambda p: write(p, frames=0), 'no readable flux'),
    ],
)
def test_a_bag_that_is_none_is_refused(tmp_path, make, message):
    path = tmp_path / 'bag.mcap'
    make(path)
    with pytest.raises(BagError, match=message):
        read_bag(path)


def test_absent_and_ambiguous_paths_are_refused(tmp_path):
    with pytest.raises(BagError, match='no such bag'):
        read_bag(tmp_path / 'absent.mcap')
    with pytest.raises(BagError, match='a folder without'):
        read_bag(tmp_path)


def test_bad_messages_are_counted_and_the_rest_is_read(tmp_path):
    path = tmp_path / 'mixed.mcap'
    fields, step, width, data = cloud([2, 4], 0)
    with SessionWriter(path) as writer:
        writer.write_setup(SETUP, START)
        topic = '/anser/tool/flux'
        writer.write_flux(topic, START, fields, step, width, data)
        writer.write_flux(topic, START, fields, step, width, data)
        writer.write_flux(topic, START + 1, fields[:-1], step, width, data)
        writer.write_flux(topic, START + 2, fields, step, width + 1, data)
        writer.write_flux(topic, 0, fields, step, width, data)
        writer.write_flux(topic, START + 3, *cloud([2], 1))
        writer.write_pose('/optical/t/pose', START, [float('nan'), 0, 0], [0, 0, 0, 1.0])
        writer.write_pose('/optical/t/pose', START, [0, 0, 0], [0, 0, 0, 0.2])
        writer.write_pose('/elsewhere/pose', START, [0, 0, 0], [0, 0, 0, 1.0])
    bag = read_bag(path)
    assert bag.tool.stamp_ns.tolist() == [START, START + 3]
    assert np.isnan(bag.tool.flux[1, 1]).all()
    assert sum(bag.refused.values()) == 6
    assert bag.optical == {}


def test_the_last_setup_holds(tmp_path):
    """Acquisition says its rate and noise once the stream is there, in a second document."""
    path = tmp_path / 'two.mcap'
    with SessionWriter(path) as writer:
        writer.write_setup(SETUP, START)
        writer.write_setup(f'{SETUP}flux_noise_t: 1.5e-10\n', START + 1)
        writer.write_flux('/anser/tool/flux', START + 2, *cloud([2, 4], 0))
    bag = read_bag(path)
    assert bag.setup.extra['flux_noise_t'] == 1.5e-10
    assert 'flux_noise_t' in bag.setup_text


def test_another_number_of_emitters_than_the_setups_is_refused(tmp_path):
    path = tmp_path / 'three.mcap'
    with SessionWriter(path) as writer:
        writer.write_setup(SETUP, START)
        writer.write_flux('/anser/tool/flux', START, *cloud([2, 4], 0, emitters=3))
    with pytest.raises(BagError, match='the setup has 2 emitters, the fluxes 3'):
        load_session(path)


def test_a_chunk_that_declares_too_much_is_never_unpacked(whole, tmp_path, monkeypatch):
    """With a small bound, a bag whose chunks are larger gives nothing, and says so."""
    for name, value in (('_RECORD_LIMIT', 1000), ('breakup_chunk', None)):  # None is not called
        monkeypatch.setattr(f'anser_ros.wire.bag_files.{name}', value)
    salvage = Salvage()
    with pytest.raises(BagError, match='no message can be read'):
        list(iter_messages(whole, salvage))
    assert salvage.lost


def test_quaternions_are_brought_to_unit_length_or_are_none():
    true = np.random.default_rng(1).normal(size=(200, 4))
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    mended = unit_quaternions(np.round(true, 2))
    np.testing.assert_allclose(np.linalg.norm(mended, axis=1), 1.0, rtol=1e-12)
    assert np.abs(mended - true).max() < 0.011
    given = [[0.0, 0.0, 0.0, 0.0], [np.nan, 0.0, 0.0, 1.0], [10.0, 20.0, 30.0, 0.0]]
    assert np.isnan(unit_quaternions(given)).all()


NAMES = ('factory', 'moving', 'metal', 'scan')


@pytest.fixture(scope='module')
def remade(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp('bags')
    writer = runpy.run_path(str(REPO / '.ci' / 'write_bags.py'))
    writer['main'](['--out', str(folder)])
    return folder


@pytest.mark.long
@pytest.mark.parametrize('name', NAMES)
def test_bag_is_small_and_is_what_the_command_makes(remade, name):
    committed = REPO / 'bags' / f'{name}.mcap'
    assert committed.stat().st_size < 2_000_000
    old, new = load_session(committed), load_session(remade / f'{name}.mcap')
    assert old.setup == new.setup
    for a, b in zip([*old.tools, old.reference], [*new.tools, new.reference], strict=True):
        # Another BLAS sums in another order; float32 rounds what is left.
        np.testing.assert_allclose(a.flux, b.flux, rtol=1e-6, atol=1e-15)
        np.testing.assert_allclose(a.position, b.position, atol=1e-12)
        assert a.usable.all()
