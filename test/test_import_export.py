"""Other people's data in, and ours out: tables and foreign bags, and back again."""

import io
import json
import sqlite3

import h5py
import numpy as np
import pytest
import yaml
import zstandard
from conftest import REPO
from scipy.io import loadmat, savemat

from anser_ros.apps.poses.importing import read_pose_session
from anser_ros.cli.main import main
from anser_ros.sessions.session import load_session
from anser_ros.wire.bag import Salvage, iter_messages, read_bag

MOVING = REPO / 'bags' / 'moving.mcap'
FRAMES = 12


@pytest.fixture(scope='module')
def moving():
    return read_bag(MOVING)


@pytest.fixture
def folder(tmp_path, moving):
    (tmp_path / 'board.yaml').write_text(moving.setup_text)
    return tmp_path


def names_of(bag, stream):
    by_channel = {sensor.channel: sensor.name for sensor in bag.setup.sensors}
    return [by_channel[channel] for channel in stream.channel.tolist()]


def write_document(folder, fluxes, poses, time):
    """A document of tables, and the command that imports them."""
    document = {
        'schema': 'anser_import/1', 'setup': 'board.yaml', 'time': time, 'fluxes': fluxes,
        'poses': poses,
    }  # fmt: skip
    (folder / 'tables.yaml').write_text(yaml.safe_dump(document))
    return ['import', str(folder / 'tables.yaml'), '--out', str(folder / 'out.mcap')]


def arrays_of(bag):
    """Fluxes in nT with all sensors in one array, and seconds since a start."""
    start = int(bag.tool.stamp_ns[0]) - 1_000_000_000
    seconds = 1e-9 * (bag.tool.stamp_ns[:FRAMES] - start)
    return start, seconds, 1e9 * bag.tool.flux[:FRAMES]


def assert_same(folder, bag):
    again = load_session(folder / 'out.mcap')
    true = load_session(MOVING)
    tool, before = again.tools[0], true.tools[0]
    assert again.setup == true.setup
    np.testing.assert_allclose(tool.flux, before.flux[:FRAMES], rtol=1e-6)
    np.testing.assert_allclose(tool.time, before.time[:FRAMES], atol=2e-7)
    return again


def savemat73(path, arrays):
    """As MATLAB writes version 7.3: HDF5, the first index fastest, complex as a compound."""
    with h5py.File(path, 'w') as file:
        for name, value in arrays.items():
            if np.iscomplexobj(value):
                pair = np.zeros(value.shape, dtype=[('real', '<f8'), ('imag', '<f8')])
                pair['real'], pair['imag'] = value.real, value.imag
                value = pair
            file[name] = value.T


@pytest.mark.parametrize('ending', ['npz', 'mat', '73.mat'])
def test_arrays_become_a_session(folder, moving, ending):
    start, seconds, flux = arrays_of(moving)
    name = f'data.{ending}' if ending != '73.mat' else 'data73.mat'
    arrays = {'t': seconds.reshape(-1, 1), 'B': flux}
    if ending == 'npz':
        np.savez(folder / name, t=seconds, B=flux)
    else:
        (savemat if ending == 'mat' else savemat73)(folder / name, arrays)
    fluxes = [
        {'file': name, 'stamp': 't', 'unit': 'nT', 'array': 'B',
         'sensors': names_of(moving, moving.tool)}
    ]  # fmt: skip
    assert main(write_document(folder, fluxes, [], {'unit': 's', 'start_ns': start})) == 0
    assert_same(folder, moving)


