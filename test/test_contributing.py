"""What a newcomer is told and given: files that are named exist, hooks run without network."""

import re
import subprocess
import sys

import pytest
import yaml
from conftest import REPO

TEXT = (REPO / 'CONTRIBUTING.md').read_text()
CHECK = REPO / '.ci' / 'check_yaml.py'


def named_paths():
    words = re.findall(r'[`(]([\w./-]+/[\w./-]+|[\w-]+\.(?:md|rst|py|xml))[`)]', TEXT)
    places = ('', 'anser_ros', 'docs')
    return sorted({(word, places) for word in words if not re.search('[A-Z]{4}', word)})


@pytest.mark.parametrize(('word', 'places'), named_paths())
def test_every_file_that_is_named_exists(word, places):
    assert any((REPO / place / word).exists() for place in places)


def test_there_are_recipes():
    assert len(named_paths()) > 20
    recipes = set(re.findall('^### (.*)$', TEXT, re.MULTILINE))
    wanted = {'An effect', 'A board', 'An output', 'A node parameter', 'A data set', 'A gate'}
    assert wanted | {"Another control unit's protocol"} <= recipes


def test_the_names_in_the_recipes_are_those_of_the_code():
    for path, names in {
        'wire/protocols.py': ('RecordReader', 'PROTOCOLS'),
        'cli/commands.py': ('NODES', 'OFFLINE'),
        'physics/board.py': ('KINDS',),
        'pose_states.py': ('STATES',),
        'tracking/estimate.py': ('TrackerSettings',),
        'cli/measured.py': ('RECIPES',),
        'tracking/solve_verdict.py': ('verdict',),
    }.items():
        code = (REPO / 'anser_ros' / path).read_text()
        for name in names:
            assert f'`{name}`' in TEXT and name in code, (path, name)


def test_the_hooks_use_what_make_has_installed():
    hooks = yaml.safe_load((REPO / '.pre-commit-config.yaml').read_text())['repos']
    assert [repo['repo'] for repo in hooks] == ['local']
    entries = {hook['id']: hook for hook in hooks[0]['hooks']}
    assert set(entries) == {'ruff-lint', 'ruff-format', 'mypy', 'yaml'}
    for hook in entries.values():
        assert hook['language'] == 'system' and hook['entry'].startswith('.venv/bin/')


@pytest.mark.processes
def test_the_yaml_hook_names_what_cannot_be_read(tmp_path):
    good, bad = REPO / '.pre-commit-config.yaml', tmp_path / 'bad.yaml'
    bad.write_text('a: [1, 2\nb: 3\n')
    command = [sys.executable, str(CHECK), str(good)]
    assert subprocess.run(command, check=False).returncode == 0
    done = subprocess.run([*command, str(bad)], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stdout.startswith(f'{bad}: ') and done.stdout.count('\n') == 1
