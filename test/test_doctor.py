"""`anser doctor` finds what is not there, and names a remedy for it."""

import errno
import json
import os
import struct
from unittest import mock

import pytest

from anser_ros.cli import doctor
from anser_ros.cli.main import main


def test_a_package_that_is_missing_has_a_remedy():
    gone = ('mcap_ros2', 'yaml', 'nicegui')
    found = {f.name: f for f in doctor.packages(lambda name: name not in gone)}
    assert found['mcap-ros2-support'].remedy == 'pip install mcap-ros2-support'
    assert found['PyYAML'].state == doctor.BAD
    assert found['nicegui'].state == doctor.NOTE, 'only the live view needs it'
    assert found['numpy'].state == doctor.GOOD and found['numpy'].found[0].isdigit()


def test_ports_that_are_missing_or_closed(tmp_path, monkeypatch):
    pattern = (str(tmp_path / 'tty*'),)
    (none,) = doctor.ports(None, pattern)
    assert none.state == doctor.NOTE and 'simulate' in none.remedy
    main_end, port = os.openpty()
    (tmp_path / 'ttyACM0').symlink_to(os.ttyname(port))
    (tmp_path / 'ttyACM1').touch()
    closed = str(tmp_path / 'ttyACM1')
    monkeypatch.setattr(doctor.os, 'access', lambda name, _mode: name != closed)
    first, second = doctor.ports(None, pattern)
    assert (first.state, second.state) == (doctor.GOOD, doctor.BAD)
    assert 'chmod a+rw' in second.remedy, 'the group may not read and write it either'
    (tmp_path / 'ttyACM1').chmod(0o660)
    monkeypatch.setattr(doctor.grp, 'getgrgid', lambda _: mock.Mock(gr_name='dialout'))
    assert 'usermod -aG dialout' in doctor.ports(None, pattern)[1].remedy
    assert doctor.ports(str(tmp_path / 'ttyX'))[0].state == doctor.BAD
    for name in ('/dev/null', str(tmp_path), str(tmp_path / 'ttyACM2')):
        (tmp_path / 'ttyACM2').touch()
        (other,) = doctor.ports(name)
        assert (other.state, other.found) == (doctor.BAD, 'is not a serial port') and other.remedy
    for code, state in ((errno.EBUSY, doctor.NOTE), (errno.EIO, doctor.BAD)):
        failure = OSError(code, os.strerror(code))
        monkeypatch.setattr(doctor.os, 'open', mock.Mock(side_effect=failure))
        (other,) = doctor.ports(os.ttyname(port))
        assert other.state == state and other.remedy
    os.close(main_end)
    os.close(port)


def test_the_clock(monkeypatch):
    for state, error_us, is_kept in (
        (0, 500, True), (5, 15_999_999, True), (5, 16_000_000, False), (-1, 0, None)
    ):  # fmt: skip

        def stated(record, state=state, error_us=error_us):
            struct.pack_into('@Illl', record, 0, 0, 0, 0, error_us)
            return state

        kernel = mock.Mock(adjtimex=stated)
        monkeypatch.setattr(doctor.ctypes, 'CDLL', lambda _, kernel=kernel: kernel)
        (found,) = doctor.clock()
        assert found.state == (doctor.GOOD if is_kept else doctor.NOTE)
        assert bool(found.remedy) == (is_kept is False)


def test_a_domain_that_does_not_work_is_named(monkeypatch):
    for text, states in (
        ('0', []), ('101', []), ('150', [doctor.NOTE]), ('233', [doctor.BAD]),
        ('-1', [doctor.BAD]), ('one', [doctor.BAD]),
    ):  # fmt: skip
        monkeypatch.setenv('ROS_DOMAIN_ID', text)
        found = doctor.domain()
        assert [one.state for one in found] == states
        assert all(one.remedy for one in found)
    assert doctor.graph(0.1) == [], 'it is said once'


@pytest.mark.processes
@pytest.mark.parametrize(
    ('broken', 'remedy'),
    [
        ({'RMW_IMPLEMENTATION': 'rmw_nobody'}, 'unset RMW_IMPLEMENTATION'),
        ({'PYTHONPATH': 'here'}, 'source /opt/ros'),
    ],
)
def test_a_ros_that_does_not_start_has_a_remedy(tmp_path, monkeypatch, domain, broken, remedy):
    (tmp_path / 'here').mkdir()
    (tmp_path / 'here' / 'rclpy.py').write_text('raise ImportError("no rclpy")\n')
    monkeypatch.chdir(tmp_path)
    for name, value in broken.items():
        monkeypatch.setenv(name, value)
    (found,) = doctor.graph(0.1)
    assert found.state == doctor.BAD and remedy in found.remedy
    assert not found.found.startswith('[')


def test_a_full_disk(tmp_path, monkeypatch):
    for least, state in ((0, doctor.GOOD), (2**62, doctor.BAD)):
        monkeypatch.setattr(doctor, 'LEAST_FREE_BYTES', least)
        assert doctor.disk(tmp_path)[0].state == state


def test_the_graph():
    told = {
        'middleware': 'rmw_fastrtps_cpp', 'nodes': ['/anser/tracker', '/anser/tracker', '/rviz'],
        'twice': ['/anser/tracker'], 'topics': 9,
        'complaints': {'anser/field_model': 'references_lost: no fluxes'},
    }  # fmt: skip
    found = doctor.graph_findings(told)
    assert {one.name: one.state for one in found} == {
        'ROS': doctor.GOOD, '/anser/tracker': doctor.BAD, 'graph': doctor.GOOD,
        'anser/field_model': doctor.NOTE,
    }  # fmt: skip
    assert '3 nodes, 2 of them from anser_ros' in found[2].found


@pytest.mark.processes
def test_the_whole_on_this_machine(capsys, domain):
    code = main(['doctor', '--json', '--seconds', '0.3'])
    document = json.loads(capsys.readouterr().out)
    assert document['schema'] == doctor.SCHEMA
    found = {one['name']: one for one in document['findings']}
    assert {'Python', 'kernels', 'disk', 'ROS', 'graph', 'mcap'} <= set(found)
    assert found['ROS']['state'] == doctor.GOOD, found['ROS']
    assert code == (2 if document['problems'] else 0)


def test_a_look_that_is_no_time_is_refused(capsys):
    for seconds in ('nan', '-1', '0', '1e9'):
        assert main(['doctor', '--seconds', seconds]) == 2
        assert '--seconds must be above 0 and at most 60' in capsys.readouterr().err
