"""Several sessions in one command or one file: folders, the summary, failures as rows, pauses."""

import argparse
import contextlib
import csv
import io
import math
from dataclasses import replace

import numpy as np
import pytest
from pose_world import World, named

from anser_ros.apps.poses.diagnosis import diagnose_poses
from anser_ros.apps.poses.importing import write_pose_session
from anser_ros.cli.main import EXIT_BAD_INPUT, EXIT_DEFECT, EXIT_OK, main
from anser_ros.cli.sessions import Outcome, names_of, on_each, row_of, write_summary
from anser_ros.errors import BagError, ParameterError

pytestmark = pytest.mark.long


@pytest.fixture(scope='module')
def sessions(tmp_path_factory):
    """Two sessions of poses, and a file that is none."""
    folder = tmp_path_factory.mktemp('sessions')
    for seed in (1, 2):
        world = World(seed, duration=8.0, sensors=1)
        write_pose_session(folder / f'day_{seed}.mcap', world.session())
    (folder / 'broken.mcap').write_text('no bag')
    return [str(folder / name) for name in ('day_1.mcap', 'broken.mcap', 'day_2.mcap')]


def read(path):
    with path.open(newline='') as stream:
        return list(csv.DictReader(stream))


def check(folder, sessions):
    """One row a session, in the order given, the broken one with its line."""
    rows = read(folder / 'summary.csv')
    assert [row['session'] for row in rows] == sessions
    assert [row['status'] for row in rows] == ['ok', 'failed', 'ok']
    assert rows[1]['message'].endswith('broken.mcap: not an MCAP file')
    for row in (rows[0], rows[2]):
        assert 0 < float(row['position_rmse_m']) < 1e-3
        assert (folder / row['name'] / 'evaluation.json').is_file()
    return rows


@pytest.fixture(scope='module')
def alone(sessions, tmp_path_factory):
    """All sessions by `evaluate`, one after the other: the folder, and what was said."""
    folder = tmp_path_factory.mktemp('alone')
    out, said = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(said):
        code = main(['evaluate', *sessions, '--poses', '--out', str(folder)])
    assert code == EXIT_BAD_INPUT
    return folder, out.getvalue(), said.getvalue()


def test_several_sessions_of_evaluate_are_a_table_with_their_failures(sessions, alone):
    folder, out, said = alone
    check(folder, sessions)
    assert 'anser evaluate: 1 of 3 sessions failed' in said
    assert max(map(len, out.split('wrote')[0].splitlines())) <= 80
    page = (folder / 'summary.html').read_text()
    assert 'not an MCAP file' in page and page.count('<tr>') == 4


def test_names_tell_sessions_apart(tmp_path):
    for day in ('mon', 'tue'):
        (tmp_path / day / 'scan').mkdir(parents=True)
    bags = [str(tmp_path / day / 'scan.mcap') for day in ('mon', 'tue')]
    assert names_of([*bags, 'other.mcap']) == ['mon-scan', 'tue-scan', 'other']
    folders = [str(tmp_path / 'mon' / 'scan'), bags[0], bags[1]]
    assert len(set(names_of(folders))) == 3
    with pytest.raises(ParameterError, match='given twice'):
        names_of([bags[0], bags[0]])


def test_a_defect_of_one_session_is_its_row_with_the_traceback(tmp_path):
    def work(args, tell):
        if args.session == 'bad':
            raise BagError('bad: no bag')
        raise ZeroDivisionError('of mine')

    args = argparse.Namespace(sessions=['bad', 'worse'], out=tmp_path, poses=False)
    result = on_each('evaluate', work, args, lambda *_: None)
    bad, worse = result.document['sessions']
    assert bad['message'] == 'bad: no bag' and result.code == EXIT_DEFECT
    assert 'ZeroDivisionError: of mine' in worse['message'] and '\n' not in worse['message']
    (trace,) = (note for note in result.notes if 'Traceback' in note)
    assert trace.startswith('worse:\nTraceback')


def test_a_row_is_the_pooled_error_of_all_coils(tmp_path):
    def figures(n, share, root):
        return {
            'n': n, 'tracked_fraction': share, 'position_rmse_m': root,
            'orientation_rmse_rad': None if root is None else 2 * root,
        }  # fmt: skip

    sensors = {'a': figures(30, 1.0, 1e-3), 'b': figures(10, 0.5, 3e-3), 'c': figures(0, 0, None)}
    document = {'sensors': sensors, 'bodies': {}}
    row = row_of('evaluate', Outcome('one', 'one.mcap', EXIT_OK, document, '<lost> a frame'))
    assert row['position_rmse_m'] == pytest.approx(math.sqrt((30 * 1e-6 + 10 * 9e-6) / 40))
    assert row['worst_position_rmse_m'] == 3e-3 and row['tracked_fraction'] == 0.5
    assert row['n'] == 40 and row['body_position_rmse_m'] is None
    write_summary(tmp_path, 'evaluate', [row])
    assert '&lt;lost&gt;' in (tmp_path / 'summary.html').read_text()
    (cells,) = read(tmp_path / 'summary.csv')
    assert cells['body_position_rmse_m'] == '' and cells['message'] == '<lost> a frame'


def test_a_long_pause_between_two_recordings_leaves_most_blocks_of_time_with_poses():
    world = World(17, duration=300.0, sensors=2)
    world.offset = 0.04

    def two_recordings(streams):
        return {
            name: [one[np.abs(rows[0] - 150) > 138] for one in rows]
            for name, rows in streams.items()
        }

    world.after = two_recordings
    found = diagnose_poses(world.session())
    assert {one.name for one in found.records} == {'time_offset', 'hand_eye'}
    assert np.unique(found.fit.state.parts[0].blocks).size > 12
    assert found.after.position_m < 1e-3


def only_when(session, keep):
    """The poses of all streams at some times."""
    sensors = {name: poses.rows(keep(poses.time)) for name, poses in session.sensors.items()}
    reference = session.reference.rows(keep(session.reference.time))
    return replace(session, sensors=sensors, reference=reference)


def test_a_pause_of_all_streams_lies_between_recordings():
    session = World(2, duration=60.0).session()
    paused = only_when(session, lambda time: (time < 16) | (time > 40))
    assert not named(diagnose_poses(paused))
    lost = replace(session, reference=paused.reference)
    assert set(named(diagnose_poses(lost))) == {'missing_poses'}


@pytest.mark.parametrize('duration', [1500.0, 3000.0])  # apart so little, motions are half alike
def test_clocks_that_run_apart_over_several_recordings_have_a_rate(duration):
    world = World(4, duration=duration, sensors=1, rate=8.0)
    world.rate_ppm = 300.0
    found = named(diagnose_poses(only_when(world.session(), lambda time: time % 300 < 25)))
    assert set(found) == {'clock_rate'}
    assert found['clock_rate'].parameters['rate_ppm'] == pytest.approx(300, abs=1)