def test_columns_of_csv_become_a_session_with_poses(folder, moving, capsys):
    """Stamps are whole nanoseconds, quaternions have w first, lengths are millimetres.

    The poses have a time base of their own.
    """
    _, _, flux = arrays_of(moving)
    names = names_of(moving, moving.tool)
    head, columns, sensors = ['t'], [moving.tool.stamp_ns[:FRAMES].tolist()], {}
    for s, name in enumerate(names):
        sensors[name] = {'re': [], 'im': []}
        for k in range(flux.shape[2]):
            for part in ('re', 'im'):
                head.append(f'{name}.{k}.{part}')
                sensors[name][part].append(head[-1])
                values = flux[:, s, k]
                columns.append((values.real if part == 're' else values.imag).tolist())
    rows = [','.join(map(repr, row)) for row in zip(*columns, strict=True)]
    (folder / 'flux.csv').write_text('\n'.join([','.join(head), *rows]))
    track = moving.optical['tool_a']
    lines, start = ['t,qw,qx,qy,qz,x,y,z'], int(track.stamp_ns[0]) - 7
    for stamp, p, q in zip(track.stamp_ns, 1e3 * track.position, track.quaternion, strict=True):
        lines.append(f'{stamp - start},{q[3]},{q[0]},{q[1]},{q[2]},{p[0]},{p[1]},{p[2]}')
    lines.append(f'{track.stamp_ns[-1] - start + 5},,,,,,,')  # the tracker saw nothing
    (folder / 'poses.csv').write_text('\n'.join(lines))
    poses = [
        {'file': 'poses.csv', 'stamp': 't', 'body': 'tool_a', 'unit': 'mm', 'order': 'wxyz',
         'position': ['x', 'y', 'z'], 'quaternion': ['qw', 'qx', 'qy', 'qz'],
         'time': {'unit': 'ns', 'start_ns': start}}
    ]  # fmt: skip
    fluxes = [{'file': 'flux.csv', 'stamp': 't', 'unit': 'nT', 'sensors': sensors}]
    assert main([*write_document(folder, fluxes, poses, {'unit': 'ns'}), '--json']) == 0
    counts = json.loads(capsys.readouterr().out)['messages']
    assert counts == {
        '/anser/tool/flux': FRAMES, '/optical/tool_a/pose': len(track.stamp_ns)
    }  # fmt: skip
    tool = assert_same(folder, moving).tools[0]
    true = load_session(MOVING).tools[0]
    np.testing.assert_allclose(tool.position, true.position[:FRAMES], atol=1e-9)
    np.testing.assert_allclose(tool.rotation, true.rotation[:FRAMES], atol=1e-6)


@pytest.mark.parametrize(
    ('change', 'said'),
    [
        ({'unit': 'gauss'}, 'unit must be among T, mT'),
        ({'stamp': 'time'}, "no 'time'; there are: t, B"),
        ({'sensors': ['nobody']}, 'the setup has no sensor nobody'),
        ({'array': 't'}, 'not frames x sensors x emitters'),
        ({'file': 'absent.npz'}, 'no such file'),
        ({'file': 'torn.npz'}, 'cannot be read'),
        ({'colour': 'red'}, 'no key colour'),
        ({'stamp': 'B'}, 'so B is not a column'),
        ({'stamp': 'z'}, 'stamps are alike: are they set'),
        ({'time': {'unit': 'week'}}, 'fluxes[0]: time: unit must be among s, ms'),
    ],
)
def test_what_is_wrong_with_a_document_is_one_line(folder, moving, capsys, change, said):
    start, seconds, flux = arrays_of(moving)
    arrays = {'t': seconds, 'B': flux, 'z': 0 * seconds}
    np.savez(folder / 'data.npz', **arrays)
    (folder / 'torn.npz').write_bytes(b'PK\3\4junk')
    table = {'file': 'data.npz', 'stamp': 't', 'unit': 'nT', 'array': 'B',
             'sensors': names_of(moving, moving.tool)}  # fmt: skip
    command = write_document(folder, [{**table, **change}], [], {'start_ns': start})
    assert main(command) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and said in lines[0]
    assert not (folder / 'out.mcap').exists()


