"""Tables of anybody: each dialect and header is read right, or refused with the reason."""

import numpy as np
import pytest
import yaml

from anser_ros.apps.poses.importing import import_poses
from anser_ros.cli.main import main
from anser_ros.errors import ParameterError
from anser_ros.wire.tables import read_points, read_table

NAMES = ('stamp_ns', 'x_m', 'y_m', 'z_m', 'qx', 'qy', 'qz', 'qw')
START = 1_760_000_000_000_000_000
ROWS = [(START + k * 50_000_000, 0.001 * k, 0.02, -0.3, 0.0, 0.6, 0.0, 0.8) for k in range(12)]


def text_of(separator, names=NAMES, rows=ROWS, comma=False):
    lines = [separator.join(names), *(separator.join(map(repr, row)) for row in rows)]
    text = '\n'.join(lines) + '\n'
    return text.replace('.', ',') if comma else text


def rows_of(head, *rows, separator=','):
    return '\n'.join([head, *(separator.join(map(str, row)) for row in rows)])


PLAIN = text_of(',')
DIALECTS = {
    'comma': PLAIN,
    'semicolon': text_of(';'),
    'semicolon and decimal comma': text_of(';', comma=True),
    'tab': text_of('\t'),
    'tab and decimal comma': text_of('\t', comma=True),
    'blanks': text_of(' '),
    'blanks in columns': text_of('   '),
    'blanks and decimal comma': text_of('  ', comma=True),
    'a blank behind the comma': text_of(', '),
    'quotes': text_of('","').replace('\n', '"\n"')[:-1].join(['"', '']),
    'CRLF': PLAIN.replace('\n', '\r\n'),
    'bars': text_of('|'),
    'minus signs of typography': PLAIN.replace('-', '\N{MINUS SIGN}'),
    'capitals': PLAIN.upper().replace('E-', 'e-'),
    'empty rows at the end': PLAIN + ',,,,,,,\n,,,,,,,\n\n',
    'a separator behind every row': PLAIN.replace('\n', ',\n'),
    'a separator behind every row but the first': PLAIN.replace('\n', ',\n').replace('qw,', 'qw'),
    'a title': 'Recording 3 of the stylus\n' + PLAIN,
    'titles of several cells': 'Recorded by,me\nRate,120.0\n\n' + PLAIN,
    'a comment': '# recorded on a Tuesday\n' + PLAIN,
    'a header behind #': '# ' + PLAIN,
    'a row of units': text_of(',', ['stamp', *'xyz', *NAMES[4:]]).replace(
        'qw\n', 'qw\nns,m,m,m,-,-,-,-\n'
    ),
    'units in brackets': PLAIN.replace('x_m', 'x [m]').replace('y_m', 'y(m)'),
    'the header once more': PLAIN + PLAIN.splitlines()[0] + '\n',
    'other columns between': text_of(
        ';', [*NAMES, 'quality', 'comment'], [(*row, 9, 'good') for row in ROWS]
    ).replace("'", ''),
}  # fmt: skip


@pytest.mark.parametrize('kind', DIALECTS)
@pytest.mark.parametrize('encoding', ['utf-8', 'utf-8-sig', 'utf-16'])
def test_dialects(tmp_path, kind, encoding):
    path = tmp_path / 'poses.CSV'
    path.write_bytes(DIALECTS[kind].encode(encoding))
    session = import_poses([path])
    poses = session.sensors['poses']
    assert session.start_ns == START and poses.size == len(ROWS) and not poses.missing.size
    table = np.array(ROWS)
    np.testing.assert_allclose(poses.time, 1e-9 * (table[:, 0] - START), atol=1e-6)
    np.testing.assert_allclose(poses.position, table[:, 1:4], atol=1e-12)
    np.testing.assert_allclose(poses.quaternion, table[:, 4:], atol=1e-12)


