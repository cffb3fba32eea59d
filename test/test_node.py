"""The base of the nodes: parameter tables, diagnostics, guarded callbacks, start and end."""

import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest
from conftest import Process, spin_until, wait
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from std_msgs.msg import String
from std_srvs.srv import Trigger

from anser_ros.apps.dashboard.nodes.view_source import Polled, polling_node
from anser_ros.errors import ParameterError, SetupError
from anser_ros.nodes.runtime import parameters, qos
from anser_ros.nodes.runtime import process as processes
from anser_ros.nodes.runtime.diagnostics import MOST_KINDS, Throttle
from anser_ros.nodes.runtime.node import AnserNode, Level, Status
from anser_ros.nodes.runtime.parameters import complaints, parameter
from anser_ros.parallel import ONE_THREAD
from anser_ros.wire.setup import parse_setup
from anser_ros.wire.text_files import read_config

pytestmark = pytest.mark.light


@dataclass(frozen=True)
class Table:
    rate_hz: float = parameter(25.0, 'rate', within=(1.0, 100.0), live=True)
    depth: int = parameter(3, 'depth', within=(0, math.inf))
    mode: str = parameter('fast', 'mode', choices=('fast', 'slow'))
    names: tuple[str, ...] = parameter((), 'names')
    centre_m: tuple[float, ...] = parameter((0.0, 0.0, 0.2), 'centre', within=(-1.0, math.inf))
    loud: bool = parameter(False, 'loud')


class TestParameterTable:
    def test_defaults_and_given_values(self):
        built = parameters.build(Table, {'rate_hz': 50, 'centre_m': [0, 0, 1], 'names': ['a']})
        assert built == Table(rate_hz=50.0, centre_m=(0.0, 0.0, 1.0), names=('a',))
        assert isinstance(built.rate_hz, float)

    @pytest.mark.parametrize(
        ('values', 'said'),
        [
            ({'rate': 1.0}, 'no parameter rate; there are: rate_hz'),
            ({'rate_hz': 0.5}, 'below 1.0'),
            ({'rate_hz': 200.0}, 'above 100.0'),
            ({'rate_hz': float('nan')}, 'not a number'),
            ({'rate_hz': 'ten'}, "'ten' is not a float"),
            ({'rate_hz': True}, 'True is not a float'),
            ({'depth': 1.5}, '1.5 is not a int'),
            ({'depth': True}, 'True is not a int'),
            ({'loud': 1}, '1 is not a bool'),
            ({'mode': 'other'}, "none of 'fast', 'slow'"),
            ({'names': 'abc'}, 'is not a list'),
            ({'names': 3}, 'is not a list'),
            ({'centre_m': [0.0, -2.0]}, 'below -1.0'),
        ],
    )
    def test_refusals(self, values, said):
        with pytest.raises(ParameterError, match=said):
            parameters.build(Table, values)

    def test_a_file_is_found_in_config_too_and_an_error_states_the_parameter(self, tmp_path):
        read = partial(parameters.from_text, 'setup_file', parse=parse_setup)
        assert read('demo_setup.yaml') == parse_setup(read_config('demo_setup.yaml'))
        assert read('', none=3) == 3 and read('nominal') is None
        (broken := tmp_path / 'broken.yaml').write_text('schema: other')
        for name, said in (('none.yaml', 'no file none.yaml'), (broken, 'setup: schema must be')):
            with pytest.raises(SetupError, match=f'parameter setup_file: {said}'):
                read(str(name))

    def test_a_table_may_hold_only_what_ros_can_carry(self):
        @dataclass(frozen=True)
        class Wrong:
            where: dict = parameter(None, 'a dictionary')

        with pytest.raises(ParameterError, match='no parameter can be'):
            parameters.types(Wrong)

    def test_description_lists_everything(self):
        text = parameters.describe(Table)
        assert 'rate_hz = 25.0 [1 to 100] (may change while it runs)' in text
        assert "mode = 'fast' [fast | slow]" in text


