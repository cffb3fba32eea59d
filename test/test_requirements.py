"""What goes out: sdist, wheel and image have what the code imports, and descriptions agree."""

import ast
import json
import re
import shutil
import subprocess
import sys
import zipfile
from importlib.metadata import packages_distributions
from xml.etree import ElementTree

import pytest
import yaml
from conftest import REPO

from anser_ros.cli import main as cli
from anser_ros.cli.commands import COMPOSED, NODES, OFFLINE
from anser_ros.cli.main import PYPI

OPTIONAL = {'tf2_msgs', 'launch', 'launch_ros'}
"""ROS packages that no wheel brings: where they are missing, what needs them is left out."""
SETUPTOOLS = 'setuptools'
"""Is needed by colcon's build of a Python package, by no import."""
ROSDEP = {
    'numpy': 'python3-numpy', 'pandas': 'python3-pandas', 'scipy': 'python3-scipy',
    'pyyaml': 'python3-yaml',
    'pyserial': 'python3-serial', 'matplotlib': 'python3-matplotlib', 'h5py': 'python3-h5py',
    'numba': 'python3-numba', 'rich': 'python3-rich',
}  # fmt: skip
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


def asked_for(keyword):
    """Return what `setup.py` says under a keyword."""
    (call,) = (
        node
        for node in ast.walk(ast.parse((REPO / 'setup.py').read_text()))
        if isinstance(node, ast.keyword) and node.arg == keyword
    )
    return ast.literal_eval(call.value)


def names_of(lines):
    """Return the distributions of requirements, in lower case."""
    return {re.split('[<>=]', line)[0].lower() for line in lines}


def required():
    """Return the distributions that every installation needs."""
    return names_of(asked_for('install_requires'))


def optional():
    """Return the distributions that only some commands and nodes need."""
    extras = asked_for('extras_require')
    return names_of(extras['dashboard'])


def package(tag):
    return [element.text for element in ElementTree.parse(REPO / 'package.xml').iter(tag)]


@pytest.mark.long
def test_every_import_is_asked_for_and_nothing_else():
    ros = {name for name in package('exec_depend') if not name.startswith('python3-')}
    known = packages_distributions()
    names = {name.lower() for module in imported() - ros for name in known.get(module, [module])}
    assert names == (required() | optional()) - {SETUPTOOLS}
    assert ros - OPTIONAL <= imported()


def test_package_xml_has_what_rosdep_knows():
    python = {name for name in package('exec_depend') if name.startswith('python3-')}
    assert python == {ROSDEP[name] for name in required() & set(ROSDEP)}


def test_what_rosdep_does_not_know_is_asked_for_where_it_is_needed(monkeypatch, capsys):
    """A package that only PyPI has is missing on an installation by rosdep alone."""
    needed = required() - set(ROSDEP) - {SETUPTOOLS}
    assert needed <= set(cli.PYPI.values()) <= needed | optional()
    assert set(cli.NEEDED) <= set(NODES)
    assert {name for names in cli.NEEDED.values() for name in names} <= set(cli.PYPI)
    found = cli.find_spec
    monkeypatch.setattr(cli, 'find_spec', lambda name: name != 'mcap' and found(name))
    assert cli.main(['recorder']) == 2
    said = capsys.readouterr().err
    assert said == 'anser recorder: mcap is not installed: pip install mcap\n'
    cli.check_packages('tracker')
    monkeypatch.setattr(cli, 'find_spec', lambda name: name != 'rclpy' and found(name))
    for command in (['tracker', '--help'], ['demo'], ['pivot', '--live', '--topic', '/pose']):
        assert cli.main(command) == 2
        said = capsys.readouterr().err
        assert said.startswith(f'anser {command[0]}: rclpy is not installed: source /opt/ros')
        assert len(said.splitlines()) == 1

    def load(name):
        raise ModuleNotFoundError('No module named mcap.reader', name='mcap.reader')

    monkeypatch.setattr(cli.importlib, 'import_module', load)
    assert cli.main(['evaluate']) == 2
    said = capsys.readouterr().err
    assert said == 'anser evaluate: mcap is not installed: pip install mcap\n'

    def read(name):
        raise ModuleNotFoundError('No module named pandas', name='pandas')

    monkeypatch.setattr(cli.importlib, 'import_module', read)
    assert cli.main(['pivot', 'poses.csv']) == 2
    assert 'pandas is not installed: pip install pandas' in capsys.readouterr().err


# Imports modules as where some packages are not.
WITHOUT = """
import importlib, sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in sys.argv[1].split(','):
            raise ModuleNotFoundError(name, name=name)
sys.meta_path.insert(0, Missing())
for module in sys.argv[2:]:
    importlib.import_module(module)
"""


def import_without(packages, modules):
    """Import modules in a process that finds some packages nowhere."""
    command = [sys.executable, '-c', WITHOUT, ','.join(packages), *modules]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=REPO)
    assert done.returncode == 0, done.stderr


