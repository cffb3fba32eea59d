"""The documentation is a site that builds without a warning, and its pages say what is so."""

import doctest
import re
import subprocess
import sys

import pytest
from conftest import REPO

from anser_ros.api.recording import load_setup
from anser_ros.cli.commands import COMPOSED, NODES, OFFLINE
from anser_ros.effects.effect import all_effects
from anser_ros.field.model import EffectRecord
from anser_ros.physics.board import KINDS
from anser_ros.pose_states import STATES
from anser_ros.sessions.diagnosis import DEPENDENCIES, TrackingErrors, document_of, effect_figures
from anser_ros.sessions.starting_model import board_of
from anser_ros.wire.points import flux_fields
from anser_ros.wire.setup import KEYS

DOCS = REPO / 'docs'
# Builds the site where no socket can be opened.
BUILD = """
import socket, sys
def refused(*_arguments, **_options):
    raise OSError('the documentation must not need a network')
socket.socket.connect = socket.getaddrinfo = refused
from sphinx.cmd.build import main
sys.exit(main(['-W', '--keep-going', '-q', '-j', '1', '-b', 'html', *sys.argv[1:]]))
"""


def page(name):
    return (DOCS / f'{name}.md').read_text(encoding='utf-8')


@pytest.mark.processes
def test_the_site_builds_without_warnings_and_without_a_network(tmp_path):
    """The newest requirements have Sphinx; the oldest, those of a distribution, do not."""
    for library in ('sphinx', 'myst_parser', 'furo'):
        pytest.importorskip(library)
    command = [sys.executable, '-c', BUILD, str(DOCS), str(tmp_path / 'site')]
    done = subprocess.run(command, capture_output=True, text=True, cwd=REPO, check=False)
    assert (done.returncode, done.stdout + done.stderr) == (0, '')
    site = tmp_path / 'site'
    assert 'write_session' in (site / 'api.html').read_text(encoding='utf-8')
    foreign = re.compile(r'<(?:script|link|img)[^>]+(?:src|href)="(?:https?:)?//')
    for html in site.rglob('*.html'):
        assert not foreign.search(html.read_text(encoding='utf-8')), html.name


@pytest.mark.parametrize('name', ['api', 'setup', 'start'])
def test_python_on_the_pages_runs(name, tmp_path, monkeypatch):
    for folder in ('bags', 'config'):
        (tmp_path / folder).symlink_to(REPO / folder)
    monkeypatch.chdir(tmp_path)
    outcome = doctest.testfile(str(DOCS / f'{name}.md'), module_relative=False)
    assert outcome.failed == 0 and outcome.attempted > 0


class TestSetupPage:
    SENSOR = """
sensors:
- {channel: 0, name: pen/tip, body: pen, position_m: [0, 0, 0], axis: [0, 0, 1]}
"""

    def examples(self):
        return re.findall(r'```yaml\n(.*?)```', page('setup'), re.DOTALL)

    def test_every_kind_has_an_example_that_draws(self):
        drawn = set()
        for text in self.examples():
            if 'kind:' not in text:
                continue
            whole = text if 'schema:' in text else None
            setup = load_setup(
                whole or f'schema: anser_setup/1\nflux_rate_hz: 50\n{text}{self.SENSOR}'
            )
            board = board_of(setup)
            assert abs(board.field([[0.0, 0.0, 0.1]])).max(axis=(0, 2)).all()
            drawn.add(setup.emitter.kind)
        assert drawn == set(KINDS)

    def test_every_kind_and_key_is_on_the_page(self):
        code = ''.join(
            (REPO / 'anser_ros' / place).read_text(encoding='utf-8')
            for place in ('wire/setup.py', 'physics/board.py')
        )
        keys = set(re.findall(r"\b_?(?:take|number|whole)\(\w+, '(\w+)'", code))
        keys |= set(re.findall(r"\.get\('(\w+)'", code))
        assert {'channel', 'pitch_m', 'rotation_deg', 'sides'} <= keys
        for key in keys | set(KINDS) | set(KEYS):
            assert f'`{key}`' in page('setup'), key


class TestInterfacesPage:
    def test_every_schema_has_a_row(self):
        schema = re.compile(r'anser_[a-z_]+/\d+')
        files = (REPO / 'anser_ros').rglob('*.py')
        written = {name for file in files for name in schema.findall(file.read_text('utf-8'))}
        rows = re.findall(r'^\| `anser_.*', page('interfaces'), re.MULTILINE)
        assert written == set(schema.findall('\n'.join(rows)))

    def test_the_flux_layout(self):
        text = page('interfaces')
        fields, step = flux_fields(8)
        assert f'({step} with eight emitters)' in text
        assert 'point_step` 28 + 8 K' in text and step == 28 + 8 * 8
        rows = dict(
            re.findall(r'^\| (`x`.*?|`nx`.*?|`channel`|`flags`) \| ([\d, ]+) \|', text, re.M)
        )
        told = {
            name: int(offset)
            for names, offsets in rows.items()
            for name, offset in zip(re.findall(r'`(\w+)`', names), offsets.split(','), strict=True)
        }
        assert told == {name: offset for name, offset, _, _ in fields if offset < 28}
        assert fields[8][:2] == ('coil0_re', 28) and fields[9][:2] == ('coil0_im', 32)

    def test_every_effect_with_its_parameters(self):
        rows = dict(re.findall(r'^\| (`\w+`(?:, `\w+`)?) \| (.*?) \|', page('interfaces'), re.M))
        told = {n: cell for names, cell in rows.items() for n in re.findall(r'`(\w+)`', names)}
        for name, effect in all_effects().items():
            assert name in told, f'{name} is not on the page'
            for parameter in effect.units:
                assert f'`{parameter}`' in told[name], f'{name}: {parameter} is not on the page'

    def test_states_nodes_and_commands(self):
        text = page('interfaces')
        for name in (*STATES, *NODES, *COMPOSED, *OFFLINE):
            assert re.search(rf'`{name}`|anser {name}', text), name

    def test_every_service(self):
        nodes = (REPO / 'anser_ros').glob('**/nodes/**/*.py')
        code = ''.join(path.read_text(encoding='utf-8') for path in nodes)
        services = re.findall(r"create_service\(\w+, '([\w/]+)'", code)
        assert services
        for service in services:
            assert service in page('interfaces')

    def test_every_key_of_a_diagnosis(self):
        nothing = ((0.0,) * 3, TrackingErrors(), TrackingErrors())
        effect = effect_figures(EffectRecord('sensor_gain', {}), 0.0)
        document = document_of(*nothing, [effect], 0.0, [])
        section = page('interfaces').split('### diagnosis.json')[1].split('\n## ')[0]
        parts = document, document['held_out'], effect, document['unexplained']
        assert {key for part in parts for key in part} <= set(re.findall(r'`(\w+)`', section))

    def test_what_the_diagnosis_depends_on(self):
        for name in DEPENDENCIES:
            assert f'`{name}`' in page('interfaces')
