"""Files of poses as trackers write them: what each form means, and what is refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.importing import import_poses, read_pose_session
from anser_ros.cli.main import run_verb
from anser_ros.errors import BagError, ParameterError, PlausibilityError

MISSING = '-3.697314E28'
TURN = Rotation.from_rotvec([0.3, -0.2, 0.5])


def write(path, *lines):
    path.write_text('\n'.join(lines) + '\n', encoding='utf-8')
    return path


def tool_tracker(path, rows, ports=('Port 10: X', 'Port 11: Y')):
    names = r'Frame\tFace\tState\tQ0\tQx\tQy\tQz\tTx\tTy\tTz\tError\tMarkers'.replace(r'\t', '\t')
    head = '\t'.join(['Tools', *(f'{port}\t{names}' for port in ports)])
    lines = [head]
    for cells in rows:
        groups = ('\t'.join([p, *c, '0.1', '0']) for p, c in zip(ports, cells, strict=True))
        lines.append('\t'.join(['2', *groups]))
    return write(path, *lines)


def cell(frame, state='OK', numbers=None, x=1.0):
    q = TURN.as_quat()
    numbers = numbers or [str(v) for v in (q[3], *q[:3], x, 20.0, -30.0)]
    return [str(frame), '1', state, *numbers]


def line(sensor, x, q, stamp):
    return (
        f'SensorID: {sensor} Position: {x} 2 3 Orientation: {" ".join(map(str, q))} Time: {stamp}'
    )


def device_line(stamp_s, frame):
    q = ' '.join(map(str, TURN.as_quat()))
    host = round(1e9 * stamp_s)
    return f'Position: {stamp_s} 2 3 Orientation: {q} AuroraFrame: {frame} NetworkTime: {host}'


def one_of(session):
    (poses,) = session.sensors.values()
    return poses


def test_tool_tracker_counts_field_periods_and_says_what_is_missing(tmp_path):
    gone = cell(3208, 'Too Few Markers', [MISSING] * 7)
    path = tool_tracker(tmp_path / 'a.tsv', [
        (cell(3200), cell(3200)), (cell(3208, x=2.0), gone), (cell(3216), cell(3216, 'Bad Fit')),
    ])  # fmt: skip
    session = import_poses([path])
    one, other = session.sensors['port_10'], session.sensors['port_11']
    np.testing.assert_allclose(one.time, [0, 0.025, 0.05], atol=1e-12)
    np.testing.assert_allclose(one.position[1], [0.002, 0.02, -0.03])
    np.testing.assert_allclose(one.rotation[0], TURN.as_matrix(), atol=1e-12)
    assert other.size == 1
    np.testing.assert_allclose(other.missing, [0.025, 0.05])
    session = import_poses([tool_tracker(tmp_path / 'b.tsv', [(cell(8),), (cell(16),)], ('',))])
    assert 'port_1: no time; 320 frames a second are assumed' in session.lost


def test_two_ports_of_one_label_are_refused_in_a_line(tmp_path):
    path = tool_tracker(tmp_path / 'a.tsv', [(cell(8), cell(8))], ('Port 10: X', 'Port 10: Y'))
    with pytest.raises(ParameterError, match=r'a\.tsv: two ports are called port_10'):
        import_poses([path])


def test_a_file_called_optical_alone_is_a_tracker(tmp_path):
    rows = [f'{t} 0 0 0 0 0 0 1' for t in range(1, 5)]
    session = import_poses([write(tmp_path / 'optical.tum', *rows)])
    assert session.sensors['optical'].size == 4 and session.reference is None


def test_a_counter_that_restarts_goes_on(tmp_path):
    path = tool_tracker(tmp_path / 'a.tsv', [(cell(n, x=n),) for n in (64000, 64008, 8, 16)],
                        ports=('Port 10: X',))  # fmt: skip
    time = import_poses([path]).sensors['port_10'].time
    np.testing.assert_allclose(time, [0, 0.025, 0.025, 0.05], atol=1e-9)


def test_lines_of_several_sensors_out_of_order(tmp_path):
    q = TURN.as_quat()
    path = write(tmp_path / 'a.txt', line(0, 1, q, 5_000_000_000), line(1, 4, q, 5_100_000_000),
                 line(0, 3, q, 5_400_000_000), line(0, 2, q, 5_200_000_000),
                 line(1, MISSING, q, 5_300_000_000), 'end')  # fmt: skip
    session = import_poses([path])
    first = session.sensors['sensor_0']
    np.testing.assert_allclose(first.time, [0, 0.2, 0.4])
    np.testing.assert_allclose(first.position[:, 0], [0.001, 0.002, 0.003])
    assert first.unordered == 1
    assert session.sensors['sensor_1'].missing.size == 1
    assert session.start_ns == 5_000_000_000


def test_ascension_writes_the_scalar_first_and_the_inverse(tmp_path):
    x, y, z, w = TURN.inv().as_quat()
    row = line(0, 1, (w, x, y, z), 10**9).replace('Time', 'Quality: 9 DeviceTime: 7.5 NetworkTime')
    session = import_poses([write(tmp_path / 'a.txt', row)])
    np.testing.assert_allclose(
        session.sensors['sensor_0'].rotation[0], TURN.as_matrix(), atol=1e-9
    )


def test_device_stamps_lie_on_the_hosts_axis_by_the_smallest_delay(tmp_path):
    late = (0.012, 0.003, 0.009)
    rows = [device_line(100 + k / 40 + s, 8 * k) for k, s in enumerate(late)]
    path = write(tmp_path / 'a.txt', *rows)
    host, device = (one_of(import_poses([path], stamps=s)).time for s in ('host', 'device'))
    np.testing.assert_allclose(np.diff(device), 0.025, atol=1e-9)
    assert np.ptp(np.diff(host)) > 0.01


def test_tum_csv_and_static_files_one_after_the_other(tmp_path):
    q = ' '.join(map(str, TURN.as_quat()))
    tum = write(tmp_path / 'a.tum', '# t x y z', f'1.5 0.1 0.2 0.3 {q}', f'1.6 0.1 0.2 0.4 {q}')
    session = import_poses([tum])
    poses, poses_lost = one_of(session), session.lost
    np.testing.assert_allclose(poses.position[:, 2], [0.3, 0.4])
    thousand = write(tmp_path / 'mm.tum', f'1.5 100 200 300 {q}', f'1.6 100 200 400 {q}')
    assert 'm: --unit mm?' in import_poses([thousand]).lost and '--unit' not in poses_lost
    np.testing.assert_allclose(
        one_of(import_poses([thousand], unit='mm')).position, poses.position
    )
    table = write(tmp_path / 'a.csv', 'stamp_ns,sensor,x_mm,y_mm,z_mm,qx,qy,qz,qw',
                  '1000000000,tip,1,2,3,0,0,0,1', '1100000000,tip,,,,,,,')  # fmt: skip
    poses = import_poses([table]).sensors['tip']
    np.testing.assert_allclose(poses.position, [[0.001, 0.002, 0.003]])
    np.testing.assert_allclose(poses.missing, [0.1])
    with pytest.raises(ParameterError, match='its header says mm, --unit cm'):
        import_poses([table], unit='cm')
    again = write(tmp_path / 'b.csv', *table.read_text().replace(',1,2,3', ',9,2,3').split())
    with pytest.raises(ParameterError, match=r'a\.csv and .*b\.csv both give tip, at the same'):
        import_poses([table, again])
    files, optical = [], []
    for n in range(2):
        rows = [(cell(8),), (cell(16),)], [(cell(3),), (cell(6),)]
        files.append(tool_tracker(tmp_path / f'{n}.tsv', rows[0], ('Port 1: X',)))
        optical.append(tool_tracker(tmp_path / f'o{n}.tsv', rows[1], ('Port 1: OT',)))
    session = import_poses(files, optical)
    pause = np.diff(session.sensors['port_1'].time)
    np.testing.assert_allclose(pause[[0, 2]], 0.025, atol=1e-9)
    assert pause[1] > 5
    np.testing.assert_allclose(session.reference.time[2], session.sensors['port_1'].time[2])


@pytest.mark.parametrize('text', ['', 'some words\nand more', '1 2 3', 'a,b\n1,2'])
def test_a_file_of_no_known_form_is_refused_in_a_line(tmp_path, text, capsys):
    path = write(tmp_path / 'a.txt', text)
    assert run_verb('import_poses', [str(path), '--out', str(tmp_path / 'a.mcap')]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ('rows', 'said'),
    [
        (('1,2,3',), 'no complete pose'),
        (('inf,1,2,3,0,0,0,1',), 'no pose has a time'),
        (('-5,1,2,3,0,0,0,1',), 'cannot be stamps of a bag'),
        (('99999999999999999999999,1,2,3,0,0,0,1',), 'cannot be stamps of a bag'),
    ],
)
def test_a_table_without_one_pose_or_time_is_refused_and_leaves_no_bag(
    tmp_path, rows, said, capsys
):
    path = write(tmp_path / 'a.csv', 'stamp_ns,x_mm,y_mm,z_mm,qx,qy,qz,qw', *rows)
    out = tmp_path / 'a.mcap'
    assert run_verb('import_poses', [str(path), '--out', str(out)]) == 2
    (words,) = capsys.readouterr().err.strip().splitlines()
    assert said in words and not out.exists()


def test_quaternions_of_another_length_axes_in_two_units_and_odd_files_are_refused(tmp_path):
    path = write(tmp_path / 'a.txt', line(0, 1, (2, 0, 0, 3), 10**9))
    with pytest.raises(PlausibilityError, match=r'norm of 3\.6'):
        import_poses([path])
    with pytest.raises(ParameterError, match='one by one'):
        import_poses([path], [path, path])
    head = 'stamp_ns,x_m,y_mm,z_m,qx,qy,qz,qw'
    table = write(tmp_path / 'a.csv', head, '1000000000,1,2,3,0,0,0,1')
    with pytest.raises(ParameterError, match='columns'):
        import_poses([table])


def test_a_bag_keeps_poses_and_what_was_missing(tmp_path, capsys):
    q = TURN.as_quat()
    path = write(tmp_path / 'a.txt', line(0, 1, q, 5_000_000_000),
                 line(0, MISSING, q, 5_100_000_000), line(1, 2, q, 5_200_000_000))  # fmt: skip
    optical = write(tmp_path / 'o.txt', line(0, 7, q, 5_050_000_000)[len('SensorID: 0 ') :])
    bag = tmp_path / 'a.mcap'
    arguments = [str(path), '--reference', str(optical), '--out', str(bag), '--unit', 'inch']
    assert run_verb('import_poses', arguments) == 0
    assert '1 missing' in capsys.readouterr().out
    session = read_pose_session(bag)
    assert set(session.sensors) == {'sensor_0', 'sensor_1'}
    np.testing.assert_allclose(
        session.sensors['sensor_1'].position[0], 0.0254 * np.array([2, 2, 3])
    )
    np.testing.assert_allclose(session.sensors['sensor_0'].missing, [0.1])
    np.testing.assert_allclose(session.reference.position[0], [0.007, 0.002, 0.003])
    only = read_pose_session(bag, {'tip': '/tracked/sensor_1/pose'}, '/tracked/sensor_0/pose')
    assert list(only.sensors) == ['tip']
    assert only.reference.size == 1
    with pytest.raises(BagError, match='/tracked/sensor_0/pose'):
        read_pose_session(bag, {'tip': '/nothing'})


def test_sensors_have_the_names_that_they_are_given(tmp_path, capsys):
    path = tool_tracker(tmp_path / 'a.tsv', [(cell(n), cell(n)) for n in (8, 16)])
    command = ['--name', 'port_10=tip', '--out', str(tmp_path / 'out.mcap')]
    assert run_verb('import_poses', [str(path), *command]) == 0
    assert set(read_pose_session(tmp_path / 'out.mcap').sensors) == {'tip', 'port_11'}
    capsys.readouterr()
    for name, said in (
        ('port_12=tip', 'no sensor port_12; there are: port_10, port_11'),
        ('port_10=port_11', 'must differ in name'),
        ('port_10', 'takes FOUND=NEW'),
        ('port_10=a b', 'words joined by /'),
    ):
        command = ['--name', name, '--out', str(tmp_path / 'other.mcap')]
        assert run_verb('import_poses', [str(path), *command]) == 2
        assert said in capsys.readouterr().err


def test_rows_in_any_order_have_the_device_stamps_of_their_own(tmp_path):
    lines = [device_line(100 + 0.05 * k, 1000 + 16 * k) for k in range(60)]
    mixed = [lines[k] for k in np.random.default_rng(1).permutation(60)]
    ordered, found = (
        one_of(import_poses([write(tmp_path / f'{n}.txt', *rows)], stamps='device'))
        for n, rows in (('a', lines), ('b', mixed))
    )
    np.testing.assert_allclose(found.time, ordered.time, atol=1e-9)
    np.testing.assert_array_equal(found.position, ordered.position)


def test_a_device_that_restarts_after_a_pause_is_put_on_the_hosts_axis_again(tmp_path):
    before = [device_line(100 + 0.05 * k, 5000 + 16 * k) for k in range(40)]
    after = [device_line(110 + 0.05 * k, 16 * k) for k in range(40)]
    path = write(tmp_path / 'a.txt', *before, *after)
    time = one_of(import_poses([path], stamps='device')).time
    np.testing.assert_allclose(time[40:] - time[:40], 10.0, atol=1e-6)


def test_a_title_and_lines_that_are_no_poses_are_left_out_and_told(tmp_path, capsys):
    q = TURN.as_quat()
    rows = [line(0, k, q, 10**9 * (k + 1)) for k in range(6)]
    path = write(tmp_path / 'a.txt', 'Recorded on a Tuesday', *rows[:3], 'connection lost',
                 'Position: 1 2', *rows[3:])  # fmt: skip
    session = import_poses([path])
    assert session.sensors['sensor_0'].size == 6
    assert session.lost.endswith(': 3')
    out = tmp_path / 'a.mcap'
    assert run_verb('import_poses', [str(path), '--out', str(out)]) == 0
    assert session.lost in capsys.readouterr().out


def test_a_key_without_a_colon_no_sensors_name_and_rows_that_stand_twice_are_read(tmp_path):
    rows = [line(k % 2, k, TURN.as_quat(), 10**9 * (k + 1)) for k in range(8)]
    path = write(tmp_path / 'a.txt', *(row.replace('SensorID:', 'SensorID') for row in rows))
    optical = write(tmp_path / 'o.txt', *(row[len('SensorID: 0 ') :] for row in 2 * rows))
    session = import_poses([path], [optical])
    assert {n: s.size for n, s in session.sensors.items()} == {'sensor_0': 4, 'sensor_1': 4}
    assert one_of(import_poses([optical], [optical])).size == session.reference.size == 8


def test_a_tool_tracker_file_with_its_header_once_more_goes_on(tmp_path):
    path = tool_tracker(tmp_path / 'a.tsv', [(cell(3200 + 320 * k), cell(3200)) for k in range(4)])
    text = path.read_text(encoding='utf-8')
    session = import_poses([write(path, text.strip(), text.strip())])
    np.testing.assert_allclose(session.sensors['port_10'].time, range(7))  # one of them twice
    assert not session.lost


def moving(count, stamp):
    """Rows of TUM at 60 Hz of a hand with a jitter of 0.1 mm, under stamps of a function, s."""
    time = np.arange(count) / 60.0
    rng = np.random.default_rng(1)
    places = 0.1 * np.sin(time[:, None] * [0.9, 0.7, 1.1]) + rng.normal(0, 1e-4, (count, 3))
    return [f'{stamp(t):.6f} {x:.6f} {y:.6f} {z:.6f} 0 0 0 1' for t, (x, y, z) in
            zip(time, places, strict=True)]  # fmt: skip


@pytest.mark.parametrize('size', [0.4, 3600.0, -0.7])
def test_a_clock_that_was_set_is_told_with_time_and_size(tmp_path, size):
    start = 1_760_000_000.0
    rows = moving(1200, lambda t: start + t + (size if t > 10.0 else 0.0))
    session = import_poses([write(tmp_path / 'a.tum', *rows)])
    assert f'the clock of a steps by {size:.1f} s at 10.0 s' in session.lost


def test_a_pause_of_a_tracker_is_no_step_of_its_clock(tmp_path):
    rows = moving(1200, lambda t: 1000.0 + t)
    session = import_poses([write(tmp_path / 'a.tum', *rows[:600], *rows[630:])])
    assert not session.lost


def test_stamps_that_are_cut_are_refused_and_clocks_apart_are_told(tmp_path, capsys):
    start = 1_760_000_000.0
    cut = write(tmp_path / 'cut.tum', *moving(600, lambda t: start + t // 1))
    assert run_verb('pivot', [str(cut)]) == 2
    assert '60 poses of cut have each stamp: cut to seconds?' in capsys.readouterr().err
    em = write(tmp_path / 'em.tum', *moving(600, lambda t: start + t))
    for late, said in ((7200.0, '7200.0 s later'), (-1.76e9 + 50.0, '1759999950.0 s earlier')):
        ot = write(tmp_path / 'ot.tum', *moving(600, lambda t, late=late: start + t + late))
        assert run_verb('handeye', [str(em), '--reference', str(ot)]) == 2
        words = capsys.readouterr().err
        assert f'2025-10-09 08:53:20 to 08:53:30, reference {said}' in words
    session = import_poses([em], [ot], shift_s=(late, 0.0))
    np.testing.assert_allclose(session.sensors['em'].time, session.reference.time, atol=1e-5)


@pytest.mark.parametrize(
    ('name', 'called'),
    [('EM run-1', 'EM_run_1'), ('2025-03-04', 'sensor_2025_03_04'), ('Zeiger_ä', 'Zeiger_a'),
     ('a.b.c', 'a_b_c'), ('—', 'body'), ('pen(2)', 'pen_2')],
)  # fmt: skip
def test_names_of_files_become_names_of_topics_and_are_told(tmp_path, name, called, capsys):
    path = write(tmp_path / f'{name}.tum', *moving(9, lambda t: 5.0 + t))
    assert run_verb('import_poses', [str(path), '--out', str(tmp_path / 'o.mcap')]) == 0
    assert f'{name} is called {called}' in capsys.readouterr().out
    assert set(read_pose_session(tmp_path / 'o.mcap').sensors) == {called}


def test_counters_that_run_through_several_files_are_one_clock(tmp_path):
    """Two devices of their own clocks, one 250 ppm fast; the programs start 40 ms apart."""
    files = {'EM': [], 'OT': []}
    for number, late in enumerate((0.0, 0.04, -0.03)):
        start = 240.0 * number
        for name, ppm, first in (('EM', 250, 5000.0), ('OT', 0, 900.0)):
            true = start + (late if name == 'EM' else 0.0) + np.arange(20) / 20
            hz = 320 if name == 'EM' else 60
            frames = np.round(hz * (first + true * (1 + 1e-6 * ppm))).astype(int)
            rows = [(cell(frame),) for frame in frames]
            path = tmp_path / f'{name}{number}.tsv'
            files[name].append(tool_tracker(path, rows, (f'Port {name}',)))
    session = import_poses(files['EM'], files['OT'])
    tracked, reference = one_of(session).time[::20], session.reference.time[::20]
    np.testing.assert_allclose(np.diff(reference), 240, atol=0.02)
    apart = np.diff(tracked) - np.diff(reference)
    np.testing.assert_allclose(apart, [0.06 + 0.04, 0.06 - 0.07], atol=0.02)


def test_counters_that_start_anew_in_every_file_are_put_one_after_the_other(tmp_path):
    rows = [(cell(16 * k),) for k in range(20)]
    files = [tool_tracker(tmp_path / f'{n}.tsv', rows, ('Port EM',)) for n in range(4)]
    session = import_poses(files[:2], files[2:])
    assert session.reference.time[20] - session.reference.time[19] == pytest.approx(10.0)


def test_a_devices_counter_has_one_zero_on_the_hosts_axis_in_all_files(tmp_path):
    def rows(start, late):
        return [
            device_line(start + 0.05 * k + late, 1000 + 320 * start + 16 * k) for k in range(9)
        ]

    files = [write(tmp_path / f'{n}.txt', *rows(100 + 60 * n, 0.04 * (n % 2))) for n in range(3)]
    time = one_of(import_poses(files, stamps='device')).time
    np.testing.assert_allclose(time[9::9] - time[:-9:9], 60, atol=1e-9)