@pytest.mark.processes
def test_all_other_nodes_start_without_it():
    names = [name for name in NODES if name not in cli.NEEDED]
    assert {'acquisition', 'field_model', 'tracker', 'watcher', 'monitor'} <= set(names)
    import_without(cli.PYPI, [NODES[name][0] for name in names])


@pytest.mark.processes
def test_what_a_single_step_needs_is_not_needed_to_read_the_help():
    """A command is imported for its help; bags' own packages nearly every command needs."""
    bags = ('mcap', 'mcap_ros2', 'zstandard')
    few = [name for name in cli.PYPI if name not in bags]
    assert {'allantools', 'nicegui'} <= set(few)
    import_without(few, [module for module, _ in OFFLINE.values()])


@pytest.mark.parametrize('kind', ['newest', 'oldest'])
def test_the_pinned_environments_have_all_of_it(kind):
    files = {'newest': ('newest', 'development'), 'oldest': ('oldest',)}[kind]
    locks = [REPO / '.ci' / f'requirements-{name}.txt' for name in files]
    text = ''.join(lock.read_text() for lock in locks).lower()
    pinned = set(re.findall('^([a-z0-9_-]+)==', text, re.MULTILINE))
    ros = {f'ros-{name.replace("_", "-")}' for name in package('exec_depend')}
    missing = (required() | optional()) - pinned
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


PACKAGE = ElementTree.parse(REPO / 'package.xml')
LEFT_OUT = shutil.ignore_patterns('.*', 'build', 'install', 'log', 'out', '*.egg-info', 'test')
BUILD = """
import sys
from setuptools import build_meta
print(getattr(build_meta, sys.argv[1])(sys.argv[2]))
"""


def run(command, cwd, **options):
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.processes
@pytest.mark.long
def test_a_wheel_of_the_sdist_runs(tmp_path):
    """As who installs a release: what the sdist lacks, the wheel that is made of it lacks too."""
    source = tmp_path / 'source'
    shutil.copytree(REPO, source, ignore=LEFT_OUT)
    out = tmp_path / 'dist'
    out.mkdir()
    name = run([sys.executable, '-c', BUILD, 'build_sdist', str(out)], source).split()[-1]
    shutil.unpack_archive(out / name, tmp_path / 'unpacked', filter='data')
    (unpacked,) = (tmp_path / 'unpacked').iterdir()
    name = run([sys.executable, '-c', BUILD, 'build_wheel', str(out)], unpacked).split()[-1]
    target = tmp_path / 'target'
    with zipfile.ZipFile(out / name) as wheel:
        wheel.extractall(target)
        listed = wheel.namelist()
    share = f'{name.split("-py3")[0]}.data/data/share/anser_ros'
    for folder in ('config', 'launch', 'bags'):
        files = {path.name for path in (REPO / folder).iterdir() if path.is_file()}
        assert {f'{share}/{folder}/{file}' for file in files} <= set(listed)
    page = {
        f'anser_ros/apps/dashboard/{path.name}'
        for path in (REPO / 'anser_ros/apps/dashboard').glob('*.[jc]s*')
    }
    assert page and page <= set(listed)
    (entry,) = (path for path in listed if path.endswith('entry_points.txt'))
    scripts = re.findall(r'^(\w+) = ', (target / entry).read_text(), re.MULTILINE)
    assert set(scripts) == {'anser', *NODES, *COMPOSED, *OFFLINE}
    code = 'import sys; sys.path.insert(0, sys.argv[1]); from anser_ros.cli.main import main; '
    code += 'import anser_ros; assert anser_ros.__file__.startswith(sys.argv[1]); '
    code += 'sys.exit(main(["--version"]))'
    said = run([sys.executable, '-P', '-c', code, str(target)], tmp_path)
    assert said == f'anser_ros {PACKAGE.findtext("version")}\n'


def test_the_image_has_the_packages_of_package_xml():
    """Ubuntu's names of what rosdep knows, and of PyPI what it does not."""
    text = (REPO / 'Dockerfile').read_text()
    needed = {element.text for element in PACKAGE.iter('exec_depend')}
    apt = {n if n.startswith('python3-') else f'ros-jazzy-{n.replace("_", "-")}' for n in needed}
    listed = set(re.findall(r'^    ((?:python3|ros-jazzy)-[a-z0-9-]+) \\$', text, re.MULTILINE))
    assert listed == apt | {'python3-pip'}
    (pip,) = re.findall(r'pip install[^\n]*\\\n +([^\n]+)', text)
    assert set(PYPI.values()) <= set(pip.split())
    assert 'noble' in text and 'jazzy' in text


def test_container_and_citation_are_of_this_image_and_version():
    document = json.loads((REPO / '.devcontainer' / 'devcontainer.json').read_text())
    folder = REPO / '.devcontainer'
    assert (folder / document['build']['dockerfile']).resolve() == REPO / 'Dockerfile'
    assert (folder / document['build']['context']).resolve() == REPO
    cited = yaml.safe_load((REPO / 'CITATION.cff').read_text())
    assert str(cited['version']) == PACKAGE.findtext('version')
    assert cited['license'] == PACKAGE.findtext('license')
    assert cited['cff-version'] == '1.2.0' and cited['authors'] and cited['title']
