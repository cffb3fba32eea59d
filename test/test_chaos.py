"""The standing trial: its line damages what it should and nothing else; a sample of it runs."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import REPO, skip_if_too_slow

from anser_ros.wire.frames import SampleBlock, encode
from anser_ros.wire.protocols import FrameReader

CHAOS = Path(__file__).resolve().parent / 'chaos'
SAMPLE = ('torn', 'unplugged', 'ring')
"""One that costs frames, one that costs the connection, a unit that repeats its samples."""


@pytest.fixture(scope='module', autouse=True)
def chaos():
    """The trial's modules import one another by their names."""
    sys.path.insert(0, str(CHAOS))
    yield
    sys.path.remove(str(CHAOS))


def records(count=20, columns=42):
    rng = np.random.default_rng(3)
    blocks = [
        SampleBlock(i, 2000 * i, rng.integers(-999, 999, (40, columns)).astype(np.int16))
        for i in range(count)
    ]
    return blocks, [encode(block) for block in blocks]


def read(data):
    return [record.payload for record in FrameReader().feed(b''.join(data))]


def test_every_fault_has_a_name_of_its_own():
    from faults_files import COMMANDS
    from recorded import RECORDED
    from run import GROUPS

    names = [fault.name for group in GROUPS.values() for fault in group]
    names += [one.name for one in (*COMMANDS, *RECORDED)]
    assert len(names) == len(set(names)) > 90
    assert not {'+', ' '} & set(''.join(names))


def test_a_tamper_changes_its_columns_and_keeps_records_whole():
    import tampers

    blocks, given = records()
    out = read(tampers.gain(2.0, [4])(given, 0.0))
    for was, now in zip(blocks, out, strict=True):
        assert (now.codes[:, 4] == 2 * was.codes[:, 4]).all()
        assert (np.delete(now.codes, 4, 1) == np.delete(was.codes, 4, 1)).all()
        assert (now.sequence, now.timestamp_ticks) == (was.sequence, was.timestamp_ticks)
    ring = read(tampers.ring(80)(given, 0.0))
    assert (ring[2].codes == blocks[0].codes).all() and ring[2].sequence == 2
    swapped = read(tampers.swapped(0, 7)(given, 0.0))
    assert (swapped[3].codes[:, 7] == blocks[3].codes[:, 0]).all()
    assert replace(swapped[0], codes=blocks[0].codes) != blocks[1]


def test_the_line_cuts_records_wherever_bytes_end(tmp_path):
    from line import Line

    _, given = records(5)
    line = Line(tmp_path / 'absent', tmp_path / 'host')
    try:
        data, out = b''.join(given), []
        for start in range(0, len(data), 777):
            out += line._cut(data[start : start + 777])
        assert out == given
    finally:
        line.close()


def test_a_random_combination_is_the_same_for_the_same_seed():
    from run import combinations

    names = [[fault.name for fault in some] for some in combinations(7, 5)]
    assert names == [[fault.name for fault in some] for some in combinations(7, 5)]
    assert names != [[fault.name for fault in some] for some in combinations(8, 5)]
    assert all(2 <= len(set(some)) <= 3 for some in names)


def test_what_a_busy_machine_hides_is_no_pass():
    from table import Row

    good = Row('g', 'n', 'what', 'said', 0.1, 400, 0, None, None, 0.5)
    assert good.verdict(1.0) == 'ok'
    assert replace(good, skipped=900).verdict(1.0) == 'BUSY'
    assert replace(good, skipped=900, back_s=None).verdict(1.0) == 'BUSY'
    assert replace(good, skipped=900, wrong=1).verdict(1.0) == 'FAILED'
    for change in ({'back_s': None}, {'back_s': 1.5}, {'wrong': 1}, {'crashed': ('node',)}):
        assert replace(good, **change).verdict(1.0) == 'FAILED'


def test_rows_are_read_as_they_were_written(tmp_path):
    from table import Row, load, save

    rows = [
        Row('g', 'n', 'what', 'said', None, 4, 1, 0.01, 1e-4, None, ('node: end',), 3, ('a', 'b')),
        Row('g', 'm', 'what', '', 0.1, 400, 0, None, None, 0.5),
    ]
    save(tmp_path / 'chaos.json', rows)
    assert load(tmp_path / 'chaos.json') == rows


def test_a_part_of_the_trial_keeps_the_rows_of_the_others(tmp_path, monkeypatch):
    import run
    from table import Row, load, save

    out, old = (
        tmp_path / 'chaos.json',
        Row('serial', 'torn', 'what', '', None, 4, 0, None, None, 0.1),
    )
    new = replace(old, group='files', name='bag-empty')
    save(out, [old, replace(new, poses=3)])
    monkeypatch.setattr(run, 'commanded', lambda command: new)
    arguments = ['--only', 'bag-empty', '--keep', '--out', str(out)]
    monkeypatch.setattr(sys, 'argv', ['run.py', *arguments])
    assert run.main() == 0
    assert load(out) == [new, old]


def test_growth_is_a_trend_and_no_step():
    from soak import Series

    rng = np.random.default_rng(5)
    for hourly_mb in (0.0, 20.0):
        series = Series()
        for second in range(600):
            step = 2.0 if second > 560 else 0.0  # an allocator takes a piece, once
            memory = 200.0 + hourly_mb * second / 3600.0 + step + 0.01 * rng.standard_normal()
            series.rows.append((float(second), memory, 12, 9))
        growth, error = series.hourly(1)
        assert abs(growth - hourly_mb) < max(1.0, 4.0 * error)
        assert series.hourly(2)[0] == 0.0


def test_the_page_of_faults_has_the_kept_result(tmp_path):
    from table import load, write_docs

    page = (REPO / 'docs' / 'faults.md').read_text()
    seed, rate_hz = re.search(r'ARGS=--write-docs` \(seed (\d+), (\S+) Hz\)', page).groups()
    rows = load(REPO / 'docs' / 'results' / 'chaos.json')
    copy = tmp_path / 'faults.md'
    copy.write_text(page)
    write_docs(copy, rows, int(seed), float(rate_hz))
    assert copy.read_text() == page
    poses, wrong = sum(row.poses for row in rows), sum(row.wrong for row in rows)
    words = f'{wrong or "none"} of {poses:,} poses'
    for said in (page, (REPO / 'README.md').read_text()):
        assert words in ' '.join(said.split())


@pytest.mark.processes
@pytest.mark.timeout(900)
def test_a_sample_of_the_trial_passes(tmp_path):
    out = tmp_path / 'rows.json'
    command = [sys.executable, str(CHAOS / 'run.py'), '--only', *SAMPLE, '--duration', '1.0']
    environment = {k: v for k, v in os.environ.items() if k != 'ROS_DOMAIN_ID'}
    done = subprocess.run(
        [*command, '--out', str(out)],
        capture_output=True, text=True, timeout=850, check=False, env=environment,
    )  # fmt: skip
    rows = {row['name']: row for row in json.loads(out.read_text())}
    assert set(rows) == set(SAMPLE), done.stderr
    assert all(row['wrong'] == 0 and not row['crashed'] for row in rows.values()), done.stdout
    assert any('unplug' in words for words in rows['unplugged']['heard'])
    if not all(row['poses'] + row['skipped'] for row in rows.values()):
        skip_if_too_slow(done.stdout)
        pytest.fail(done.stdout)
