"""Reports of other projects, played as they stand: read right, or refused with the reason."""

import io
import shlex
import shutil
import sys
from pathlib import Path

import pytest
from conftest import SHARED, needs

from anser_ros.cli.main import main

FOLDER = SHARED / 'reports'
pytestmark = [needs('reports'), pytest.mark.long]

POSE = '0.002138,0.010489,-0.298902,-0.109381699,0.234569699,0.408217898,0.875426095'
FIRST = f'1760000000000000000,{POSE}'
OPTICAL = '1000000000,0,0.2,0.9,0,0,0.104527994,0.994521945'
LABVIEW = 'since 1904 (LabVIEW)? start_ns: -2082844800000000000'
UNSET = 'all 2000 stamps of /tracked/pen/pose are 0: the driver does not set header.stamp'
EM = 'em.txt: 2025-10-09 08:53:20 to 08:54:20, reference'
JSON = '300 messages of /ndi/pen/pose are JSON, not CDR'
COUNTED = '128 of the 300 messages that metadata.yaml counts are there'
READ = '/ndi/pen/pose: 300 messages'
ROWS = '/tracked/pen/pose: 60 messages'
AGREE, MAP = '599 of 600 poses agree', '1.775 mm rms without a map, 0.176 mm with'
CUT = 'the bag breaks off after'
# Report, commands (the last one's exit code is 2 if - stands before them), and what is said; > is
# a file of its own, and =FOLDER the first row of the table in a folder.
PLAYED = [
    *((1, f'import_poses {name} > ; export x.mcap --out e; =e', row) for name, row in (
        ('opti_m_nogap.csv', OPTICAL), *((f'{name}.csv', FIRST) for name in (
            'wxyz_upper_s', 'mm_upper_s', 'spaces_head', 'upper')))),
    (1, '- import_poses polhemus_q_noid.txt >', 'all 600 times are 1 s'),
    (1, '- import_poses kitti.txt >', '12 numbers a line and no names'),
    (1, '- import_poses euler_small.csv >',
     'its columns are time, x, y, z, azimuth, elevation, roll, quality'),
    (2, '- import short.yaml >', 'short.npz: t has 60 rows, P[0] 40'),
    (2, '- import long.yaml >', 'long.npz: t has 40 rows, P[0] 60'),
    (2, '- import mixed.yaml >', 'mixed.npz: t has 60 rows, y 50'),
    (2, '- import wide.yaml >', 'along the other axis: transpose it'),
    (3, 'import wal_crashed >', READ),
    *((4, f'pivot {name}.mcap', '299 of 300 poses agree')
      for name in ('empty_def', 'selfname_def', 'idl')),
    (4, 'export empty_def.mcap --out e', 'ndi_pen.csv'),
    (4, '- accuracy rest empty_def.mcap', ''),
    (4, '- handeye empty_def.mcap --tracked pen=/ndi/pen/pose', ''),
    (4, 'evaluate m_allempty.mcap --model nominal --out e', 'tool_a'),
    (5, '- import_poses ep_labview.txt >', LABVIEW),
    (5, '- import labview.yaml >', 'times of 2091-'),
    (5, 'import_poses ep_labview.txt --shift -2082844800 >', 'poses'),
    (6, '- import dup.yaml >', 'dup.csv: several columns are called x, y, z, qx, qy, qz, qw'),
    (6, '- import_poses duph.csv >', 'duph.csv: several columns are called x_m'),
    *((7, f'error_map tr_{system}.fcsv --true true_ras.fcsv --out m', MAP)
      for system in ('lps', 'ras')),
    (8, 'accuracy rest rest0.mcap', UNSET),
    (8, 'export --format tum rest0.mcap --out e', UNSET),
    (8, '- accuracy rest restdup.mcap', '20 poses of tracked/pen have each stamp: cut to'),
    (8, 'handeye he_z2.mcap --out h', 'all 3600 stamps of /optical/pen/pose are 0'),
    (9, 'import_poses "EM run-1.txt" --reference ot.txt >', 'EM run-1 is called EM_run_1'),
    (9, 'import_poses 2025-03-04.txt --reference ot.txt >', 'sensor_2025_03_04: 1200 poses'),
    (12, '- import json.mcap >', JSON),
    (13, 'pivot cut.mcap', f'{CUT} 163054 of 168846 bytes (EndOfFile)'),
    (13, 'accuracy rest restcut.mcap', CUT),
    (13, 'export cut.mcap --out e', f'{CUT} 163054 of 168846 bytes (EndOfFile)'),
    *((14, f'pivot {name}', AGREE) for name in (
        'semi_comma.csv', 'semicolon.csv', 'tab.tsv', 'utf16.csv', 'quoted_title.csv')),
    *((14, f'import {name}.yaml >', ROWS)
      for name in ('semicomma', 'upper', 'units', 'title', 'blanktail', 'trail')),
    (14, '- import missing.yaml >', "missing.csv: line 12: x is 'MISSING'"),
    *((14, f'accuracy point-to-point p2p.csv --truth {name}.csv', '6 points')
      for name in ('ph_space', 'ph_semi_comma', 'ph_up', 'ph_blank')),
    (15, '- handeye em.txt --reference ot_tz.txt', f'{EM} 7200.0 s later'),
    (15, '- handeye em.txt --reference ot_boot.txt', f'{EM} 1759914000.0 s earlier'),
    (15, 'handeye em.txt --reference ot_step.txt',
     'the clock of optical steps by 0.4 s at 30.0 s'),
    (16, 'pivot transform.mcap', '299 of 300 poses agree'),
    (16, 'export transform.mcap --out e', 'pen'),
    (16, '- import json_lc.mcap >', '300 messages of /ndi/pen/pose are JSON'),
    (17, 'import cutdb >', COUNTED),
    *((17, f'import {name} >', f'metadata.yaml cannot be read|{READ}')
      for name in ('emptymeta', 'nulmeta')),
    (17, 'import missfile >', f'bag_1.db3 of the bag is missing|{READ}'),
    (17, '- import zcutm >', 'bag_0.mcap.zstd: cannot be unpacked: it breaks off'),
    (18, 'import q0.yaml >', '/tracked/pen/pose: 59 messages|1 pose'),
]  # fmt: skip


