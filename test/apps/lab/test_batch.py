"""Many sessions in one command: folders, the summary, failures as rows, and workers that die."""

import argparse
import contextlib
import csv
import importlib
import io
import math
import os
import signal
import threading

import pytest
from conftest import wait
from pose_world import World

from anser_ros.apps.lab.cli import batch
from anser_ros.apps.poses.importing import write_pose_session
from anser_ros.cli.main import EXIT_BAD_INPUT, EXIT_DEFECT, EXIT_OK, main
from anser_ros.cli.sessions import Outcome, names_of, perform, row_of, runs_of, write_summary
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


@pytest.mark.processes
def test_a_worker_that_dies_loses_nothing(sessions, alone, tmp_path, capfd):
    """The only worker of a cluster is killed in the midst of its first session."""
    from distributed import LocalCluster

    done = []
    with LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address='127.0.0.1:0'
    ) as cluster:
        arguments = ['batch', 'evaluate', *sessions, '--poses', '--out', str(tmp_path)]
        arguments += ['--scheduler', cluster.scheduler_address]
        batch = threading.Thread(target=lambda: done.append(main(arguments)))
        batch.start()
        first = cluster.workers[0].pid
        workers = cluster.scheduler.workers
        assert wait(lambda: any(one.processing for one in workers.values()))
        os.kill(first, signal.SIGKILL)
        batch.join()
        assert cluster.workers[0].pid != first
    assert done == [EXIT_BAD_INPUT]
    rows = check(tmp_path, sessions)
    for row, other in zip(rows, read(alone[0] / 'summary.csv'), strict=True):
        assert {**row, 'seconds': 0} == {**other, 'seconds': 0}
    capfd.readouterr()


def test_a_scheduler_that_is_not_there_is_one_line(sessions, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(batch, 'CONNECT_S', 0.2)
    arguments = ['--poses', '--out', str(tmp_path), '--scheduler', 'tcp://127.0.0.1:1']
    assert main(['batch', 'evaluate', sessions[0], *arguments]) == EXIT_BAD_INPUT
    said = capsys.readouterr().err
    assert said.startswith('anser batch: no Dask scheduler at tcp://127.0.0.1:1')
    assert said.count('\n') == 1


def test_names_tell_sessions_apart(tmp_path):
    for day in ('mon', 'tue'):
        (tmp_path / day / 'scan').mkdir(parents=True)
    bags = [str(tmp_path / day / 'scan.mcap') for day in ('mon', 'tue')]
    assert names_of([*bags, 'other.mcap']) == ['mon-scan', 'tue-scan', 'other']
    folders = [str(tmp_path / 'mon' / 'scan'), bags[0], bags[1]]
    assert len(set(names_of(folders))) == 3
    with pytest.raises(ParameterError, match='given twice'):
        names_of([bags[0], bags[0]])


class Module:
    """A command that does as its session says."""

    @staticmethod
    def work(args, tell):
        if args.session == 'bad':
            raise BagError('bad: no bag')
        raise ZeroDivisionError('of mine')


def test_a_defect_of_one_session_is_its_row_with_the_traceback(monkeypatch, tmp_path):
    monkeypatch.setattr(importlib, 'import_module', lambda name: Module)
    args = argparse.Namespace(sessions=['bad', 'worse'], out=tmp_path)
    bad, worse = (perform(run) for run in runs_of('evaluate', args))
    assert (bad.code, bad.words, bad.traceback) == (EXIT_BAD_INPUT, 'bad: no bag', '')
    assert worse.code == EXIT_DEFECT and 'ZeroDivisionError: of mine' in worse.words
    assert worse.traceback.startswith('Traceback') and worse.words.count('\n') == 0


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
