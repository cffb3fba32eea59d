"""The SROS2 policy is what the nodes really have on the graph, and servers listen to this host."""

import importlib.util

import pytest
from conftest import REPO

from anser_ros.nodes.openigtlink import OpenIGTLinkParameters


def test_servers_listen_to_this_host_only():
    assert OpenIGTLinkParameters.host == '127.0.0.1'


@pytest.mark.processes
def test_the_policy_is_that_of_the_nodes(ros):
    """After a change of a node's topics or services, run `.ci/write_policy.py`."""
    spec = importlib.util.spec_from_file_location('policy', REPO / '.ci' / 'write_policy.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.policy() == module.POLICY.read_text(encoding='utf-8')