def sqlite_bag(path, messages, squeeze=lambda data: data):
    """A file as rosbag2's sqlite3 storage writes it."""
    base = sqlite3.connect(path)
    base.execute(
        'CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, '
        'serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)'
    )
    base.execute(
        'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, '
        'timestamp INTEGER NOT NULL, data BLOB NOT NULL)'
    )
    ids = {}
    for message in messages:
        topic = message.topic.replace('/anser/tool/flux', '/em/flux')
        if topic not in ids:
            ids[topic] = len(ids) + 1
            row = (ids[topic], topic, message.type_name, 'cdr', '')
            base.execute('INSERT INTO topics VALUES(?, ?, ?, ?, ?)', row)
        base.execute(
            'INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)',
            (ids[topic], message.log_time_ns, squeeze(message.data)),
        )
    base.commit()
    base.close()


def squeezed(data):
    return zstandard.ZstdCompressor().compress(data)


@pytest.mark.parametrize('mode', ['', 'FILE', 'MESSAGE'])
def test_a_split_bag_in_sqlite3_with_other_names_is_read(tmp_path, mode, moving):
    """Two files, compressed as a whole, by message or not at all; a topic has to be renamed."""
    messages = list(iter_messages(MOVING, Salvage()))
    half = len(messages) // 2
    bag = tmp_path / 'bag'
    bag.mkdir()
    names = []
    for number, part in enumerate((messages[:half], messages[half:])):
        path = bag / f'bag_{number}.db3'
        sqlite_bag(path, part, squeezed if mode == 'MESSAGE' else lambda data: data)
        if mode == 'FILE':
            (bag / f'{path.name}.zstd').write_bytes(squeezed(path.read_bytes()))
            path.unlink()
        names.append(path.name + ('.zstd' if mode == 'FILE' else ''))
    about = {'version': 5, 'relative_file_paths': names, 'compression_mode': mode,
             'compression_format': 'zstd' if mode else ''}  # fmt: skip
    text = yaml.safe_dump({'rosbag2_bagfile_information': about})
    (bag / 'metadata.yaml').write_text(text)
    out = tmp_path / 'out.mcap'
    command = ['import', str(bag), '--out', str(out)]
    assert main([*command, '--remap', '/em/flux:=/anser/tool/flux']) == 0
    again = read_bag(out)
    np.testing.assert_array_equal(again.tool.flux, moving.tool.flux)
    np.testing.assert_array_equal(again.tool.stamp_ns, moving.tool.stamp_ns)
    assert again.optical.keys() == moving.optical.keys()
    assert again.setup == moving.setup


def test_a_setup_document_can_be_added_and_a_wrong_name_is_said(tmp_path, moving, capsys):
    text = moving.setup_text.replace('flux_rate_hz: 50', 'flux_rate_hz: 26')
    assert text != moving.setup_text
    (tmp_path / 'board.yaml').write_text(text)
    out = tmp_path / 'out.mcap'
    command = ['import', str(MOVING), '--out', str(out), '--setup', str(tmp_path / 'board.yaml')]
    assert main(command) == 0
    assert read_bag(out).setup.flux_rate_hz == 26.0
    capsys.readouterr()
    other = ['import', str(MOVING), '--out', str(tmp_path / 'o.mcap'), '--remap', '/a:=/b']
    assert main(other) == 2
    assert 'no topic /a; there are: /anser/' in capsys.readouterr().err
    assert not (tmp_path / 'o.mcap').exists()
    other[-1] = '/optical/tool_a/pose:=/anser/tool/flux'
    assert main(other) == 2
    assert '/anser/tool/flux would have' in capsys.readouterr().err
    assert not (tmp_path / 'o.mcap').exists()
    assert main(command) == 2
    assert 'already exists' in capsys.readouterr().err
    for name, content, said in (
        ('x.db3', b'SQLite format 3\0' + bytes(200), 'not a bag in sqlite3'),
        ('x.db3.zstd', b'nothing', 'cannot be unpacked'),
        ('x.txt', b'', 'neither .db3 nor .mcap'),
    ):
        (tmp_path / name).write_bytes(content)
        new = str(tmp_path / f'{name}.mcap')
        assert main(['import', str(tmp_path / name), '--out', new]) == 2
        assert said in capsys.readouterr().err


