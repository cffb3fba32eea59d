"""`anser doctor` finds what is not there, and names a remedy for it."""

import json
import os

import pytest

from anser_ros.cli import doctor
from anser_ros.cli.main import main


def states(findings):
    return {finding.name: finding.state for finding in findings}


def test_a_package_that_is_missing_has_a_remedy():
    found = {
        f.name: f
        for f in doctor.packages(lambda name: name not in ('mcap_ros2', 'yaml', 'nicegui'))
    }
    assert found['mcap-ros2-support'].remedy == 'pip install mcap-ros2-support'
    assert found['PyYAML'].state == doctor.BAD
    assert found['nicegui'].state == doctor.NOTE, 'only the live view needs it'
    assert found['numpy'].state == doctor.GOOD and found['numpy'].found[0].isdigit()


def test_ports_that_are_missing_or_closed(tmp_path, monkeypatch):
    pattern = (str(tmp_path / 'tty*'),)
    (none,) = doctor.ports(None, pattern)
    assert none.state == doctor.NOTE and 'simulate' in none.remedy
    (tmp_path / 'ttyACM0').touch()
    (tmp_path / 'ttyACM1').touch()
    closed = str(tmp_path / 'ttyACM1')
    monkeypatch.setattr(doctor.os, 'access', lambda name, _mode: name != closed)
    first, second = doctor.ports(None, pattern)
    assert (first.state, second.state) == (doctor.GOOD, doctor.BAD)
    assert 'dialout' in second.remedy
    assert doctor.ports(str(tmp_path / 'ttyX'))[0].state == doctor.BAD


@pytest.mark.processes
@pytest.mark.parametrize(
    ('said', 'state'), [('yes', doctor.GOOD), ('no', doctor.NOTE), ('', doctor.NOTE)]
)
def test_the_clock(tmp_path, monkeypatch, said, state):
    tool = tmp_path / 'timedatectl'
    tool.write_text(f'#!/bin/sh\necho {said}\n')
    tool.chmod(0o755)
    monkeypatch.setenv('PATH', f'{tmp_path}:{os.environ["PATH"]}')
    assert doctor.clock()[0].state == state
    assert doctor.clock('no_such_tool')[0].state == doctor.NOTE


def test_a_full_disk(tmp_path):
    assert doctor.disk(tmp_path, least=0)[0].state == doctor.GOOD
    assert doctor.disk(tmp_path, least=2**62)[0].state == doctor.BAD


def test_the_graph():
    told = {
        'middleware': 'rmw_fastrtps_cpp', 'nodes': ['/anser/tracker', '/anser/tracker', '/rviz'],
        'twice': ['/anser/tracker'], 'topics': 9,
        'complaints': {'anser/field_model': 'references_lost: no fluxes'},
    }  # fmt: skip
    found = doctor.graph_findings(told)
    assert states(found) == {
        'ROS': doctor.GOOD, '/anser/tracker': doctor.BAD, 'graph': doctor.GOOD,
        'anser/field_model': doctor.NOTE,
    }  # fmt: skip
    assert '3 nodes, 2 of them ours' in found[2].found


@pytest.mark.processes
def test_the_whole_on_this_machine(capsys, domain):
    code = main(['doctor', '--json', '--seconds', '0.3'])
    document = json.loads(capsys.readouterr().out)
    assert document['schema'] == doctor.SCHEMA
    found = {one['name']: one for one in document['findings']}
    assert {'Python', 'kernels', 'disk', 'ROS', 'graph', 'mcap'} <= set(found)
    assert found['ROS']['state'] == doctor.GOOD, found['ROS']
    assert code == (2 if document['problems'] else 0)


@pytest.mark.parametrize('seconds', ['nan', '-1', '0', '1e9'])
def test_a_look_that_is_no_time_is_refused(capsys, seconds):
    assert main(['doctor', '--seconds', seconds]) == 2
    assert '--seconds must lie in 0 .. 60' in capsys.readouterr().err
