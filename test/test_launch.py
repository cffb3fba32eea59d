"""The launch files, on whose own libraries no wheel exists: what they find is tested without."""

import runpy
import sys
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
from conftest import REPO

from anser_ros.errors import AnserError, ParameterError, SetupError
from anser_ros.nodes.runtime.parameters import checked

NODES = ('tracker', 'recorder')
MODULES = (
    'launch', 'launch.actions', 'launch.conditions', 'launch.substitutions', 'launch_ros',
    'launch_ros.actions', 'launch_ros.parameter_descriptions', 'launch_ros.substitutions',
)  # fmt: skip


@pytest.fixture
def namespace(monkeypatch):
    """Return the launch file's names."""
    for module in MODULES:
        monkeypatch.setitem(sys.modules, module, MagicMock())
    return runpy.run_path(str(REPO / 'launch' / 'anser.launch.py'))


@pytest.fixture
def launched(namespace, monkeypatch, tmp_path):
    """Return what the launch file makes of the given arguments."""
    monkeypatch.chdir(tmp_path)

    def find(**given):
        values = {name: default for name, (default, _) in namespace['ARGUMENTS'].items()}
        context = SimpleNamespace(launch_configurations={**values, **given})
        namespace['find_files'](context)
        return context.launch_configurations

    return find


def test_a_simulated_unit_has_a_port_that_anybody_may_make(launched):
    assert launched()['device'] == '/dev/ttyACM0'
    first, second = (launched(simulate='true', namespace=name) for name in ('anser', '/or/two'))
    assert first['device'] == '/tmp/anser_cu_anser' and second['device'] == '/tmp/anser_cu_or_two'
    assert launched(simulate='true', device='mine')['device'] == 'mine'


def test_a_parameter_file_and_a_model_are_taken_from_here_or_from_the_package(launched, tmp_path):
    assert launched()['params'] == str(REPO / 'config' / 'anser.yaml')
    assert launched()['rviz_config'] == str(REPO / 'config' / 'anser.rviz')
    assert launched()['model'] == 'nominal'
    model = launched(model='demo_model.yaml')['model']
    assert model == str(REPO / 'config' / 'demo_model.yaml')
    (tmp_path / 'mine.yaml').write_text('/**/tracker:\n  ros__parameters: {gate: 3.0}\n')
    assert launched(params='mine.yaml')['params'] == 'mine.yaml'
    (tmp_path / 'bad.yaml').write_text('/**/trakcer:\n  ros__parameters: {gate: 3.0}\n')
    for given in ({'params': 'bad.yaml'}, {'params': 'nowhere.yaml'}, {'model': 'nowhere.yaml'}):
        with pytest.raises(AnserError):
            launched(**given)


def test_a_node_that_refuses_its_parameters_ends_the_launch(namespace):
    def ended(code):
        event = SimpleNamespace(process_name='tracker-4', returncode=code)
        return namespace['end_all_if_refused'](event, None)

    assert ended(0) is None and ended(1) is None
    (action,) = ended(2)
    assert action is sys.modules['launch.actions'].Shutdown.return_value


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('/anser/trakcer: {ros__parameters: {gate: 3.0}}', 'no node /anser/trakcer, is tracker'),
        ('gate: 3.0', 'no section with ros__parameters'),
        ('- 1', 'no section with ros__parameters'),
        ('a: [', 'not YAML'),
    ],
)
def test_a_file_that_would_leave_all_at_their_defaults_is_refused(tmp_path, text, said):
    path = tmp_path / 'params.yaml'
    path.write_text(text)
    with pytest.raises(ParameterError, match=said):
        checked(str(path), NODES)
    with pytest.raises(SetupError, match='no file'):
        checked(str(tmp_path / 'nowhere.yaml'), NODES)
    path.write_text('/**:\n  ros__parameters: {use_sim_time: true}\n')
    assert checked(str(path), NODES) == str(path)
