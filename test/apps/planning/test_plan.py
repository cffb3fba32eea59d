"""What an effort of calibration buys is told before it is made, and is what it then buys."""

import json

import numpy as np
from conftest import REPO
from test_drawn_calibration import NOISE_T, World, calibrated

from anser_ros.apps.planning.cli.plan import pose_sigmas
from anser_ros.cli.main import main
from anser_ros.refit.clouds import region_of
from anser_ros.sessions.session import load_session


def test_efforts_stand_in_order_and_are_drawn(tmp_path, capsys):
    words = ['plan', 'demo_setup.yaml', '--out', str(tmp_path), '--json']
    assert main(words) == 0
    document = json.loads(capsys.readouterr().out)
    assert document['schema'] == 'anser_plan/1' and document['body'] == 'tool_a'
    field_mm = [1e3 * row['field_m'] for row in document['efforts']]
    assert len(field_mm) == 6 and (np.diff(field_mm) < 0.0).all(), field_mm
    assert field_mm[0] > 2.0 and field_mm[2] < 0.2 and field_mm[5] < 0.06
    one, two = (np.array(row['field_by_height_m']) for row in document['efforts'][1:3])
    assert one[-1] / one[1] > two[-1] / two[1] > 1.5  # it grows above the plates
    assert (tmp_path / 'plan.png').stat().st_size > 10_000


def test_errors_of_calibrated_boards_are_as_large_as_their_models_say():
    setup, found = load_session(REPO / 'bags' / 'factory.mcap').setup, []
    for seed in (11, 12, 13):
        world = World(setup, seed)
        model = calibrated(world.grid((0.084, 0.15))).model
        sigma = pose_sigmas(model, region_of(world.board.field), NOISE_T)['field_m']
        found.append(world.error_m(model)[1] / sigma)
    assert 0.3 < np.sqrt(np.mean(np.square(found))) < 1.2, found
