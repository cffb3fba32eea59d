"""The SROS2 policy is what the nodes really have on the graph."""

import os
import re
import subprocess
import sys

import pytest
from conftest import REPO

from anser_ros.cli.commands import COMPOSED, NODES


def test_every_node_of_an_installation_has_an_enclave_and_the_page_names_it():
    policy = (REPO / 'config' / 'sros2_policy.xml').read_text(encoding='utf-8')
    wanted = {*NODES, *COMPOSED} - {'cu_simulator', 'grid', 'replay'}
    assert set(re.findall('enclave path="/anser/(.*)"', policy)) == wanted
    (loop,) = re.findall('for node in (.*); do', (REPO / 'docs' / 'security.md').read_text())
    assert set(loop.split()) == wanted


@pytest.mark.processes
def test_the_policy_is_that_of_the_nodes(domain):
    """After a change of a node's topics or services, run `.ci/write_policy.py`."""
    pytest.importorskip('nicegui', reason='nicegui is not installed')
    command = [sys.executable, str(REPO / '.ci' / 'write_policy.py'), 'demo_setup.yaml']
    own = {**os.environ, 'ROS_DOMAIN_ID': str(domain)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=own)
    assert done.returncode == 0, done.stderr
    assert done.stdout == (REPO / 'config' / 'sros2_policy.xml').read_text(encoding='utf-8')
