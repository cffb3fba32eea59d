"""`anser setup` and `anser views`: documents by options and tables, checked and drawn."""

import json
import runpy
import sys
from unittest.mock import MagicMock

import pytest
import yaml
from conftest import REPO

from anser_ros.cli.main import main
from anser_ros.cli.setup import GEOMETRY, coil_of, document_of, emitter_of, text_of
from anser_ros.physics.board import KINDS
from anser_ros.sessions.starting_model import board_of
from anser_ros.wire.setup import parse_setup

SENSORS = ('0,pen/tip,pen,0,0,0,z', '1,pen/back,pen,0,0,-40,x,8', '16,ref/0,fg,150,0,20,1 0 1')
COILS = ('-80,0,0,0,1000', '80,0,0,0,1200', '0,80,0,30,1400')


def options(folder):
    geometry = [f'--geometry={entry}' for entry in ('radius_m=0.04', 'turns=60', 'current_a=0.2')]
    coils = [f'--coil={text}' for text in COILS]
    sensors = [f'--sensor={text}' for text in SENSORS]
    return ['setup', '--board', 'circular_loop', *geometry, *coils, *sensors, '--out', str(folder)]


@pytest.mark.long
def test_options_make_a_document_and_a_picture(tmp_path, capsys):
    assert main([*options(tmp_path), '--volume=-100,-100,50,100,100,250', '--json']) == 0
    out, said = capsys.readouterr()
    setup = parse_setup((tmp_path / 'setup.yaml').read_text())
    assert [coil.centre_m for coil in setup.emitter.coils][2] == (0.0, 0.08, 0.0)
    assert setup.emitter.coils[2].rotation_deg == 30.0
    back = setup.sensors[1]
    assert (back.channel, back.position_m, back.length_m) == (1, (0.0, 0.0, -0.04), 0.008)
    assert setup.reference_sensors[0].axis == pytest.approx((0.5**0.5, 0.0, 0.5**0.5))
    assert setup.volume == ((-0.1, -0.1, 0.05), (0.1, 0.1, 0.25))
    assert (tmp_path / 'setup.png').read_bytes()[:4] == b'\x89PNG'
    document = json.loads(out)
    assert len(document['files']) == 2
    assert any('single coil' in line for line in document['advice'])
    assert 'reference coils' in said
    assert main(['setup', str(tmp_path / 'setup.yaml'), '--out', str(tmp_path / 'again')]) == 0
    assert (tmp_path / 'again' / 'setup.png').exists()
    assert not (tmp_path / 'again' / 'setup.yaml').exists()


def test_a_document_that_is_there_is_not_written_over(tmp_path, capsys):
    assert main(options(tmp_path)) == 0
    stated = (tmp_path / 'setup.yaml').read_text()
    assert main([*options(tmp_path), '--rate=25']) == 2
    assert 'setup.yaml is there already' in capsys.readouterr().err
    assert (tmp_path / 'setup.yaml').read_text() == stated


