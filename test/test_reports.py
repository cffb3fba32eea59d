"""Reports of other projects, played as they stand: read right, or refused with the reason."""

import re
import shutil

import pytest
from conftest import SHARED, needs

from anser_ros.cli.main import main

FOLDER = SHARED / 'reports'
pytestmark = [needs('reports'), pytest.mark.long]

POSE = '0.002138,0.010489,-0.298902,-0.109381699,0.234569699,0.408217898,0.875426095'
FIRST = f'1760000000000000000,{POSE}'


@pytest.fixture
def play(request, tmp_path, monkeypatch, capsys):
    """Run a command in a copy of a report's folder; return its code and what it said."""
    for entry in FOLDER.glob(f'{request.param}_*/*'):
        copy = tmp_path / entry.name
        shutil.copytree(entry, copy) if entry.is_dir() else shutil.copyfile(entry, copy)
    monkeypatch.chdir(tmp_path)

    def run(command):
        code = main(command if isinstance(command, list) else command.split())
        said = capsys.readouterr()
        assert code in (0, 2), said.err
        assert code == 0 or len(said.err.strip().splitlines()) == 1, said.err
        return code, said.out + said.err

    return run


def report(number):
    return pytest.mark.parametrize('play', [number], indirect=True)


@report('01')
@pytest.mark.parametrize(
    ('name', 'row'),
    [
        ('opti_m_nogap.csv', '1000000000,0,0.2,0.9,0,0,0.104527994,0.994521945'),
        ('wxyz_upper_s.csv', FIRST), ('mm_upper_s.csv', FIRST), ('spaces_head.csv', FIRST),
        ('upper.csv', FIRST), ('polhemus_q_noid.txt', 'all 600 times are 1 s'),
        ('kitti.txt', '12 numbers a line and no names'),
        ('euler_small.csv', 'its columns are time, x, y, z, azimuth, elevation, roll, quality'),
    ],
)  # fmt: skip
def test_a_header_decides(play, tmp_path, name, row):
    code, said = play(f'import_poses {name} --out x.mcap')
    if code:
        assert row in said and not (tmp_path / 'x.mcap').exists()
        return
    assert play('export x.mcap --out e')[0] == 0
    (table,) = (tmp_path / 'e').iterdir()
    assert table.read_text().splitlines()[1] == row


@report('02')
@pytest.mark.parametrize(
    ('name', 'words'),
    [('short', 't has 60 rows, P[0] 40'), ('long', 't has 40 rows, P[0] 60'),
     ('mixed', 't has 60 rows, y 50'), ('wide', 'along the other axis: transpose it')],
)  # fmt: skip
def test_columns_of_unequal_length(play, name, words):
    code, said = play(f'import {name}.yaml --out x.mcap')
    assert code == 2 and f'{name}.npz: ' in said and words in said


@report('03')
def test_a_log_of_sqlite_is_read(play):
    code, said = play('import wal_crashed --out x.mcap')
    assert code == 0 and '/ndi/pen/pose: 300 messages' in said


@report('04')
@pytest.mark.parametrize('name', ['empty_def', 'selfname_def', 'idl'])
def test_definitions_of_the_package_are_used(play, tmp_path, name):
    code, said = play(f'pivot {name}.mcap')
    assert code == 0 and '299 of 300 poses agree' in said
    tip = [float(v) for v in re.findall(r'│ [xyz] +│ (-?\d+\.\d+)', said)]
    assert tip == pytest.approx([10.0, -5.0, 120.0], abs=0.02)
    assert play(f'export {name}.mcap --out e')[0] == 0
    if name == 'empty_def':
        assert play(f'accuracy rest {name}.mcap')[0] == 2  # the tool moves
        assert play(f'handeye {name}.mcap --tracked pen=/ndi/pen/pose')[0] == 2
        assert play('evaluate m_allempty.mcap --model nominal --out e2')[0] == 0


@report('05')
@pytest.mark.parametrize('command', ['import_poses ep_labview.txt', 'import labview.yaml'])
def test_times_beyond_2038(play, tmp_path, command):
    code, said = play(f'{command} --out x.mcap')
    assert code == 2 and 'times of 2091-' in said and '(2038-01-19)' in said
    assert 'since 1904 (LabVIEW)? start_ns: -2082844800000000000' in said
    path = tmp_path / 'labview.yaml'
    path.write_text(path.read_text().replace('unit: s', 'unit: s, start_ns: -2082844800000000000'))
    command += ' --shift -2082844800' if 'poses' in command else ''
    assert play(f'{command} --out x.mcap')[0] == 0


@report('06')
@pytest.mark.parametrize(
    ('command', 'words'),
    [('import dup.yaml', 'dup.csv: several columns are called x, y, z, qx, qy, qz, qw'),
     ('import_poses duph.csv', 'duph.csv: several columns are called x_m')],
)  # fmt: skip
def test_names_that_stand_twice(play, command, words):
    code, said = play(f'{command} --out x.mcap')
    assert code == 2 and words in said


@report('07')
@pytest.mark.parametrize('system', ['lps', 'ras'])
def test_coordinates_of_slicer(play, system):
    code, said = play(f'error_map tr_{system}.fcsv --true true_ras.fcsv --out m')
    assert code == 0 and '1.775 mm rms without a map, 0.176 mm with' in said


