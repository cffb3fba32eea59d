"""Views of RViz and Foxglove are made of the setup document, in any namespace."""

import json
from pathlib import Path

import pytest
import yaml

from anser_ros.cli.main import main

CONFIG = Path(__file__).resolve().parents[1] / 'config'
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


def test_a_namespace_that_is_none(tmp_path, capsys):
    command = ['views', 'demo_setup.yaml', '--out', str(tmp_path), '--namespace']
    for name in ('', 'a b', '1x', 'a//b'):
        assert main([*command, name]) == 2
        assert 'is not a namespace' in capsys.readouterr().err
