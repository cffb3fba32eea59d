"""What a newcomer is told and given: files that are named exist, hooks run without network."""

import re
import subprocess
import sys

import pytest
from conftest import REPO

from anser_ros.cli.commands import OFFLINE

pytestmark = pytest.mark.long

TEXT = (REPO / 'CONTRIBUTING.md').read_text()
CHECK = REPO / '.ci' / 'check_yaml.py'


OWN = re.compile(r'NAME|NODE|STAGE|Your\w+')
"""What stands for the newcomer's own names."""
PLACES = '', 'anser_ros', 'docs'


def files_of(path):
    """The files that a path means, from the repository, the package or the documents."""
    pattern = OWN.sub('*', path.rstrip('/'))
    return [file for place in PLACES for file in (REPO / place).glob(pattern)]


def is_path(word):
    return bool(re.fullmatch(r'[\w.-]+/[\w./-]*|[\w-]+\.(md|rst|py|xml|yaml)|\.\w+', word))


def commands_there(word):
    """Whether a command's verb or target is there, and the tests that it runs; None for others."""
    program, *rest = word.split()
    if program == 'make':
        targets = re.findall(r'^([\w -]+):', (REPO / 'Makefile').read_text(), re.MULTILINE)
        return rest[0] in ' '.join(targets).split()
    if program == 'anser':
        return rest[0].startswith('-') or rest[0] in OFFLINE
    if program == 'pytest':
        files = [REPO / part for part in rest if part.endswith('.py')]
        wanted = rest[rest.index('-k') + 1].lower() if '-k' in rest else ''
        return all(file.exists() and wanted in file.read_text().lower() for file in files)
    return True if program == 'pip' else None


def missing(text):
    """Yield what stands in backticks, or in a link, and is not there.

    A file or folder exists, or is one that interfaces promise; a command has its verb; every other
    name stands in one of the files that its recipe names, or beside those that a newcomer makes.
    """
    promised = REPO / 'docs' / 'interfaces.md'
    for section in re.split('^##', text, flags=re.MULTILINE):
        words = re.findall(r'`([^`]+)`', section) + re.findall(r'\]\(([^)#:]+)\)', section)
        named = [file for word in words if is_path(word) for file in files_of(word)]
        named += [file for folder in named if not folder.name.startswith('.venv')
                  for file in folder.glob('**/*.py')]  # fmt: skip
        texts = [file.read_text() for file in [promised, *named] if file.is_file()]
        known = {word for one in texts for word in re.findall(r'[\w-]+', one)}
        for word in words:
            there = commands_there(word)
            if is_path(word):
                there = files_of(word) or f'`{word}`' in promised.read_text()
            elif there is None and not word.endswith('...'):
                there = known.issuperset(re.findall(r'[\w-]+', OWN.sub('', word.split(',')[0])))
            if there is not None and not there:
                yield word


def test_whatever_is_named_is_there():
    assert list(missing(TEXT)) == []


@pytest.mark.processes
def test_the_yaml_hook_names_what_cannot_be_read(tmp_path):
    good, bad = REPO / '.pre-commit-config.yaml', tmp_path / 'bad.yaml'
    bad.write_text('a: [1, 2\nb: 3\n')
    command = [sys.executable, str(CHECK), str(good)]
    assert subprocess.run(command, check=False).returncode == 0
    done = subprocess.run([*command, str(bad)], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stdout.startswith(f'{bad}: ') and done.stdout.count('\n') == 1