HEADERS = {
    'Time,X,Y,Z,QW,QX,QY,QZ': (0, 1, 2, 3, 7, 4, 5, 6),
    'time_ms,Tx (mm),Ty (mm),Tz (mm),Q0,Qx,Qy,Qz': (0, 1, 2, 3, 7, 4, 5, 6),
    'header.stamp.sec,header.stamp.nanosec,pose.position.x,pose.position.y,pose.position.z,'
    'pose.orientation.x,pose.orientation.y,pose.orientation.z,pose.orientation.w':
        (0, None, 1, 2, 3, 4, 5, 6, 7),
    '%time,field.pose.position.x,field.pose.position.y,field.pose.position.z,'
    'field.pose.orientation.x,field.pose.orientation.y,field.pose.orientation.z,'
    'field.pose.orientation.w': (0, 1, 2, 3, 4, 5, 6, 7),
    '#timestamp,p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []':
        (0, 1, 2, 3, 7, 4, 5, 6),
    'TimeStamp;X_Tool0;Y_Tool0;Z_Tool0;QX_Tool0;QY_Tool0;QZ_Tool0;QR_Tool0': range(8),
    't,posX,posY,posZ,rotX,rotY,rotZ,rotW': range(8),
    't,pos_mm_x,pos_mm_y,pos_mm_z,q_x,q_y,q_z,q_w': range(8),
    'Elapsed Time (s),Position X,Position Y,Position Z,Rotation W,Rotation X,Rotation Y,'
    'Rotation Z':
        (0, 1, 2, 3, 7, 4, 5, 6),
    'ox,oy,oz,ow,x_inch,y_inch,z_inch,sec': (4, 5, 6, 7, 1, 2, 3, 0),
}  # fmt: skip


@pytest.mark.parametrize('head', HEADERS)
def test_headers_decide(tmp_path, head):
    """Columns stand in an order of their own, lengths in the unit that the names state."""
    order = list(HEADERS[head])
    words = head.casefold()
    scale = 1e3 if 'mm' in words else 1 / 0.0254 if 'inch' in words else 1.0
    clock = 1e-6 if 'ms' in words.split(',')[0] else 1e-9
    rows = []
    for row in ROWS:
        cells = [row[0] * clock, *(scale * v for v in row[1:4]), *row[4:]]
        if None in order:
            cells[0] = row[0] // 10**9
        rows.append([row[0] % 10**9 if i is None else cells[i] for i in order])
    path = tmp_path / 'poses.csv'
    separator = ',' if ',' in head else ';'
    path.write_text(rows_of(head, *rows, separator=separator))
    poses = import_poses([path]).sensors['poses']
    np.testing.assert_allclose(poses.position, np.array(ROWS)[:, 1:4], atol=1e-9)
    np.testing.assert_allclose(poses.quaternion, np.array(ROWS)[:, 4:], atol=1e-9)
    np.testing.assert_allclose(poses.time, 0.05 * np.arange(len(ROWS)), atol=1e-6)


@pytest.mark.parametrize('form', ['{}T08:53:{}Z', '{} 08:53:{}', '{}T10:53:{}+02:00'])
def test_dates_are_times(tmp_path, form):
    dates = [form.format('2025-10-09', f'{20 + 0.25 * k:06.3f}') for k in range(len(ROWS))]
    rows = [[date, *row[1:]] for date, row in zip(dates, ROWS, strict=True)]
    path = tmp_path / 'poses.csv'
    path.write_text(rows_of('timestamp,x,y,z,qx,qy,qz,qw', *rows))
    session = import_poses([path])
    assert session.start_ns == 1_760_000_000 * 10**9
    np.testing.assert_allclose(session.sensors['poses'].time, 0.25 * np.arange(12), atol=1e-6)