def test_tables_are_taken_as_rows(tmp_path, capsys):
    (tmp_path / 'tool.csv').write_text(
        'channel,name,body,axis,x_mm,y_mm,z_mm\n0,pen/tip,pen,-z,1,2,3\n1,pen/b,pen,0 3 4,0,0,9\n'
    )
    command = ['setup', '--board', 'anser', '--sensors', str(tmp_path / 'tool.csv')]
    assert main([*command, '--set', 'flux_noise_t=5e-11', '--out', str(tmp_path)]) == 0
    setup = parse_setup((tmp_path / 'setup.yaml').read_text())
    assert len(setup.emitter.coils) == 8 and setup.accuracy.flux_noise_t == 5e-11
    assert [s.axis for s in setup.sensors] == [(0.0, 0.0, -1.0), (0.0, 0.6, 0.8)]
    assert setup.sensors[0].position_m == (0.001, 0.002, 0.003)
    (tmp_path / 'tool.csv').write_text('channel,name\n0,a\n')
    assert main([*command, '--out', str(tmp_path / 'no')]) == 2
    assert 'columns must be channel,name,body' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('change', 'said'),
    [
        (['--sensor', '0,a/b,a,0,0,0,z'], 'channel 0 appears twice'),
        (['--coil', '0,0,0,0'], 'takes 5 numbers'),
        (['--geometry', 'side_m=x'], 'must be a number'),
        (['--sensor', '1,b/b,b,0,0,0,q'], 'axis is x, -x'),
        (['--volume', '0,0,0'], '--volume takes 6 numbers'),
        (['config/demo_setup.yaml'], 'a setup document is complete'),
    ],
)
def test_what_is_wrong_is_one_line_and_nothing_is_written(tmp_path, capsys, change, said):
    assert main([*options(tmp_path), *change]) == 2
    words = capsys.readouterr().err
    assert said in words and words.count('\n') == 1
    assert not (tmp_path / 'setup.yaml').exists()


def test_what_is_stated_draws_every_kind_of_board():
    assert set(GEOMETRY) == set(KINDS)
    sizes = {'turns': 10, 'layers': 2, 'pitch_m': 0.001}
    for kind, keys in GEOMETRY.items():
        geometry = {key: sizes.get(key, 0.05) for key in keys}
        emitter = emitter_of(kind, geometry, [coil_of('one', '0 0 0 0 1000')])
        sensor = {'channel': 0, 'name': 'a/b', 'body': 'a', 'position_m': [0, 0, 0],
                  'axis': [0, 0, 1]}  # fmt: skip
        _, setup = text_of(document_of(emitter, [sensor], 50.0, None, {}))
        assert board_of(setup).field([[0.0, 0.0, 0.1]]).any()


def test_a_folder_that_takes_no_file_is_found_before_the_work(capsys):
    """Permissions allow root all; what matters is whether a file can be made."""
    for command in (
        ['setup', 'config/demo_setup.yaml', '--out', '/proc'],
        ['calibrate', str(REPO / 'bags' / 'scan.mcap'), '--out', '/proc/model.yaml'],
        ['import_poses', 'none.tsv', '--out', '/proc/session.mcap'],
    ):
        assert main(command) == 2
        assert 'nothing can be written into /proc' in capsys.readouterr().err


CONFIG = REPO / 'config'
FILES = ('anser.rviz', 'foxglove_layout.json')
TWO_TOOLS = """
schema: anser_setup/1
frame_id: fg
flux_rate_hz: 50
flux_unit: T
emitter:
  kind: square_spiral_pcb
  turns: 25
  side_m: 0.07
  pitch_m: 0.00075
  layers: 2
  thickness_m: 0.0016
  current_a: 0.1
  coils:
  - {name: a, centre_m: [0.2, 0.0, 0.0], rotation_deg: 0.0, frequency_hz: 20500.0}
sensors:
- {channel: 1, name: pen/tip, body: pen, position_m: [0, 0, 0], axis: [1, 0, 0]}
- {channel: 2, name: probe/0/x, body: probe, position_m: [0, 0, 0], axis: [1, 0, 0]}
- {channel: 3, name: probe/0/z, body: probe, position_m: [0, 0, 0], axis: [0, 0, 1]}
"""


def test_the_files_of_config_are_those_of_the_demo(tmp_path):
    """`anser views demo_setup.yaml --out config` writes them."""
    assert main(['views', str(CONFIG / 'demo_setup.yaml'), '--out', str(tmp_path)]) == 0
    for name in FILES:
        assert (tmp_path / name).read_text() == (CONFIG / name).read_text(), name


