"""Every command has help with an example, a document for programs, progress, and a page."""

import importlib
import re
import shlex
from dataclasses import fields

import pytest
from conftest import REPO
from rclpy.utilities import remove_ros_args

from anser_ros.cli.commands import COMPOSED, NODES, OFFLINE
from anser_ros.cli.main import main

DOCS = REPO / 'docs'
OWN_WORDS = {
    'demo': 'its live table',
    'loop': 'a line a step',
    'measured': 'the commands that it runs',
    'paper': 'a bar for each recording',
    'setup': 'its questions',
    'views': 'two small files are written at once',
    'warm_up': 'a line every five seconds',
}
"""Commands that show how far they are by other means than `cli.progress`."""
# Of a line of the table: the command and the page that tells more of it.
ROW = re.compile(r'^\| `(\w+)` \| .+ \| \[.+\]\(([\w/.]*)(#[\w-]*)?\) \|$', re.MULTILINE)


def help_of(command, capsys):
    assert main([*command, '--help']) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize('name', OFFLINE)
def test_help_has_an_example_and_a_document_for_programs(name, capsys):
    text = help_of([name], capsys)
    assert re.search(rf'\bexamples?: +anser {name}\b', ' '.join(text.split()))
    verbs = ['calibrate', 'evaluate', 'diagnose'] if name == 'batch' else []
    for words in [help_of([name, verb], capsys) for verb in verbs] or [text]:
        assert '--json' in words


@pytest.mark.parametrize('name', OFFLINE)
def test_what_takes_long_says_how_far_it_is(name):
    text = (REPO / 'anser_ros' / 'cli' / f'{name}.py').read_text(encoding='utf-8')
    told = re.search(r'^    (with progress_of|return carry_out)\(', text, re.MULTILINE)
    assert bool(told) != (name in OWN_WORDS)


def test_every_command_has_a_page():
    text = (DOCS / 'commands.md').read_text(encoding='utf-8')
    rows = {name: page or 'commands.md' for name, page, _ in ROW.findall(text)}
    assert set(rows) == {*NODES, *COMPOSED, *OFFLINE}
    for name, page in rows.items():
        words = (DOCS / page).read_text(encoding='utf-8')
        named = rf'anser {name}\b|anser_ros {name}\b|`{name}`|make {name}\b'
        assert re.search(named, words), f'{page} says nothing of {name}'


@pytest.mark.parametrize('name', [*NODES, *COMPOSED])
def test_the_help_of_a_node_has_an_example_that_holds(name, capsys):
    process = importlib.import_module('anser_ros.nodes.runtime.process')
    module = importlib.import_module(f'anser_ros.nodes.{name}')
    classes = getattr(module, 'CHAIN', None) or tuple(
        kind for kind in vars(module).values() if getattr(kind, 'NAME', '') == name
    )
    with pytest.raises(SystemExit) as leaving:
        process.main(classes, [name, '--help'], name=name)
    assert leaving.value.code == 0
    text = capsys.readouterr().out
    (line,) = re.findall(rf'^example: anser {name} (.+)$', text, re.MULTILINE)
    known = {field.name for field in fields(classes[0].PARAMETERS)}
    assert set(re.findall(r'-p (?:\w+:)?(\w+):=', line)) <= known
    assert '-p ' in line or name == 'replay'
    # Raises where ROS cannot read what a shell makes of it.
    remove_ros_args([name, *shlex.split(line)])