ANGLES = ['roll', 'pitch', 'yaw']
MATRIX = [(*np.eye(4)[:3].ravel(),)] * 9
REFUSED = {
    'angles': (text_of(',', [*NAMES[:4], *ANGLES, 'rms']), 'rms: angles are not read, give'),
    'a rotation vector': (
        text_of(',', [*NAMES[:4], 'rx_deg', 'ry_deg', 'rz_deg', 'n']), 'rx_deg, ry_deg, rz_deg'
    ),
    'q0 to q3': (text_of(',', [*NAMES[:4], 'q0', 'q1', 'q2', 'q3']), 'q0, q1, q2, q3 are no'),
    'letters': (text_of(',', list('abcdefgh')), 'no position x, y, z'),
    'a counter': (text_of(',', ['frame', *NAMES[1:]]), 'no time'),
    'two times': (
        rows_of('host_time,device_time,x_m,y_m,z_m,qx,qy,qz,qw', *((9, *r) for r in ROWS)),
        'several times: host_time, device_time',
    ),
    'two units': (text_of(',', ['t', 'x_m', 'x_mm', 'y_m', *NAMES[4:]]), 'mean the same'),
    'a name twice': (text_of(',', ['t', 'x', 'y', 'x', *NAMES[4:]]), 'columns are called x'),
    'whole numbers without a unit of time': (
        rows_of('time,x,y,z,qx,qy,qz,qw', *((33 * k, *ROWS[k][1:]) for k in range(9))),
        'no unit of time',
    ),
    'milliseconds without a unit of time': (
        rows_of('time,x,y,z,qx,qy,qz,qw', *((33.33 * k, *ROWS[k][1:]) for k in range(9))),
        'no unit of time',
    ),
    'lengths that cannot be metres': (
        rows_of('t,x,y,z,qx,qy,qz,qw', *((0.1 * k, 99, 20, -300, 0, 0, 0, 1) for k in range(9))),
        '--unit mm?',
    ),
    'a matrix': (rows_of('', *MATRIX, separator=' '), '12 numbers a line'),
    'seven numbers': (rows_of('', *(r[1:] for r in ROWS), separator=' '), '7 numbers a line'),
    'nine numbers': (rows_of('', *((*r, 1) for r in ROWS), separator=' '), '9 numbers a line'),
    'a station number': (
        rows_of('', *((1, *r[1:]) for r in ROWS), separator=' '), 'all 12 times are 1 s'
    ),
    'times that fall': (
        rows_of('', *((9 - k % 3, *r[1:]) for k, r in enumerate(ROWS)), separator=' '),
        'the times do not ascend',
    ),
    'a counter that wraps': (
        text_of(',', ['t_s', *NAMES[1:]], [(k % 11 * 5, *r[1:]) for k, r in enumerate(ROWS)]),
        'line 13: the time falls by 50 s, more than it ever rises',
    ),
    'stamps that are never set': (
        rows_of('time,x,y,z,qx,qy,qz,qw', *((0, *r[1:]) for r in ROWS)), 'all 12 times are 0 s'
    ),
    'the time of the day': (
        rows_of('time,x,y,z,qx,qy,qz,qw', *((f'08:53:{k}', *r[1:]) for k, r in enumerate(ROWS))),
        'give times in s or as 2025-10-09T08:53:20.000Z',
    ),
    'a word': (PLAIN.replace('0.02', 'MISSING', 3), "line 2: y_m is 'MISSING'"),
    'a short row': (PLAIN.replace('0.02,-0.3,', '', 1), 'line 2 has 6 cells, the header 8'),
    'a long row': (PLAIN.replace('0.02', '0.02,7', 1), 'line 2 has 9 cells, the header 8'),
    'a title above numbers': (
        'My recording\n' + text_of(' ').split('\n', 1)[1], "line 1, 'My recording', does not name"
    ),
    '1904': (
        rows_of('t,x,y,z,qx,qy,qz,qw', *((3842844800.5 + r[1], *r[1:]) for r in ROWS)),
        'since 1904 (LabVIEW)? start_ns: -2082844800000000000',
    ),
    '1900': (
        rows_of('t,x,y,z,qx,qy,qz,qw', *((3968988800.5 + r[1], *r[1:]) for r in ROWS)),
        'since 1900 (NTP)? start_ns: -2208988800000000000',
    ),
    'half of the quaternions zero': (
        text_of(',', rows=[r if k % 2 else (*r[:4], 0, 0, 0, 0) for k, r in enumerate(ROWS)]),
        '6 of 12 quaternions are zero',
    ),
    'days': (
        rows_of('', *((739899.3 + 2.9e-7 * k, *r[1:]) for k, r in enumerate(ROWS)), separator=' '),
        '2.9e-07 s apart: days (MATLAB, Excel)?',
    ),
    'a separator that is none': (text_of('~'), 'no row of numbers'),
    '1601': (
        rows_of('t,x,y,z,qx,qy,qz,qw', *((1.34e10 + 0.5 * k, *ROWS[k][1:]) for k in range(9))),
        'since 1601 (Windows)?',
    ),
    'Vicon': (
        'Segments\n,,pen:pen,,,,,\nFrame,Sub Frame,RX,RY,RZ,TX,TY,TZ\n,,deg,deg,deg,mm,mm,mm\n'
        '1,0,0.1,0.2,0.3,10.5,20,30\n2,0,0.1,0.2,0.3,10.6,20,30\n',
        'RX, RY, RZ are no quaternion',
    ),
    'no text': ('\0\1\2\3' * 40, 'not a text'),
    'words': ('some words\nand more\n', 'no row of numbers'),
}  # fmt: skip


