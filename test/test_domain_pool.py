"""ROS domains of test runs that run at the same time."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from domain_pool import MOST_DOMAINS, DomainPool


def test_runs_at_the_same_time_never_share_a_domain(tmp_path):
    one, other = DomainPool(tmp_path, range(1, 41)), DomainPool(tmp_path, range(1, 41))
    pairs = [(one.take(), other.take()) for _ in range(MOST_DOMAINS)]
    ours, theirs = ({pair[i] for pair in pairs} for i in range(2))
    assert len(ours) == len(theirs) == MOST_DOMAINS
    assert not ours & theirs
    third = DomainPool(tmp_path, range(1, 41))
    with pytest.raises(RuntimeError, match='taken by other runs'):
        third.take()
    one.close()
    assert DomainPool(tmp_path, range(1, 41)).take() in ours


@pytest.mark.processes
def test_a_killed_run_gives_its_domains_back(tmp_path):
    script = (
        'import sys, time; from pathlib import Path; from domain_pool import DomainPool\n'
        'pool = DomainPool(Path(sys.argv[1]), [7])\n'
        'print(pool.take(), flush=True); time.sleep(600)'
    )
    run = subprocess.Popen(
        [sys.executable, '-c', script, str(tmp_path)],
        stdout=subprocess.PIPE,
        cwd=Path(__file__).parent,
    )
    try:
        assert run.stdout.readline() == b'7\n'
        with pytest.raises(RuntimeError):
            DomainPool(tmp_path, [7]).take()
    finally:
        run.send_signal(signal.SIGKILL)
        run.communicate()
    assert DomainPool(tmp_path, [7]).take() == 7
