"""What the code imports is what `setup.py`, `package.xml` and the pinned environments ask for."""

import ast
import re
import sys
from importlib.metadata import packages_distributions
from xml.etree import ElementTree

import pytest
from conftest import REPO

from anser_ros.cli import main as cli

OPTIONAL = {'tf2_msgs', 'launch', 'launch_ros'}
"""ROS packages that no wheel brings: where they are missing, what needs them is left out."""
SETUPTOOLS = 'setuptools'
"""Is needed by colcon's build of a Python package, by no import."""
ROSDEP = {
    'numpy': 'python3-numpy',
    'scipy': 'python3-scipy',
    'pyyaml': 'python3-yaml',
    'pyserial': 'python3-serial',
    'matplotlib': 'python3-matplotlib',
}
"""PyPI's name and rosdep's key, where rosdep has the package."""


def imported():
    """Return the modules of others that the package and its launch files import."""
    files = [*(REPO / 'anser_ros').rglob('*.py'), *(REPO / 'launch').glob('*.py')]
    found = set()
    for path in files:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found |= {alias.name.split('.')[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                found.add(node.module.split('.')[0])
    return found - set(sys.stdlib_module_names) - {'anser_ros'}


def required():
    """Return the distributions that `setup.py` asks for, in lower case."""
    (call,) = (
        node
        for node in ast.walk(ast.parse((REPO / 'setup.py').read_text()))
        if isinstance(node, ast.keyword) and node.arg == 'install_requires'
    )
    return {re.split('[<>=]', line)[0].lower() for line in ast.literal_eval(call.value)}


def package(tag):
    return [element.text for element in ElementTree.parse(REPO / 'package.xml').iter(tag)]


@pytest.mark.long
def test_every_import_is_asked_for_and_nothing_else():
    ros = {name for name in package('exec_depend') if not name.startswith('python3-')}
    known = packages_distributions()
    names = {name.lower() for module in imported() - ros for name in known.get(module, [module])}
    assert names == required() - {SETUPTOOLS}
    assert ros - OPTIONAL <= imported()


def test_package_xml_has_what_rosdep_knows():
    python = {name for name in package('exec_depend') if name.startswith('python3-')}
    assert python == {ROSDEP[name] for name in required() & set(ROSDEP)}


@pytest.mark.parametrize('kind', ['newest', 'oldest'])
def test_the_pinned_environments_have_all_of_it(kind):
    text = (REPO / '.ci' / f'requirements-{kind}.txt').read_text().lower()
    pinned = set(re.findall('^([a-z0-9_-]+)==', text, re.MULTILINE))
    ros = {f'ros-{name.replace("_", "-")}' for name in package('exec_depend')}
    missing = required() - pinned
    assert not missing
    ros -= {f'ros-{name.replace("_", "-")}' for name in OPTIONAL}
    assert {name for name in ros if not name.startswith('ros-python3-')} <= pinned


def test_the_version_stands_in_one_place(capsys):
    """`package.xml` has it; `setup.py` reads it there, and the changelog tells of it."""
    (version,) = package('version')
    assert version not in (REPO / 'setup.py').read_text()
    assert cli.main(['--version']) == 0
    assert capsys.readouterr().out == f'anser_ros {version}\n'
    heads = re.findall(r'^(\S+) \(.*\)\n-+$', (REPO / 'CHANGELOG.rst').read_text(), re.MULTILINE)
    assert heads[0] == version