@pytest.mark.parametrize('kind', REFUSED)
def test_what_is_not_clear_is_refused_in_a_line(tmp_path, capsys, kind):
    text, said = REFUSED[kind]
    path = tmp_path / 'poses.csv'
    path.write_text(text, encoding='utf-8')
    for command in (['import_poses', str(path), '--out', str(tmp_path / 'o.mcap')],
                    ['pivot', str(path)]):  # fmt: skip
        assert main(command) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert said in line and str(path) in line, line
    assert not (tmp_path / 'o.mcap').exists()


def test_a_header_that_is_not_understood_leaves_a_document_that_can_be_filled_in(tmp_path, capsys):
    """What is known stands in it, the rest is named; it never replaces one."""
    path = tmp_path / 'my poses.csv'
    path.write_text(text_of(',', ['t', *NAMES[1:4], *'abcd']), encoding='utf-8')
    with pytest.raises(ParameterError, match='its columns are t, x_m'):
        import_poses([path])
    document = tmp_path / 'my poses.tables.yaml'
    text = document.read_text()
    assert 't, x_m, y_m, z_m, a, b, c, d' in text
    assert main(['import', str(document), '--out', str(tmp_path / 'o.mcap')]) == 2
    assert 'line 11 lacks what stands for ?: quaternion' in capsys.readouterr().err
    written = yaml.safe_load(text)
    written['tracked'][0]['quaternion'] = list('abcd')
    written['time']['unit'] = 'ns'
    document.write_text(yaml.safe_dump(written))
    assert main(['import', str(document), '--out', str(tmp_path / 'o.mcap')]) == 0
    assert '/tracked/my_poses/pose: 12 messages' in capsys.readouterr().out
    with pytest.raises(ParameterError):
        import_poses([path])
    assert yaml.safe_load(document.read_text()) == written
    written['tracked'][0] |= {'stamp': 'Zeit [s]', 'quaternion': ['q a', 'q [b]', 'q[0]', 'qd']}
    written['time'] = {'unit': 'day', 'start_ns': 0}
    days = [(45000 + k / 86400, *r[1:]) for k, r in enumerate(ROWS)]
    path.write_text(text_of(',', ['Zeit [s]', *NAMES[1:4], 'q a', 'q [b]', 'q[0]', 'qd'], days))
    document.write_text(yaml.safe_dump(written))
    assert main(command := ['import', str(document), '--out', str(tmp_path / 'd.mcap')]) == 2
    assert 'days since 1899-12-30 (Excel)? start_ns: -2209161600' in capsys.readouterr().err
    written['time']['start_ns'] = -2209161600 * 10**9
    document.write_text(yaml.safe_dump(written))
    assert main(command) == 0


def test_bodies_side_by_side_and_rows_that_are_no_pose(tmp_path):
    """As Motive writes them: bodies and kinds above the axes, empty cells where a body is lost."""
    head = ['Length Units,Millimeters', ',Type' + ',Rigid Body' * 14,
            ',Name' + ',pen' * 7 + ',board' * 7,
            ',' + (',Rotation' * 4 + ',Position' * 3) * 2,
            'Frame,Time (Seconds)' + ',X,Y,Z,W,X,Y,Z' * 2]  # fmt: skip
    rows = [f'{k},{0.01 * k:.3f},0,0,0,1,{k},2,3,0,0,1,0,4,5,6' for k in range(9)]
    rows[4] = '4,0.040' + ',' * 7 + ',0,0,1,0,4,5,6'
    (tmp_path / 'a.csv').write_text('\r\n'.join([*head, *rows]))
    sensors = import_poses([tmp_path / 'a.csv']).sensors
    assert set(sensors) == {'pen', 'board'}
    np.testing.assert_allclose(sensors['pen'].position[-1], [0.008, 0.002, 0.003])
    np.testing.assert_allclose(sensors['pen'].missing, [0.04])
    np.testing.assert_allclose(sensors['board'].quaternion, 9 * [[0, 0, 1, 0]])
    rows = [(*r, 7, k % 3, 'OK' if k else 'Out of volume') for k, r in enumerate(ROWS)]
    rows[1] = (START + 1, -9999, -9999, -9999, 0, 0, 0, 1, *rows[1][8:])
    text = text_of(',', [*NAMES, 'tool', 'Tracking Valid', 'status'], rows)
    (tmp_path / 'b.csv').write_text(text)
    poses = import_poses([tmp_path / 'b.csv']).sensors['sensor_7']
    assert poses.size == 7 and poses.missing.size == 5


