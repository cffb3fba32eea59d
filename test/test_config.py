"""What lies in config/ and launch/ is what the code knows: nothing that is dropped silently."""

import ast
import importlib
import inspect
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
import rclpy.node
import yaml
from conftest import REPO

from anser_ros.cli.commands import NODES
from anser_ros.errors import AnserError, ParameterError, SetupError
from anser_ros.nodes.runtime import node as base
from anser_ros.nodes.runtime import parameters
from anser_ros.nodes.runtime.node import AnserNode
from anser_ros.nodes.runtime.parameters import checked
from anser_ros.settings import VALUES
from anser_ros.wire.setup import parse_setup

CONFIG = REPO / 'config'
DOCUMENTS = sorted(CONFIG.glob('*.yaml'))
PACKAGE = CONFIG.parent / 'anser_ros'
NODE_FILES = [*PACKAGE.glob('nodes/**/*.py'), *PACKAGE.glob('apps/*/nodes/*.py')]


def is_parameter_file(document):
    return isinstance(document, dict) and any(
        isinstance(value, dict) and 'ros__parameters' in value for value in document.values()
    )


def node_class(name):
    module = importlib.import_module(NODES[name][0])
    (found,) = (
        value
        for value in vars(module).values()
        if isinstance(value, type)
        and issubclass(value, AnserNode)
        and value.__module__ == module.__name__
    )
    return found


def check_parameter_file(document):
    """Raise ParameterError on a node or a key that no table knows, or a value out of range."""
    for key, section in document.items():
        name = key.rsplit('/', 1)[-1]
        if name not in NODES:
            raise ParameterError(f'no node {key}')
        if set(section) != {'ros__parameters'}:
            raise ParameterError(f'{key} may hold ros__parameters only')
        parameters.build(node_class(name).PARAMETERS, section['ros__parameters'])


@pytest.mark.parametrize('path', DOCUMENTS, ids=lambda path: path.name)
def test_every_node_and_key_is_known_and_setups_are_valid(path):
    document = yaml.safe_load(path.read_text())
    if path.name != 'diagnostics.yaml' and is_parameter_file(document):
        check_parameter_file(document)
    elif str(document.get('schema', '')).startswith('anser_setup'):
        parse_setup(path.read_text())


@pytest.mark.parametrize(
    ('document', 'said'),
    [
        ({'/anser/trakcer': {'ros__parameters': {}}}, 'no node /anser/trakcer'),
        ({'/anser/recorder': {'ros__parameters': {'nmae': 'x'}}}, 'no parameter nmae'),
        ({'/anser/recorder': {'ros__parameters': {'flush_period_s': 9}}}, 'above 1'),
        ({'/anser/recorder': {'ros_parameters': {}}}, 'may hold ros__parameters only'),
    ],
)
def test_what_rclpy_would_drop_is_found(document, said):
    with pytest.raises(ParameterError, match=said):
        check_parameter_file(document)


def test_every_node_has_its_group_in_the_aggregated_diagnostics():
    document = yaml.safe_load((CONFIG / 'diagnostics.yaml').read_text())
    groups = document['/**']['ros__parameters']
    assert groups.pop('path') == 'Anser'
    found = sorted(name for group in groups.values() for name in group['contains'])
    assert found == sorted(f'/{name}' for name in NODES)
    assert {group['type'] for group in groups.values()} == {
        'diagnostic_aggregator/GenericAnalyzer'
    }


def test_the_main_file_is_as_it_is_written():
    writer = runpy.run_path(str(REPO / '.ci' / 'write_parameters.py'))
    assert (CONFIG / 'anser.yaml').read_text() == writer['text']()


def test_every_parameter_is_read_and_every_node_has_the_name_of_its_module():
    """A parameter that nothing asks for would promise what is not done; the names of
    `anser_ros.settings` are read together, by `stated_by`.
    """
    trees = [ast.parse(path.read_text()) for path in NODE_FILES]
    read = {n.attr for tree in trees for n in ast.walk(tree) if isinstance(n, ast.Attribute)}
    tables = {name: set(node_class(name).PARAMETERS.__dataclass_fields__) for name in NODES}
    unread = {name: names - read - set(VALUES) for name, names in tables.items()}
    assert not {name: sorted(names) for name, names in unread.items() if names}
    for name in NODES:
        assert name == node_class(name).NAME


def private_names(path, name='Node'):
    """Return the private methods and attributes that a class of a file gives itself."""
    found = set()
    classes = [n for n in ast.parse(Path(path).read_text()).body if isinstance(n, ast.ClassDef)]
    for node in (n for c in classes if c.name.endswith(name) for n in ast.walk(c)):
        if isinstance(node, ast.FunctionDef) and node.args.args[:1]:
            found |= {node.name} if node.args.args[0].arg == 'self' else set()
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            found |= {node.attr} if ast.unparse(node.value) == 'self' else set()
    return {name for name in found if name.startswith('_') and not name.startswith('__')}


def test_no_node_takes_a_private_name_of_its_bases():
    """rclpy's Node and our base have some that a node would think of too, such as `_clock`."""
    taken = private_names(rclpy.node.__file__) | private_names(base.__file__)
    assert '_clock' in taken
    for name in NODES:
        found = node_class(name)
        own = private_names(inspect.getfile(found), found.__name__)
        assert not own & taken, name


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


def test_a_bag_is_played_in_place_of_a_control_unit(launched, tmp_path):
    (tmp_path / 'scan').mkdir()
    played = launched(replay='scan', simulate='true', composed='true')
    assert played['replay'] == str(tmp_path / 'scan')
    wanted = 'is_played', 'is_acquired', 'simulate', 'composed', 'record'
    assert [played[name] for name in wanted] == ['true', 'false', 'false', 'false', 'false']
    assert launched(replay='scan', record='true')['record'] == 'true'
    assert [launched()[name] for name in wanted] == ['false', 'false', 'false', 'true', 'true']
    assert launched(composed='false')['is_acquired'] == 'true'
    with pytest.raises(AnserError, match='nowhere: no such bag'):
        launched(replay='nowhere')


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
        checked(str(path), ('tracker', 'recorder'))
    with pytest.raises(SetupError, match='no file'):
        checked(str(tmp_path / 'nowhere.yaml'), ('tracker', 'recorder'))
    path.write_text('/**:\n  ros__parameters: {use_sim_time: true}\n')
    assert checked(str(path), ('tracker', 'recorder')) == str(path)
