"""Every command has help with an example, a document for programs, progress, and a page."""

import argparse
import importlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import fields

import pytest
from conftest import REPO
from rclpy.utilities import remove_ros_args
from shortened import beginning

from anser_ros.cli import output
from anser_ros.cli.commands import COMPOSED, NODES, OFFLINE
from anser_ros.cli.main import main
from anser_ros.cli.output import LINE_INTERVAL_S, progress_of

DOCS = REPO / 'docs'
NOWHERE = '/nowhere/x'
WRONG = {
    'accuracy': ['rest', NOWHERE],
    'calibrate': [NOWHERE, '--out', 'x.yaml'],
    'compare': [NOWHERE, NOWHERE],
    'demo': ['--duration', '-1'],
    'diagnose': [NOWHERE, '--model', NOWHERE, '--out', 'x'],
    'doctor': ['--seconds', 'nan'],
    'error_map': [NOWHERE, '--out', 'x'],
    'evaluate': [NOWHERE, '--model', 'nominal', '--out', 'x'],
    'export': [NOWHERE, '--out', 'x'],
    'handeye': [NOWHERE],
    'import': [NOWHERE, '--out', 'x.mcap'],
    'import_poses': [NOWHERE, '--out', 'x.mcap'],
    'loop': ['--duration', '-1'],
    'measured': ['gremlin'],
    'paper': ['--sessions', NOWHERE, '--out', 'x'],
    'pivot': [NOWHERE],
    'place': [NOWHERE, '--references', '4', '--out', 'x'],
    'plan': [NOWHERE],
    'setup': [NOWHERE, '--out', 'x'],
    'views': [NOWHERE, '--out', 'x'],
    'warm_up': ['--gremlin'],
}
"""Arguments of every command that it must refuse."""
POINTS = 'x_m,y_m,z_m,true_x_m,true_y_m,true_z_m\n' + ''.join(
    f'{x},{y},{z},{1.01 * x},{1.01 * y},{1.01 * z}\n'
    for x in (0, 0.1, 0.2) for y in (0, 0.1) for z in (0.1, 0.2)
)  # fmt: skip
RUN = ['accuracy', 'error_map', 'evaluate', 'compare', 'export', 'handeye', 'import',
       'import_poses', 'pivot', 'setup', 'views']  # fmt: skip
"""Commands whose examples are quick; those of the others are run by tests of their own, or of
the documents."""
NOT_TEXT = [
    ['accuracy', 'single-point', 'poses.tum', '--tip', 'noise.yaml'],
    ['accuracy', 'point-to-point', 'poses.tum', '--truth', 'noise.yaml'],
    ['error_map', 'noise.yaml'],
    ['import', 'noise.yaml'],
    ['import', 'BAGS/moving.mcap', '--setup', 'noise.yaml'],
    ['pivot', 'poses.tum', '--setup', 'noise.yaml'],
    ['place', 'noise.yaml', '--references', '4'],
    ['setup', 'noise.yaml'],
    ['views', 'noise.yaml'],
]
"""Calls whose file `noise.yaml` is no text."""
SECRET = [
    ['export', 'secret.mcap', '--out', 'out'],
    ['import', 'secret.mcap', '--out', 'out/a.mcap'],
    ['import', 'secret.yaml', '--out', 'out/a.mcap'],
    ['pivot', 'secret.csv', '--out', 'out'],
    ['views', 'secret.yaml', '--out', 'out'],
    ['export', 'BAGS/moving.mcap', '--out', 'closed/out'],
]
"""Calls with a file that may not be read, or a folder that may not be written."""
QUICK = {
    'bag_export': ['export', 'BAGS/moving.mcap', '--out', 'out'],
    'bag_import': ['import', 'BAGS/moving.mcap', '--out', 'out/a.mcap'],
    'error_map': ['error_map', 'points.csv', '--out', 'out'],
    'import_poses': ['import_poses', 'poses.tum', '--out', 'out/b.mcap'],
    'setup': ['setup', 'demo_setup.yaml', '--out', 'out'],
    'views': ['views', 'demo_setup.yaml', '--out', 'out'],
}
"""Calls that take less than a second; the documents of the others are tested with their work."""
# Of a line of the table: the command and the page that tells more of it.
ROW = re.compile(r'^\| `(\w+)` \| .+ \| \[.+\]\(([\w/.]*)(#[\w-]*)?\) \|$', re.MULTILINE)