@pytest.mark.parametrize('text', [
    'x_mm,y_mm,z_mm\n0,0,0\n60,40,0\n', 'X_mm; Y_mm; Z_mm\n0,0;0,0;0,0\n60,0;40,0;0,0\n;;\n',
    'id,x (cm),y (cm),z (cm)\n1,0,0,0\n2,6,4,0\n', 'x\ty\tz\nmm\tmm\tmm\n0\t0\t0\n60\t40\t0\n',
    'x_um,y_um,z_um\n0,0,0\n60000,40000,0\n', 'x_dm,y_dm,z_dm\n0,0,0\n0.6,0.4,0\n',
    'x_mm\ty_mm\tz_mm\n\t0\t0\n60\t40\t0\n', 'x_mm,y_mm,z_mm\n"0,060",0,0\n60,40,0\n',
])  # fmt: skip
def test_places_of_any_unit(tmp_path, text):
    """A gap may be the first cell; a comma between commas may mean a thousand."""
    (tmp_path / 'places.txt').write_text(text)
    table = read_table(tmp_path / 'places.txt')
    if '"' in text:
        with pytest.raises(ParameterError, match="line 2: x_mm is '0,060'"):
            table.positions()
        return
    places = np.nan_to_num(table.positions(with_gaps=True))
    np.testing.assert_allclose(places, [[0, 0, 0], [0.06, 0.04, 0]])


@pytest.mark.parametrize(
    ('name', 'text'),
    [
        ('a.fcsv', '# CoordinateSystem = {}\n# columns = id,x,y,z\nF_0,{},{},3\nF_1,{},{},3'),
        ('a.mrk.json', '{{"markups": [{{"coordinateSystem": "{}", "coordinateUnits": "mm", '
         '"controlPoints": [{{"position": [{}, {}, 3]}}, {{"position": [{}, {}, 3]}}]}}]}}'),
    ],
)  # fmt: skip
def test_lists_of_points_in_their_coordinate_system(tmp_path, name, text):
    for system, sign in (('RAS', 1), ('LPS', -1), ('lps', -1), ('0', 1), ('1', -1)):
        (tmp_path / name).write_text(text.format(system, sign, 2 * sign, 5 * sign, sign))
        np.testing.assert_allclose(
            read_points(tmp_path / name), [[1e-3, 2e-3, 3e-3], [5e-3, 1e-3, 3e-3]]
        )
    (tmp_path / name).write_text(text.format('IJK', 1, 2, 3, 4) if 'f' in name else '{}')
    with pytest.raises(ParameterError, match=r'save them in RAS|no list of points of 3D Slicer'):
        read_points(tmp_path / name)


@pytest.mark.parametrize('sign', [' = ', ':='])
def test_sequences_of_plus(tmp_path, sign):
    lines = ['ObjectType = Image']
    for k in range(9):
        matrix = f'0 -1 0 {k} 1 0 0 20 0 0 1 -30 0 0 0 1'
        state = 'INVALID' if k == 4 else 'OK'
        for key, value in (('ProbeToTrackerTransform', matrix), ('Timestamp', 5.0 + 0.1 * k),
                           ('ProbeToTrackerTransformStatus', state),
                           ('ImageToProbeTransform', matrix)):  # fmt: skip
            lines.append(f'Seq_Frame{k:04d}_{key}{sign}{value}')
    path = tmp_path / 'a.mha'
    path.write_bytes('\n'.join(lines).encode() + b'\nElementDataFile = LOCAL\n\0\1\2\xff')
    (poses,) = import_poses([path]).sensors.values()
    assert poses.name == 'probe' and poses.size == 8 and poses.missing == pytest.approx([0.4])
    np.testing.assert_allclose(poses.position[-1], [0.008, 0.02, -0.03])
    np.testing.assert_allclose(poses.quaternion[0], [0, 0, 0.5**0.5, 0.5**0.5])
    path.write_text('ObjectType = Image\n')
    with pytest.raises(ParameterError, match='a sequence of PLUS without'):
        import_poses([path])