@report('08')
def test_stamps_that_are_equal(play, tmp_path):
    words = 'all 2000 stamps of /tracked/pen/pose are 0: the driver does not set header.stamp'
    for command in ('accuracy rest', 'export --format tum --out e'):
        name, *rest = command.split()
        code, said = play([name, *rest[:1], 'rest0.mcap'] if name == 'accuracy' else
                          [name, 'rest0.mcap', *rest])  # fmt: skip
        assert code == 0 and words in said
    rows = (tmp_path / 'e/tracked_pen.txt').read_text().splitlines()
    assert len({row.split()[0] for row in rows}) == 2000
    code, said = play('accuracy rest restdup.mcap')
    assert code == 2 and '20 poses of tracked/pen have each stamp: cut to seconds?' in said
    code, said = play('handeye he_z2.mcap --out h')
    assert code == 0 and 'all 3600 stamps of /optical/pen/pose are 0' in said and '0.55' in said


@report('09')
@pytest.mark.parametrize(
    ('name', 'called'),
    [('EM run-1', 'EM_run_1'), ('2025-03-04', 'sensor_2025_03_04')],
)  # fmt: skip
def test_names_that_can_be_topics(play, name, called):
    command = ['import_poses', f'{name}.txt', '--reference', 'ot.txt', '--out', 's.mcap']
    code, said = play(command)
    assert code == 0 and f'{name} is called {called}' in said and f'{called}: 1200 poses' in said


@report('12')
def test_another_encoding(play, tmp_path):
    code, said = play('import json.mcap --out x.mcap')
    assert code == 2 and '300 messages of /ndi/pen/pose are JSON, not CDR' in said
    assert not (tmp_path / 'x.mcap').exists()


@report('13')
@pytest.mark.parametrize('command', ['pivot cut', 'accuracy rest restcut', 'export cut'])
def test_a_loss_is_told_by_every_command(play, command):
    code, said = play(f'{command}.mcap --out e')
    assert code == 0 and 'the bag breaks off after' in said
    assert 'rest' in command or 'after 163054 of 168846 bytes (EndOfFile)' in said


@report('14')
def test_dialects(play, tmp_path):
    for name in ('semi_comma.csv', 'semicolon.csv', 'tab.tsv', 'utf16.csv', 'quoted_title.csv'):
        code, said = play(f'pivot {name}')
        assert code == 0 and '599 of 600 poses agree' in said
    for name in ('semicomma', 'upper', 'units', 'title', 'blanktail', 'trail'):
        (tmp_path / 'x.mcap').unlink(missing_ok=True)
        code, said = play(f'import {name}.yaml --out x.mcap')
        assert code == 0 and '/tracked/pen/pose: 60 messages' in said
    code, said = play('import missing.yaml --out y.mcap')
    assert code == 2 and "missing.csv: line 12: x is 'MISSING'" in said
    for name in ('ph_space', 'ph_semi_comma', 'ph_up', 'ph_blank'):
        code, said = play(f'accuracy point-to-point p2p.csv --truth {name}.csv')
        assert code == 0 and '6 points' in said


@report('15')
def test_clocks_apart(play):
    begin = 'em.txt: 2025-10-09 08:53:20 to 08:54:20, reference'
    for name, words in (('tz', '7200.0 s later'), ('boot', '1759914000.0 s earlier')):
        code, said = play(f'handeye em.txt --reference ot_{name}.txt')
        assert code == 2 and f'{begin} {words}' in said and 'time zones or epochs?' in said
    code, said = play('handeye em.txt --reference ot_step.txt')
    assert code == 0 and 'the clock of optical steps by 0.4 s at 30.0 s' in said


@report('16')
def test_poses_of_other_types(play):
    code, said = play('pivot transform.mcap')
    assert code == 0 and '299 of 300 poses agree' in said
    assert play('export transform.mcap --out e')[0] == 0
    code, said = play('import json_lc.mcap --out x.mcap')
    assert code == 2 and '300 messages of /ndi/pen/pose are JSON' in said


@report('17')
@pytest.mark.parametrize(
    ('name', 'count', 'words'),
    [
        ('cutdb', 128, '128 of the 300 messages that metadata.yaml counts are there'),
        ('emptymeta', 300, 'metadata.yaml cannot be read'),
        ('nulmeta', 300, 'metadata.yaml cannot be read'),
        ('missfile', 300, 'bag_1.db3 of the bag is missing'),
        ('zcutm', 0, 'bag_0.mcap.zstd: cannot be unpacked: it breaks off'),
    ],
)  # fmt: skip
def test_remains_of_bags(play, name, count, words):
    code, said = play(f'import {name} --out x.mcap')
    assert words in said and code == (0 if count else 2)
    assert not count or f'/ndi/pen/pose: {count} messages' in said


@report('18')
def test_one_pose_without_a_rotation(play):
    code, said = play('import q0.yaml --out x.mcap')
    assert code == 0 and '/tracked/pen/pose: 59 messages' in said and '1 pose' in said


@report('19')
def test_a_terminal_without_unicode(play, monkeypatch, tmp_path):
    """As Python opens the standard output where the locale says ASCII."""
    import io
    import sys

    raw = io.BytesIO()
    monkeypatch.setattr(sys, 'stdout', io.TextIOWrapper(raw, encoding='ascii'))
    assert main(['handeye', 'em.txt', '--reference', 'ot.txt', '--out', 'h']) == 0
    sys.stdout.flush()
    assert b'tracked stamps are 0.2 ? 0.2 ms' in raw.getvalue()
