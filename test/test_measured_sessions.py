"""Sessions of measured data: what was measured stands in the bag, in the layout of sessions."""

import itertools
import json
import os
from pathlib import Path

import numpy as np
import pytest
from test_measured_hpi import COIL, MOMENT, helmet

from anser_ros.cli import measured
from anser_ros.cli.main import main
from anser_ros.errors import BagError, FitError
from anser_ros.measured import hpi_session, navion
from anser_ros.measured.hpi_coils import HpiData
from anser_ros.measured.session_file import write_frames
from anser_ros.sessions.session import load_session
from anser_ros.wire.setup import Coil, Emitter, SensorSpec, Setup

ROOT = Path(__file__).resolve().parents[1]
SHARED = Path(os.environ.get('ANSER_SHARED', ROOT.parent / 'shared'))
NAVION = SHARED / 'measured' / 'navion'
COILS = tuple(Coil(f'c{k}', (0.1 * k, 0.0, 0.0), 0.0, 1.0 + k) for k in range(3))


@pytest.fixture
def rng():
    return np.random.default_rng(7)


class TestFrames:
    def test_tools_move_and_references_stand_where_they_are(self, tmp_path, rng):
        sensors = (
            SensorSpec(4, 'fixed/0', 'fg', (0.1, 0.2, 0.3), (0.0, 0.6, 0.8), 0.0),
            SensorSpec(2, 'tool/0', 'tool', (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.0),
        )
        setup = Setup('fg', 1.0, Emitter('somebody', {}, COILS), sensors)
        flux = 1e-6 * (rng.normal(size=(2, 2, 3)) + 1j * rng.normal(size=(2, 2, 3)))
        place, turn = np.array([[0, 0, 0.1], [0, 0, 0.2]]), np.tile([0, 0, 0, 1.0], (2, 1))
        path = tmp_path / 'frames.mcap'
        write_frames(path, setup, [10, 20], flux, {'tool': (place, turn)})
        session = load_session(path)
        (tool,) = session.tools
        np.testing.assert_allclose(tool.flux[:, 0], flux[:, 1], rtol=1e-6)
        np.testing.assert_allclose(session.reference.flux[:, 0], flux[:, 0], rtol=1e-6)
        np.testing.assert_allclose(tool.position, place)
        assert session.setup.sensors[0] == sensors[0]
        with pytest.raises(BagError, match='already exists'):
            write_frames(path, setup, [10], flux)


def write_plate(folder, rng, signs):
    """Two heights of 2 x 2 sensors under combinations of currents, and a state without; mT."""
    field = rng.normal(size=(2, 3, 4, 3))
    lines = ['plane,sensor,state,x_m,y_m,z_m,I0_A,I1_A,I2_A,Bx_mT,By_mT,Bz_mT']
    for plane, z in enumerate((-0.05, 0.05)):
        for sensor, (x, y) in enumerate((x, y) for x in (-0.1, 0.1) for y in (-0.1, 0.1)):
            for state, sign in enumerate((*signs, (0, 0, 0))):
                reading = np.array(sign) @ field[plane, :, sensor] + [0.1, 0.2, 0.3]
                numbers = (x, y, z, *(35.0 * np.array(sign)), *reading)
                lines.append(
                    f'{plane},{sensor},{state},' + ','.join(map(repr, map(float, numbers)))
                )
    folder.mkdir()
    (folder / 'navion_steady.csv').write_text('\n'.join(lines))
    return 1e-3 * field


class TestNavion:
    SIGNS = tuple(itertools.product((-1, 1), repeat=3))

    def test_the_plate_is_a_tool_of_many_channels(self, tmp_path, rng):
        field = write_plate(tmp_path / 'data', rng, self.SIGNS)
        (path,) = navion.write_sessions(tmp_path / 'data', tmp_path / 'bags')
        (tool,) = load_session(path).tools
        assert tool.flux.shape == (2, 12, 3)
        # The reading of coil 2 by axis y of sensor 3 at the second height, without the offset.
        row = tool.sensors.name.index('plate/s3/y')
        assert tool.flux[1, row, 2].real == pytest.approx(field[1, 2, 3, 1], rel=1e-6)
        centres, axes = tool.placed()
        # Above the magnets, which are towards the data set's +y.
        np.testing.assert_allclose(centres[1, row], [0.1, 0.05, 0.19], atol=1e-12)
        np.testing.assert_allclose(axes[1, row], [0.0, 0.0, -1.0], atol=1e-12)

    def test_what_is_missing_is_named(self, tmp_path, rng):
        with pytest.raises(FitError, match=r'no such file: .*navion_steady\.csv'):
            navion.read(tmp_path)
        write_plate(tmp_path / 'few', rng, self.SIGNS[:-2])
        with pytest.raises(FitError, match='not all combinations of both signs'):
            navion.read(tmp_path / 'few')
        write_plate(tmp_path / 'cut', rng, self.SIGNS)
        path = tmp_path / 'cut' / 'navion_steady.csv'
        path.write_text('\n'.join(path.read_text().splitlines()[:-2]))
        with pytest.raises(FitError, match='63 rows, expected 64'):
            navion.read(tmp_path / 'cut')

    @pytest.mark.skipif(not NAVION.is_dir(), reason='no shared measured data')
    def test_the_real_data(self, tmp_path):
        (path,) = navion.write_sessions(NAVION, tmp_path / 'bags')
        (tool,) = load_session(path).tools
        assert tool.flux.shape == (4, 363, 3) and tool.has_pose.all()
        assert 5e-3 < np.sqrt(np.mean(tool.flux.real**2)) < 10e-3

    def test_rows_are_of_all_and_of_inner_heights(self, tmp_path):
        for kind, errors in (('plain', (4e-4, 3e-4, 5e-4)), ('full', (2e-4, 5e-5, 1e-4))):
            poses = [
                {'position_m': [0.0, y, 0.3], 'flux_rmse_t': error}
                for y, error in zip((-0.1, 0.0, 0.1), errors, strict=True)
            ]
            (tmp_path / kind).mkdir()
            text = json.dumps({'heldout_by_pose': poses})
            (tmp_path / kind / 'calibration.json').write_text(text)
        every, inner = navion.rows([], tmp_path)
        assert inner.before == pytest.approx(0.3) and inner.after == pytest.approx(0.05)
        assert inner.met and not every.met
        assert every.after == pytest.approx(np.sqrt((0.2**2 + 0.05**2 + 0.1**2) / 3))


class TestHpi:
    TONES = np.array([70.0, 72.0])

    def test_magnetometers_are_references_and_coils_emitters(self, tmp_path, monkeypatch):
        array = helmet(12)
        places = np.array([COIL, COIL * [-1, 1, 1]])
        signal = np.array([array.signals(place) @ MOMENT for place in places]).T
        flux = (signal * (1 + 0.1j))[array.is_magnetometer]
        data = HpiData(array, signal.T, np.zeros((36, 600)), 600.0, places, places)
        monkeypatch.setattr(hpi_session, 'phasors', lambda given: (self.TONES, flux))
        path = tmp_path / 'hpi.mcap'
        hpi_session.write_session(data, path)
        session = load_session(path)
        assert session.tools == () and session.setup.frequencies_hz == (70.0, 72.0)
        reference = session.reference
        np.testing.assert_allclose(reference.flux[0], flux, rtol=1e-6)
        assert len(reference.sensors) == 12
        # A point at a magnetometer's middle sees what the magnetometer does, to its size.
        distance = reference.sensors.position - places[0]
        r = np.linalg.norm(distance, axis=1)[:, None]
        field = 1e-7 * (3 * distance * (distance @ MOMENT)[:, None] / r**5 - MOMENT / r**3)
        seen = np.sum(field * reference.sensors.axis, axis=1)
        np.testing.assert_allclose(reference.flux[0, :, 0].real, seen, rtol=0.1, atol=1e-13)


def test_the_command_writes_bags_and_says_what_has_none(tmp_path, monkeypatch, capsys):
    (tmp_path / 'measured').mkdir()
    monkeypatch.setattr(
        measured, 'STUDIES', dict.fromkeys(('navion', 'anser_board'), lambda f: ([], ''))
    )
    monkeypatch.setattr(measured, 'RECIPES', {})
    monkeypatch.setattr(
        measured, 'SESSIONS', {'navion': lambda folder, into: [into / f'{folder.name}.mcap']}
    )
    assert main(['measured', '--shared', str(tmp_path), '--bags', str(tmp_path / 'bags')]) == 0
    out = capsys.readouterr().out
    assert 'navion.mcap' in out and 'anser_board: positions only, no session' in out