def examples_of(name):
    """Yield the parser of a command, and the arguments of each of its examples."""
    module = importlib.import_module(OFFLINE[name][0])
    parser = argparse.ArgumentParser(prog=name, exit_on_error=False)
    module.add_arguments(parser)
    lines = re.split(
        rf'anser {name}\b', ' '.join(re.split(r'\bexamples?: ', parser.epilog)[-1].split())
    )
    for line in lines[1:]:
        # Each but the last ends with a semicolon, or with words in brackets.
        yield parser, shlex.split(re.sub(r'\([^)]*\)', '', line).partition(';')[0])


@pytest.mark.parametrize('name', OFFLINE)
def test_help_has_examples_that_hold_and_a_document_for_programs(name, capsys):
    assert main([name, '--help']) == 0
    assert '--json' in capsys.readouterr().out
    found = list(examples_of(name))
    assert found
    for parser, arguments in found:
        parser.parse_args(arguments)


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_the_first_example_runs_as_it_is_written(tmp_path, monkeypatch, capsys):
    for folder in ('config', 'examples'):
        (tmp_path / folder).symlink_to(REPO / folder)
    shutil.copytree(REPO / 'bags', tmp_path / 'bags', ignore=lambda *_: ['metal.mcap'])
    beginning(REPO / 'bags' / 'metal.mcap', tmp_path / 'bags' / 'metal.mcap', 3.0)
    monkeypatch.chdir(tmp_path)
    kept = {tmp_path / name for name in ('bags', 'refit', 'frozen')}
    for name in RUN:
        _, arguments = next(examples_of(name))
        assert main([name, *arguments]) == 0, (name, capsys.readouterr().err)
        for made in {*tmp_path.iterdir()} - kept:
            if not made.is_symlink():
                shutil.rmtree(made) if made.is_dir() else made.unlink()
        if name == 'evaluate':
            words = ['bags/metal.mcap', '--model', 'config/demo_model.yaml', '--out', 'frozen/']
            assert main([name, *words]) == 0