@pytest.fixture
def there(request, tmp_path, monkeypatch):
    """Stand in a copy of a report's folder."""
    for entry in FOLDER.glob(f'{request.param:02}_*/*'):
        copy = tmp_path / entry.name
        shutil.copytree(entry, copy) if entry.is_dir() else shutil.copyfile(entry, copy)
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(('there', 'commands', 'words'), PLAYED, indirect=['there'])
def test_reports(there, commands, words, capsys):
    code, said = 0, ''
    for command in commands.removeprefix('- ').split('; '):
        if command.startswith('='):
            said = next(Path(command[1:]).iterdir()).read_text().splitlines()[1]
            continue
        code = main(shlex.split(command.replace('>', '--out x.mcap')))
        out, err = capsys.readouterr()
        said = out + err
        assert code == 0 or len(err.strip().splitlines()) == 1, said
    assert code == (2 if commands[0] == '-' else 0), said
    assert all(word in said for word in words.split('|')), said
    assert code == 0 or not Path('x.mcap').exists()


@pytest.mark.parametrize('there', [19], indirect=True)
def test_a_terminal_without_unicode(there, monkeypatch):
    """As Python opens the standard output where the locale says ASCII."""
    raw = io.BytesIO()
    monkeypatch.setattr(sys, 'stdout', io.TextIOWrapper(raw, encoding='ascii'))
    assert main(['handeye', 'em.txt', '--reference', 'ot.txt', '--out', 'h']) == 0
    sys.stdout.flush()
    assert b'tracked stamps are 0.2 ? 0.2 ms' in raw.getvalue()