def test_another_board_in_another_namespace(tmp_path, capsys):
    (tmp_path / 'two.yaml').write_text(TWO_TOOLS)
    command = ['views', str(tmp_path / 'two.yaml'), '--out', str(tmp_path), '--json']
    options = ['--namespace', 'or/left', '--optical', '/left/optical', '--frame-prefix', 'left_']
    assert main([*command, *options]) == 0
    assert len(json.loads(capsys.readouterr().out)['files']) == 2
    rviz, foxglove = ((tmp_path / name).read_text() for name in FILES)
    manager, layout = yaml.safe_load(rviz)['Visualization Manager'], json.loads(foxglove)
    shown = {d['Topic']['Value']: d for d in manager['Displays'] if 'Topic' in d}
    assert set(shown) == set(layout['configById']['3D!tool']['topics']) == {
        '/or/left/probe/pose_with_covariance', '/left/optical/pen/pose',
        '/left/optical/probe/pose', '/or/left/pen/tip/pose', '/or/left/probe_0/x/pose',
        '/or/left/probe_0/z/pose', '/or/left/field_model', '/or/left/reference/flux',
        '/or/left/metal',
    }  # fmt: skip
    assert shown['/or/left/pen/tip/pose']['Enabled'], 'the only coil of its body'
    assert not shown['/or/left/probe_0/x/pose']['Enabled']
    assert shown['/or/left/metal']['Class'] == 'rviz_default_plugins/MarkerArray'
    assert shown['/or/left/metal']['Topic']['Durability Policy'] == 'Transient Local'
    assert not any(word in rviz + foxglove for word in ('tool_a', '/anser', '"anser/'))
    assert manager['Global Options']['Fixed Frame'] == 'left_fg'
    grid = manager['Displays'][0]
    assert grid['Plane Cell Count'] * grid['Cell Size'] == pytest.approx(0.5)


def test_the_scene_of_slicer_hides_a_tool_without_a_pose(tmp_path, monkeypatch, capsys):
    """Run with stand-ins of Slicer's modules, which are not here."""
    command = ['views', str(tmp_path / 'two.yaml'), '--out', str(tmp_path), '--slicer']
    for name, said in (
        ('probe_of_the_other_board', 'is cut to e_of_the_other_board'),
        ('probe', ''),
    ):
        (tmp_path / 'two.yaml').write_text(TWO_TOOLS.replace('probe', name))
        assert main(command) == 0
        assert said in capsys.readouterr().err
    modules = {name: MagicMock() for name in ('qt', 'slicer', 'vtk')}
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    slicer = modules['slicer']
    slicer.mrmlScene.AddNewNodeByClass.side_effect = lambda *_: MagicMock()
    scene = runpy.run_path(str(tmp_path / 'slicer_view.py'))
    devices = {device.name: device for device in scene['anser_devices']}
    assert list(devices) == ['pen', 'probe', 'pen/tip', 'probe/0/x', 'probe/0/z']
    slicer.mrmlScene.AddNewNodeByClass.assert_called_with('vtkMRMLIGTLConnectorNode', 'anser')
    pen, model, other = devices['pen'], MagicMock(), MagicMock()
    model.GetTransformNodeID.return_value = pen.transform.GetID.return_value
    slicer.util.getNodesByClass.return_value = [model, other]

    def seen(state=None):
        if state is not None:
            pen.text.GetText.return_value = state
            pen.on_state()
        return model.SetDisplayVisibility.call_args.args[0]

    pen.show()
    assert not seen()
    pen.on_pose()
    assert not seen('no pose yet') and seen('ok') and not seen('residual')
    assert slicer.util.showStatusMessage.call_args.args == ('pen: residual',)
    assert seen('ok')
    pen.on_silence()
    assert not seen(), 'the connection may be gone'
    other.SetDisplayVisibility.assert_not_called()


def test_a_namespace_that_is_none(tmp_path, capsys):
    command = ['views', 'demo_setup.yaml', '--out', str(tmp_path), '--namespace']
    for name in ('', 'a b', '1x', 'a//b'):
        assert main([*command, name]) == 2
        assert 'is not a namespace' in capsys.readouterr().err