class TestParameterFiles:
    @pytest.mark.parametrize(
        'key', ['/anser/sample', '/**/sample', '/**', '/anser/*', '/*/sample', '/anser/**', '/*/*']
    )
    def test_a_section_that_reaches_the_node_is_fine(self, tmp_path, key):
        file = tmp_path / 'a.yaml'
        file.write_text(f'{key}:\n  ros__parameters: {{}}\n')
        arguments = ['sample', '--ros-args', '--params-file', str(file)]
        assert complaints(arguments, '/anser/sample') == []

    def test_sections_may_be_nested_by_namespace(self, tmp_path):
        file = tmp_path / 'a.yaml'
        file.write_text('anser:\n  sample:\n    ros__parameters: {}\n')
        assert complaints(['--params-file', str(file)], '/anser/sample') == []
        for node in ('/anser/other', '/sample', '/a/anser/sample', '/anser/a/sample'):
            (complaint,) = complaints(['--params-file', str(file)], node)
            assert complaint.startswith(f'{file} has parameters of anser/sample, none of {node}')

    def test_what_rcl_refuses_itself_is_left_to_it(self, tmp_path):
        file = tmp_path / 'a.yaml'
        file.write_text('a: [1')
        assert complaints(['--params-file', str(file)], 'sample') == []
        assert complaints(['--params-file', '/nowhere'], 'sample') == []
        assert complaints(['--params-file'], 'sample') == []


class TestThrottle:
    def test_first_of_a_kind_is_whole_and_the_rest_is_counted(self):
        throttle = Throttle(10.0)
        assert throttle.admit('gap', 'gap of 3', 100.0) == 'gap of 3'
        assert throttle.admit('gap', 'gap of 4', 101.0) is None
        assert throttle.admit('crc', 'bad crc', 101.0) == 'bad crc'
        assert throttle.admit('gap', 'gap of 5', 110.0) == 'gap of 5 (1 more like it held back)'
        assert throttle.admit('gap', 'gap of 6', 121.0) == 'gap of 6'

    def test_unlike_reasons_of_a_kind_are_not_held_back_for_each_other(self):
        throttle = Throttle(10.0)
        for text in ("the cloud lacks the field 'x'", 'point_step 0 and width 9 make no cloud'):
            assert throttle.admit('refused', text, 100.0) == text
        assert throttle.admit('refused', 'point_step 4 and width 7 make no cloud', 101.0) is None
        texts = [f'frame {chr(200 + i)}' for i in range(2 * MOST_KINDS)]
        said = [text for text in texts if throttle.admit('refused', text, 102.0)]
        assert len(said) == MOST_KINDS - 1, 'ever other names are one kind in the end'


NODE = '''
"""A node of the tests."""
import ctypes
import math
import sys
import time
from dataclasses import dataclass
from anser_ros.nodes.runtime.node import AnserNode
from anser_ros.nodes.runtime.process import main
from anser_ros.nodes.runtime.parameters import parameter

@dataclass(frozen=True)
class Table:
    rate_hz: float = parameter(25.0, 'rate', within=(1.0, math.inf))

class Sample(AnserNode):
    NAME = 'sample'
    PARAMETERS = Table

    def __init__(self, **options):
        super().__init__(**options)
        print('rate', self.parameters.rate_hz, flush=True)
        if self.parameters.rate_hz == 99.0:
            time.sleep(600)
        if self.parameters.rate_hz == 98.0:  # a library that lets no Python handler run
            ctypes.CDLL(None).poll(None, 0, 600000)
            ctypes.CDLL(None).sleep(600)

    def close(self):
        print('closed', flush=True)

sys.exit(main(Sample))
'''


