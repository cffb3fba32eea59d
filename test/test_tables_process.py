"""The tables of a refit are made by a process of its own, which ends with who has started it."""

import threading
import time

import numpy as np
import pytest
from refit_rig import setup_text
from refit_world import anser_world

from anser_ros.nodes.field_model_parts.kept_files import KeptTables
from anser_ros.nodes.field_model_parts.refit_start import RefitStart
from anser_ros.nodes.field_model_parts.tables_process import TablesProcess
from anser_ros.wire.setup import parse_setup

pytestmark = pytest.mark.processes


@pytest.fixture(scope='module')
def given():
    world = anser_world()
    return parse_setup(setup_text(world)), world.model, world.references


def test_another_process_keeps_the_tables_and_tells_its_share(tmp_path, given):
    shares = []
    start = RefitStart(*given, (), tmp_path)
    start._report = shares.append
    start.begin(np.zeros((len(given[2]), 8), complex), is_awaited=False)
    start.wait()
    assert start.taken() is not None
    assert len(set(shares)) > 10 and shares == sorted(shares)
    assert KeptTables(tmp_path, *given).read() is not None
    assert [file.name[:7] for file in tmp_path.iterdir()] == ['refit_t']


def test_tables_are_not_kept_where_nothing_can_be_written(tmp_path, given):
    (tmp_path / 'file').write_bytes(b'')
    assert not TablesProcess().run((tmp_path / 'file', *given), lambda share: None)


def test_the_process_ends_with_the_refit_that_nobody_wants(tmp_path, given):
    start = RefitStart(*given, (), tmp_path)
    start.prepare()
    while not start._share:
        time.sleep(0.01)
    process = start._process._process
    assert process.poll() is None and start.end(5.0)
    assert process.wait(5.0) != 0 and not list(tmp_path.iterdir())


def test_the_process_ends_with_its_parent(tmp_path, given):
    runner, done = TablesProcess(), []
    thread = threading.Thread(
        target=lambda: done.append(runner.run((tmp_path, *given), lambda share: None))
    )
    thread.start()
    while runner._process is None:
        time.sleep(0.01)
    time.sleep(0.2)
    runner._process.stdin.close()  # as the system does when the parent is gone
    thread.join(20.0)
    assert done == [False] and not list(tmp_path.iterdir())