def test_export_of_poses_and_fluxes(tmp_path, moving, capsys):
    track = moving.optical['tool_a']
    for form in ('csv', 'tum', 'mat'):
        assert main(['export', str(MOVING), '--format', form, '--out', str(tmp_path)]) == 0
    text = (tmp_path / 'optical_tool_a.txt').read_text()
    assert text.splitlines()[0].split()[0] == f'{track.stamp_ns[0] / 1e9:.9f}'[:10] + (
        f'.{track.stamp_ns[0] % 10**9:09d}'
    )
    rows = np.loadtxt(io.StringIO(text))
    np.testing.assert_allclose(rows[:, 1:4], track.position, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(rows[:, 4:], track.quaternion, rtol=1e-7, atol=1e-9)
    table = np.genfromtxt(tmp_path / 'tool_flux.csv', delimiter=',', names=True)
    sensors = len(moving.tool.channel)
    again = table['coil2_re_t'].reshape(-1, sensors) + 1j * table['coil2_im_t'].reshape(
        -1, sensors
    )
    np.testing.assert_allclose(again, moving.tool.flux[:, :, 2], rtol=1e-8)
    loaded = loadmat(tmp_path / 'tool_flux.mat')
    np.testing.assert_array_equal(loaded['flux_t'], moving.tool.flux)
    np.testing.assert_array_equal(loaded['stamp_ns'].ravel(), moving.tool.stamp_ns)
    capsys.readouterr()
    assert main(['export', str(MOVING), '--out', str(tmp_path), '--json']) == 0
    rows = json.loads(capsys.readouterr().out)['rows']
    assert rows['optical_tool_a.csv'] == len(track.stamp_ns)
    assert main(['export', 'nowhere.mcap', '--out', str(tmp_path)]) == 2


def test_tables_of_tracked_poses_become_a_session_of_poses(tmp_path, capsys):
    """No setup and no fluxes: what `diagnose --poses` takes."""
    rows = [f'{0.05 * k},{k},0,100,1,0,0,0,seen' for k in range(1, 30)]
    (tmp_path / 'em.csv').write_text('\n'.join(['t,x,y,z,qw,qx,qy,qz,state', *rows]))
    table = {
        'file': 'em.csv', 'stamp': 't', 'position': ['x', 'y', 'z'], 'unit': 'mm',
        'quaternion': ['qw', 'qx', 'qy', 'qz'], 'order': 'wxyz',
    }  # fmt: skip
    document = {
        'schema': 'anser_import/1', 'tracked': [{**table, 'sensor': 'tip'}],
        'poses': [{**table, 'body': 'marker'}],
    }  # fmt: skip
    path, out = tmp_path / 'tables.yaml', tmp_path / 'out.mcap'
    path.write_text(yaml.safe_dump(document))
    assert main(['import', str(path), '--out', str(out)]) == 0
    assert '/tracked/tip/pose: 29 messages' in capsys.readouterr().out
    session = read_pose_session(out)
    np.testing.assert_allclose(session.sensors['tip'].position[4], [0.005, 0.0, 0.1])
    np.testing.assert_allclose(session.reference.rotation[0], np.eye(3))
    for change, said in (
        ({'tracked': []}, 'needs fluxes'),
        ({'setup': 'board.yaml'}, 'tracked poses have none'),
        ({'tracked': [table]}, 'tracked[0] lacks sensor'),
    ):
        path.write_text(yaml.safe_dump({**document, **change}))
        assert main(['import', str(path), '--out', str(tmp_path / 'not.mcap')]) == 2
        assert said in capsys.readouterr().err
        assert not (tmp_path / 'not.mcap').exists()