class TestProcess:
    @pytest.fixture
    def run(self, domain, tmp_path):
        script = tmp_path / 'sample.py'
        script.write_text(NODE)
        started = []

        def start(*arguments):
            log = tmp_path / f'{len(started)}.log'
            started.append(Process([sys.executable, str(script), *arguments], log))
            return started[-1]

        yield start
        for process in started:
            process.kill_group()

    @pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
    def test_a_signal_ends_it_in_order(self, run, number):
        process = run('--ros-args', '-p', 'rate_hz:=50')
        process.wait_for('rate 50.0')
        assert process.interrupt(number) == 0
        assert process.output.endswith('closed\n')

    @pytest.mark.parametrize('rate', [98, 99])
    def test_a_signal_ends_it_while_it_is_still_being_made(self, run, rate):
        process = run('--ros-args', '-p', f'rate_hz:={rate}')
        process.wait_for(f'rate {rate}.0')
        assert process.interrupt() == 0
        assert process.output == f'rate {rate}.0\n'

    def test_a_signal_ends_it_while_it_imports(self, domain, tmp_path):
        command = [sys.executable, '-P', '-m', 'anser_ros.nodes.tracker']
        process = Process(command, tmp_path / 'log')
        maps = Path(f'/proc/{process.popen.pid}/maps')
        while 'numpy' not in maps.read_text():
            time.sleep(0.002)
        assert process.interrupt() == 0
        assert 'Traceback' not in process.output

    @pytest.mark.parametrize(
        ('arguments', 'said'),
        [
            (['--ros-args', '-p', 'rate:=50'], 'no parameter rate; there are: rate_hz'),
            (['--ros-args', '-p', 'rate_hz:=0.1'], 'below 1.0'),
            (['--ros-args', '--params-file', '/nowhere.yaml'], 'params file'),
            (['--bogus'], 'unrecognized arguments'),
        ],
    )
    def test_a_wrong_argument_is_one_clear_line(self, run, arguments, said):
        process = run(*arguments)
        assert process.wait() == 2
        assert said in process.output
        assert 'Traceback' not in process.output

    def test_a_file_without_the_node_is_said(self, run, tmp_path):
        """rclpy drops a section with a misspelt name without a word."""
        file = tmp_path / 'parameters.yaml'
        file.write_text('/anser/smaple:\n  ros__parameters:\n    rate_hz: 50.0\n')
        process = run('--ros-args', '--params-file', str(file))
        process.wait_for('parameters of /anser/smaple, none of /anser/sample: write /anser/sample')
        process.wait_for('rate 25.0')