@pytest.mark.parametrize('name', OFFLINE)
def test_what_is_wrong_is_one_line_and_exit_code_2(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([name, *WRONG[name], '--json']) == 2
    said = capsys.readouterr()
    assert said.out == '' and said.err.count('\n') == 1, said
    assert said.err.startswith(f'anser {name}') and 'Errno' not in said.err
    assert list(tmp_path.iterdir()) == [], 'not even an empty folder is left'


@pytest.mark.parametrize('words', NOT_TEXT, ids=' '.join)
def test_a_file_that_is_no_text_is_one_line_and_exit_code_2(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'noise.yaml').write_bytes(bytes(range(256)) * 8)
    (tmp_path / 'poses.tum').write_text(''.join(f'{k} 0.1 0 {k} 0 0 0 1\n' for k in range(9)))
    before = sorted(tmp_path.iterdir())
    arguments = [word.replace('BAGS', str(REPO / 'bags')) for word in words]
    assert main([*arguments, '--out', 'out/x']) == 2
    assert capsys.readouterr().err == f'anser {words[0]}: noise.yaml: not a text in UTF-8\n'
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.processes
@pytest.mark.parametrize('words', SECRET, ids=' '.join)
def test_a_file_without_permission_is_one_line_and_exit_code_2(words, tmp_path):
    for name in ('secret.mcap', 'secret.csv', 'secret.yaml'):
        (tmp_path / name).touch(mode=0)
    (tmp_path / 'closed').mkdir(mode=0o555)
    call = [sys.executable, '-m', 'anser_ros.cli.main', *words]
    call = [word.replace('BAGS', str(REPO / 'bags')) for word in call]
    if os.geteuid() == 0:  # who may do everything, unless that right is taken away
        for path in tmp_path.iterdir():
            os.chown(path, 1, 1)
        call = ['setpriv', '--bounding-set=-all', *call]
    search = {**os.environ, 'PYTHONPATH': str(REPO)}
    done = subprocess.run(call, cwd=tmp_path, env=search, capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    assert done.stderr.count('\n') == 1 and 'Permission denied' in done.stderr
    assert len(list(tmp_path.iterdir())) == 4, 'nothing is left behind'


def test_a_bag_of_another_form_or_with_other_names_is_refused_with_what_mends_it(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'other').mkdir()
    (tmp_path / 'other' / 'other.db3').touch()
    assert main(['export', 'other', '--out', 'out']) == 2
    assert 'other.db3: not a bag in sqlite3' in capsys.readouterr().err
    names = ['/anser/tool/flux:=/em/flux', '/anser/reference/flux:=/em/still']
    remaps = [word for name in names for word in ('--remap', name)]
    assert main(['import', str(REPO / 'bags/moving.mcap'), *remaps, '--out', 'a.mcap']) == 0
    assert main(['evaluate', 'a.mcap', '--model', 'nominal', '--out', 'out']) == 2
    assert '--remap /em/flux:=/anser/tool/flux' in capsys.readouterr().err


def test_an_export_says_what_the_bag_has_lost(tmp_path, capsys):
    whole = (REPO / 'bags' / 'moving.mcap').read_bytes()
    (tmp_path / 'half.mcap').write_bytes(whole[: 7 * len(whole) // 10])
    half, out = str(tmp_path / 'half.mcap'), str(tmp_path / 'out')
    assert main(['export', half, '--out', out, '--json']) == 0
    said = capsys.readouterr()
    assert said.err.count('breaks off') == 1 and json.loads(said.out)['lost'] in said.err


@pytest.mark.parametrize('arguments', QUICK.values(), ids=QUICK)
def test_json_is_one_document_whose_schema_the_pages_name(
    arguments, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'points.csv').write_text(POINTS)
    (tmp_path / 'poses.tum').write_text(
        ''.join(f'{1e9 + k} 0.1 0 {k} 0 0 0 1\n' for k in range(9))
    )
    words = [word.replace('BAGS', str(REPO / 'bags')) for word in arguments]
    code = main([*words, '--json'])
    said = capsys.readouterr()
    assert code == 0, said.err
    document = json.loads(said.out, parse_constant=pytest.fail)
    pages = [
        (DOCS / page).read_text(encoding='utf-8') for page in ('commands.md', 'interfaces.md')
    ]
    assert any(f'`{document["schema"]}`' in page for page in pages)


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
    module = importlib.import_module({**NODES, **COMPOSED}[name][0])
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
    assert '-p ' in line or name in ('grid', 'replay')
    # Raises where ROS cannot read what a shell makes of it.
    remove_ros_args([name, *shlex.split(line)])


@pytest.fixture
def now_s(monkeypatch):
    """The time by the clock, s, in a list."""
    now = [100.0]
    monkeypatch.setattr(output.time, 'monotonic', lambda: now[0])
    return now


def test_lines_come_now_and_then_with_the_share_and_the_time_that_is_left(now_s, capsys):
    with progress_of('calibrating') as tell:
        for step in range(1, 11):
            now_s[0] += 0.4 * LINE_INTERVAL_S
            tell('layouts' if step < 7 else 'positions', 0.1 * step)
    said = capsys.readouterr().err.splitlines()
    assert said[0] == 'calibrating: layouts, 30%, about 14 s left'
    stages = [line.split(',')[0].removeprefix('calibrating: ') for line in said]
    assert stages == ['layouts', 'layouts', 'positions']


def test_no_time_is_told_that_loading_and_compiling_would_make(now_s, capsys):
    """The first frame of a session takes as long as the kernels need to be there."""
    with progress_of('evaluating') as tell:
        now_s[0] += 25.0
        for frame in range(1, 201):
            tell('tracking', frame / 200)
            now_s[0] += 0.1
    said = capsys.readouterr().err.splitlines()
    assert said[0] == 'evaluating: tracking, 0%'
    left = [float(line.split('about ')[1].split(' s')[0]) for line in said[1:]]
    assert len(left) > 2
    assert all(abs(had + 5.0 * rank - left[0]) < 1.5 for rank, had in enumerate(left))


def test_a_short_command_says_nothing_and_a_long_stage_a_line(now_s, capsys):
    with progress_of('evaluating') as tell:
        tell('tracking', 0.5)
    assert capsys.readouterr() == ('', '')
    with progress_of('diagnosing') as tell:
        tell('a first look')
        now_s[0] += 12.0
        tell('joint fit')
    assert capsys.readouterr().err == 'diagnosing: joint fit, after 12 s\n'
