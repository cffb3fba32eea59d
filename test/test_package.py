"""The package as colcon builds it, and the console script."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import REPO, Process, spin_until

from anser_ros.cli import main as cli
from anser_ros.cli.commands import COMPOSED, NODES, OFFLINE
from anser_ros.errors import BagError

pytestmark = pytest.mark.light

COLCON = shutil.which('colcon', path=f'{Path(sys.executable).parent}:{os.environ["PATH"]}')
LEFT_OUT = shutil.ignore_patterns('.*', 'build', 'install', 'log', 'out', '*.egg-info', 'test')


@pytest.fixture(scope='module')
def installed(tmp_path_factory):
    """Build the package with colcon in a workspace of its own; return its prefix."""
    if COLCON is None:
        pytest.skip('colcon is not installed')
    workspace = tmp_path_factory.mktemp('workspace')
    shutil.copytree(REPO, workspace / 'src' / 'anser_ros', ignore=LEFT_OUT)
    command = [COLCON, 'build', '--event-handlers', 'console_direct+']
    # The Python of the tests must be the one that colcon builds for.
    path = f'{Path(sys.executable).parent}{os.pathsep}{os.environ["PATH"]}'
    own = {**os.environ, 'PATH': path}
    built = subprocess.run(command, cwd=workspace, env=own, capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    return workspace / 'install' / 'anser_ros'


@pytest.fixture
def overlay(installed, domain):
    """Return the environment of a sourced workspace."""
    (library,) = installed.glob('lib/python3*/site-packages')
    prefixes = [str(installed), os.environ.get('AMENT_PREFIX_PATH', '')]
    return {
        **os.environ,
        'PYTHONPATH': str(library),
        'AMENT_PREFIX_PATH': os.pathsep.join(filter(None, prefixes)),
    }


@pytest.mark.processes
def test_the_ament_index_knows_the_package(installed, monkeypatch):
    from ament_index_python.packages import get_package_prefix, get_package_share_directory

    monkeypatch.setenv('AMENT_PREFIX_PATH', str(installed))
    assert Path(get_package_prefix('anser_ros')) == installed
    share = Path(get_package_share_directory('anser_ros'))
    assert (share / 'package.xml').is_file()
    for folder in ('config', 'launch', 'bags'):
        files = {path.name for path in (REPO / folder).glob('*') if path.is_file()}
        found = share / folder
        assert files == {path.name for path in found.glob('*')} if files else not found.exists()


@pytest.mark.processes
def test_every_command_is_an_executable(installed):
    executables = {path.name for path in (installed / 'lib' / 'anser_ros').iterdir()}
    assert executables == {'anser', *NODES, *COMPOSED, *OFFLINE}


def test_the_table_lists_every_module_that_is_a_command():
    def modules(pattern, mark):
        files = (REPO / 'anser_ros').glob(pattern)
        found = {path.relative_to(REPO) for path in files if mark in path.read_text()}
        return {'.'.join(path.with_suffix('').parts) for path in found}

    def of(*groups):
        return {module for group in groups for module, _ in group.values()}

    assert of(NODES, COMPOSED) == modules('**/nodes/*.py', "\nif __name__ == '__main__':")
    assert of(OFFLINE) == modules('**/*.py', '\ndef add_arguments(')


def test_an_installed_node_runs(installed, overlay, ros, tmp_path):
    """As `ros2 run anser_ros tracker` starts it: by its executable, from anywhere."""
    command = [sys.executable, str(installed / 'lib' / 'anser_ros' / 'tracker')]
    asked = Process([*command, '--help'], tmp_path / 'help.log', env=overlay, cwd=tmp_path)
    assert asked.wait() == 0, asked.output
    assert 'parameters' in asked.output
    process = Process(command, tmp_path / 'tracker.log', env=overlay, cwd=tmp_path)
    peer = ros.create_node('peer')
    try:
        assert spin_until(peer, lambda: 'tracker' in peer.get_node_names()), process.output
        assert process.interrupt() == 0, process.output
    finally:
        process.kill_group()


def test_an_installed_offline_command_runs(installed, overlay, tmp_path):
    command = [sys.executable, str(installed / 'lib' / 'anser_ros' / 'evaluate'), 'nowhere.mcap']
    arguments = ['--model', 'nominal', '--out', str(tmp_path / 'out')]
    done = subprocess.run(
        [*command, *arguments], env=overlay, cwd=tmp_path, capture_output=True, check=False
    )
    assert done.returncode == 2
    assert len(done.stderr.decode().strip().splitlines()) == 1
    assert b'nowhere.mcap' in done.stderr and done.stdout == b''


class TestConsole:
    """Exit 0 done, 2 one clear line, 1 a defect with its traceback."""

    @pytest.fixture
    def verb(self, monkeypatch):
        """Put a command in place that does what it is told."""

        class Module:
            @staticmethod
            def add_arguments(parser):
                parser.add_argument('--json', action='store_true')

        def place(run):
            Module.run = staticmethod(run)
            monkeypatch.setattr(cli, 'OFFLINE', {'sample': ('', 'A command of the tests.')})
            monkeypatch.setattr(cli.importlib, 'import_module', lambda name: Module)

        return place

    def test_success_and_its_output(self, verb, capsys):
        verb(lambda args: print('{}') or 0 if args.json else 1)
        assert cli.main(['sample', '--json']) == 0
        assert capsys.readouterr().out == '{}\n'

    @pytest.mark.parametrize(
        ('error', 'code', 'said'),
        [
            (BagError('a bag\nthat is none'), 2, 'anser sample: a bag that is none\n'),
            (FileNotFoundError(2, 'No file', 'x.yaml'), 2, 'anser sample: x.yaml: No file\n'),
            (KeyboardInterrupt(), 2, 'anser sample: interrupted\n'),
            (signal.SIGTERM, 2, 'anser sample: interrupted\n'),
            (ZeroDivisionError('defect'), 1, 'Traceback'),
            (OSError('no file in it'), 1, 'Traceback'),
        ],
    )
    def test_bad_input_is_one_line_a_defect_its_traceback(self, verb, capsys, error, code, said):
        def run(_args):
            if isinstance(error, signal.Signals):
                signal.raise_signal(error)
            raise error

        verb(run)
        assert cli.main(['sample']) == code
        found = capsys.readouterr().err
        assert found == said if code == 2 else said in found

    def test_bad_usage(self, verb, capsys):
        verb(lambda args: 0)
        assert cli.main(['sample', '--bogus']) == 2
        said = 'anser sample: unrecognized arguments: --bogus (usage: anser sample --help)\n'
        assert capsys.readouterr() == ('', said)
        assert cli.main(['smaple']) == 2
        assert "no command 'smaple'; there are:" in capsys.readouterr().err
        assert cli.main(['sample', '--help']) == 0
        assert 'A command of the tests.' in capsys.readouterr().out

    def test_usage_lists_every_command_without_importing_any(self, capsys):
        assert cli.main(['--help']) == 0
        usage = capsys.readouterr().out
        for name in [*NODES, *COMPOSED, *OFFLINE]:
            assert f'  {name}' in usage
        assert cli.main([]) == 2
        assert cli.main(['--version']) == 0
        assert 'anser_ros' in capsys.readouterr().out

    @pytest.mark.processes
    def test_a_reader_that_leaves_early_is_no_error(self):
        """`anser --help | head -1` ends in peace."""
        reading, writing = os.pipe()
        os.close(reading)
        command = [sys.executable, '-m', 'anser_ros.cli.main', '--help']
        done = subprocess.run(
            command, stdout=writing, stderr=subprocess.PIPE, cwd=REPO, check=False
        )
        os.close(writing)
        assert (done.returncode, done.stderr) == (0, b'')