class TestGraph:
    @pytest.fixture
    def node(self, ros):
        class Sample(AnserNode):
            NAME = 'sample'
            PARAMETERS = Table

            def status(self):
                return Status('', Level.WARN, 'waiting', {'noise_t': 6e-11})

            def part_statuses(self):
                return [Status('tool_a/0/x', Level.OK, 'ok')]

        node = Sample()
        yield node
        node.destroy_node()

    def test_diagnostics_hold_state_counters_and_parts(self, ros, node):
        got = []
        node.count('windows', 5)
        listener = ros.create_node('listener')
        listener.create_subscription(DiagnosticArray, '/diagnostics', got.append, 10)
        executor = ros.executors.SingleThreadedExecutor()
        executor.add_node(node)
        executor.add_node(listener)
        assert wait(lambda: got, lambda: executor.spin_once(timeout_sec=0.1))
        executor.shutdown()
        own, part = got[0].status
        assert (own.name, own.level, own.message) == ('anser/sample', b'\x01', 'waiting')
        values = {pair.key: pair.value for pair in own.values}
        assert values['windows'] == '5' and values['noise_t'] == '6e-11'
        assert part.name == 'anser/sample: tool_a/0/x'

    def test_a_failing_callback_is_counted_and_survived(self, ros, node):
        def fail(_message):
            raise ZeroDivisionError('on purpose')

        def refuse(_request, _response):
            raise SetupError('no such board')

        node.create_subscription(String, 'in', fail, 10)
        node.create_service(Trigger, 'ask', refuse)
        out = node.create_publisher(String, 'in', 10)
        client = node.create_client(Trigger, 'ask')
        assert client.wait_for_service(10)
        future = client.call_async(Trigger.Request())
        assert spin_until(node, future.done)
        assert (future.result().success, future.result().message) == (False, 'no such board')
        assert node.counters['refused_SetupError'] == 1
        out.publish(String(data='x'))
        assert spin_until(node, lambda: node.counters['callback_faults'] == 1)

    def test_parameters_change_only_within_the_table(self, node):
        before = node.parameters
        (done,) = node.set_parameters([Parameter('rate_hz', value=50)])
        assert done.successful and node.parameters.rate_hz == 50.0 and before.rate_hz == 25.0
        (done,) = node.set_parameters([Parameter('rate_hz', value=1000.0)])
        assert not done.successful and 'above 100.0' in done.reason
        (done,) = node.set_parameters([Parameter('depth', value=5)])
        assert not done.successful
        assert node.parameters.rate_hz == 50.0 and node.parameters.depth == 3

    def test_qos_overrides_are_honoured(self, ros):
        given = {
            'in.subscription.reliability': 'best_effort',
            'out.publisher.durability': 'volatile',
        }
        pairs = [Parameter(f'qos_overrides./anser/{key}', value=v) for key, v in given.items()]
        node = type('Sample', (AnserNode,), {'NAME': 'sample'})(parameter_overrides=pairs)
        taken = node.create_subscription(String, 'in', print, qos.STREAM)
        out = node.create_publisher(String, 'out', qos.LATCHED)
        assert taken.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
        assert out.qos_profile.durability == DurabilityPolicy.VOLATILE
        assert qos.STREAM.reliability == ReliabilityPolicy.RELIABLE, 'other topics have it too'
        polled = polling_node(node)
        seen = Polled(polled, String, 'in', qos.STREAM)._subscription.qos_profile
        assert seen.reliability == ReliabilityPolicy.BEST_EFFORT
        for one in (polled, node):
            one.destroy_node()

    @pytest.mark.parametrize(
        ('name', 'value', 'words'),
        [
            ('/anser/out.publisher.reliabilty', 'best_effort', 'there are: history, depth'),
            ('/anser/out.publisher.reliability', 'best', 'none of system_default'),
            ('/anser/out.depth', 5, 'publisher or subscription'),
            ('out.publisher.depth', 5, 'a full name'),
            ('/anser/out.publisher.depth', 0, '0 is no depth'),
        ],
    )
    def test_what_overrides_nothing_is_refused(self, ros, name, value, words):
        pair = Parameter(f'qos_overrides.{name}', value=value)
        with pytest.raises(ParameterError, match=words):
            type('Sample', (AnserNode,), {'NAME': 'sample'})(parameter_overrides=[pair])


def test_the_executor_is_the_one_told_of_events_where_rclpy_has_it(monkeypatch):
    experimental = pytest.importorskip('rclpy.experimental')
    monkeypatch.setattr(experimental, 'EventsExecutor', lambda: 'events')
    assert processes.make_executor() == 'events'
    monkeypatch.setitem(sys.modules, 'rclpy.experimental', None)
    monkeypatch.setattr(processes, 'SingleThreadedExecutor', lambda: 'waiting')
    assert processes.make_executor() == 'waiting'


@pytest.mark.processes
def test_a_node_gives_blas_one_thread_before_numpy_reads_it():
    asked = (
        'import os, sys, anser_ros.nodes as n\n'
        'print("numpy" in sys.modules, *map(os.environ.get, n.ONE_THREAD))'
    )
    free = {name: text for name, text in os.environ.items() if name not in ONE_THREAD}
    for own, expected in (({}, 'False 1 1 1'), ({ONE_THREAD[0]: '2'}, 'False 2 1 1')):
        done = subprocess.run([sys.executable, '-c', asked], env=free | own, capture_output=True)
        assert done.stdout.decode().strip() == expected, done.stderr
