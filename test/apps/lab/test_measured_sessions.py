"""Sessions of measured data: what was measured stands in the bag, in the layout of sessions."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import SHARED, needs
from scipy.spatial.transform import Rotation

from anser_ros.apps.lab.cli import measured
from anser_ros.apps.lab.measured import hpi_coils, ilemt, navion
from anser_ros.cli.main import main
from anser_ros.errors import FitError
from anser_ros.sessions.plausibility import times_of_mounting
from anser_ros.sessions.session import load_session

SEED = 7
NAVION = SHARED / 'measured' / 'navion'
PLACES = np.array([[0.06, 0.02, 0.01], [-0.05, 0.04, 0.0], [-0.04, -0.05, 0.03], [0.0, 0.0, 0.09]])


def write_plate(folder, rng, signs):
    """Two heights of 2 x 2 sensors under combinations of currents, and a state without; mT."""
    field = rng.normal(size=(2, 3, 4, 3))
    lines = ['plane,sensor,state,x_m,y_m,z_m,I0_A,I1_A,I2_A,Bx_mT,By_mT,Bz_mT']
    for plane, z in enumerate((-0.05, 0.05)):
        for sensor, (x, y) in enumerate((x, y) for x in (-0.1, 0.1) for y in (-0.1, 0.1)):
            for state, sign in enumerate((*signs, (0, 0, 0))):
                reading = np.array(sign) @ field[plane, :, sensor] + [0.1, 0.2, 0.3]
                numbers = (x, y, z, *(35.0 * np.array(sign)), *reading)
                lines.append(','.join(map(str, (plane, sensor, state, *map(float, numbers)))))
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

    @needs('measured', 'navion')
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
            effects = [{'name': 'sensor_gain_spread', 'parameters': {'spread': 0.02}}]
            text = json.dumps({'heldout_by_pose': poses, 'effects': effects})
            (tmp_path / kind / 'calibration.json').write_text(text)
        every, inner, *heights, gains, tilts = navion.rows(tmp_path, [], tmp_path)
        assert inner.before == pytest.approx(0.3) and inner.after == pytest.approx(0.05)
        assert inner.met and not every.met
        assert every.after == pytest.approx(np.sqrt((0.2**2 + 0.05**2 + 0.1**2) / 3))
        assert [row.after for row in heights] == pytest.approx([0.2, 0.05, 0.1])
        assert (gains.after, gains.unit) == (2.0, '%') and np.isnan(tilts.after)


class TestHpi:
    def epoch(self, rng, inverted=(5, 10)):
        """Thirty-six channels in the stored layout, gradiometers but for each third; 4 tones."""
        count, time = 36, np.arange(600) / 600.0
        weight = np.where(np.arange(count)[:, None] % 3, [[60.0, -60.0]], [[0.5, 0.5]])
        point = rng.normal(size=(count, 1, 3)) + [[[0.01, 0, 0]], [[-0.01, 0, 0]]][0]
        point = np.concatenate([point, point + [[[0.0, 0.01, 0.0]]]], axis=1)
        normal = np.tile([0.0, 0.0, 1.0], (count, 2, 1))
        stored = 1e-12 * rng.normal(size=(4, count))
        sign = np.where(np.isin(np.arange(count), inverted), -1.0, 1.0)
        wave = np.cos(2.0 * np.pi * np.outer(hpi_coils.TONES_HZ, time) + 0.3)
        samples = 1e14 * (stored * sign).T @ wave + 5.0 + 3.0 * time
        return hpi_coils.Epoch(
            tuple(f'c{k}' for k in range(count)), np.arange(count) % 3 == 0, point, normal,
            weight, samples, 600.0, stored, PLACES, PLACES,
        )  # fmt: skip

    def test_fluxes_are_the_tones_in_tesla_with_the_signs_as_sampled(self, rng):
        epoch = self.epoch(rng)
        flux, base = hpi_coils.fluxes(epoch), epoch.base_m
        assert base[0] == 1.0 and base[1] == pytest.approx(1.0 / 60.0)
        sign = np.where(np.isin(np.arange(36), (5, 10)), -1.0, 1.0)
        wanted = (epoch.stored * base * sign).T
        # The phase of a tone is known up to half a turn.
        turned = np.sign((flux[0].real * wanted).sum(axis=0))
        np.testing.assert_allclose(turned * flux[0], wanted, atol=1e-15)
        assert np.flatnonzero(hpi_coils.inverted(epoch)).tolist() == [5, 10]

    def test_the_setup_has_a_sum_of_points_for_each_channel(self, rng):
        epoch = self.epoch(rng)
        setup = hpi_coils.setup_of(epoch)
        assert len(setup.sensors) == 36 and setup.bodies == ('helmet',)
        loop, difference = setup.sensors[0], setup.sensors[1]
        assert sum(w[3] for w in loop.windings) == pytest.approx(1.0)
        assert [w[3] for w in difference.windings] == [1.0, -1.0]
        np.testing.assert_allclose(difference.position_m, epoch.points_m[1].mean(axis=0))

    def test_distances_are_free_of_order_and_of_a_rigid_move(self, rng):
        turned = PLACES[[2, 0, 3, 1]] @ Rotation.from_rotvec([0.3, 1.0, 2.0]).as_matrix() + 0.3
        assert hpi_coils.distance_mm(turned, PLACES) < 1e-6
        off = PLACES + 1e-3 * rng.normal(size=(4, 3))
        assert 0.1 < hpi_coils.distance_mm(off, PLACES) < 3.0

    def test_rows_compare_names_and_places(self, tmp_path, rng, monkeypatch):
        epoch = self.epoch(rng)
        monkeypatch.setattr(hpi_coils, 'load', lambda folder: epoch)
        for kind, channels in (('plain', []), ('full', [5, 7])):
            (tmp_path / kind).mkdir()
            effects = [{'name': 'sensor_polarity', 'parameters': {'channels': channels}}]
            sources = [{'position_m': place.tolist()} for place in PLACES]
            document = {'effects': effects, 'sources': sources, 'heldout_flux_rmse_t': 1e-12}
            (tmp_path / kind / 'calibration.json').write_text(json.dumps(document))
        vendor, _, named, predicted, falsely = hpi_coils.rows(tmp_path, [], tmp_path)
        assert vendor.after < 1e-6 and vendor.met
        assert (named.before, named.after, named.target, named.met) == (0.0, 1.0, 2.0, False)
        assert predicted.after == pytest.approx(1.0)
        assert (falsely.after, falsely.met) == (1.0, False)

    def test_a_file_that_is_missing_or_another_is_refused(self, tmp_path):
        with pytest.raises(FitError, match='no such file'):
            hpi_coils.load(tmp_path)
        np.savez(tmp_path / 'hpi_coils.npz', a=1)
        with pytest.raises(FitError, match='not the expected set'):
            hpi_coils.load(tmp_path)


def test_the_command_writes_the_sessions_of_data_sets_that_are_there(
    tmp_path, monkeypatch, capsys
):
    for name in ('navion', 'magnet_patch'):
        (tmp_path / 'measured' / name).mkdir(parents=True)
    made = {
        name: replace(
            recipe,
            write_sessions=lambda folder, into: [into / f'{folder.name}.mcap'],
            commands=lambda bags, out: [],
            rows=lambda folder, bags, out: [],
        )
        for name, recipe in measured.RECIPES.items()
    }
    monkeypatch.setattr(measured, 'RECIPES', made)
    assert main(['measured', '--shared', str(tmp_path), '--bags', str(tmp_path / 'bags')]) == 0
    out = capsys.readouterr().out
    assert {name for name in made if f'{name}.mcap' in out} == {'navion', 'magnet_patch'}
    assert f'ilemt left out: no {tmp_path}' in ' '.join(out.split('\n'))


class TestIlemt:
    def test_a_pole_that_turns_keeps_its_end_on_the_axis(self):
        stage = np.array([[0, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 90], [10, 0, 0, 0, 0, 0.0]])
        place, turn = ilemt.poses(stage, 'YoutZup', 'YoutZup')
        np.testing.assert_allclose(place[0], [0.012, 0.0, 0.243], atol=1e-12)
        np.testing.assert_allclose(place[1], place[0], atol=1e-12)
        np.testing.assert_allclose(place[2] - place[0], [0.0, 0.01, 0.0], atol=1e-4)
        away = Rotation.from_quat(turn).apply([[0.0, 1.0, 0.0]] * 3)
        np.testing.assert_allclose(away[:2], [[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], atol=1e-12)

    @needs('measured', 'ilemt')
    def test_the_real_data(self, tmp_path):
        bags = ilemt.write_sessions(SHARED / 'measured' / 'ilemt', tmp_path)
        assert bags[0].stem == 'ilemt_dipole_YoutZup_YoutZup_md'
        assert len(bags) == 2 * (3 + 3 + 3 + 6) + 2 * 4 + 8
        (tool,) = load_session(bags[0]).tools
        assert tool.flux.shape == (142, 3, 3) and tool.has_pose.all()
        # Three fixtures in one recording are told by the axis that the body turns about.
        parts = [load_session(bag).tools[0] for bag in bags[:3]]
        joined = np.concatenate([part.rotation for part in parts])
        time = np.arange(len(joined), dtype=float)
        ends = {'time': time, 'rotation': joined, 'has_pose': time >= 0.0}
        assert times_of_mounting(replace(tool, **ends)) == [142.0, 284.0]
        (other,) = load_session(next(b for b in bags if 'turned_ZoutYup' in b.stem)).tools
        # The source's fixture turns: what was before it is beside it.
        turned = other.position.mean(axis=0) / np.linalg.norm(other.position.mean(axis=0))
        assert tool.position[:, 2].min() > 0.1 and abs(turned[2]) < 0.3
        assert len(ilemt.commands(bags, tmp_path)) == 5 + 3 + 3 + 3 + 6 + 3 + 2 * 4 + 8
        clean, done = (load_session(bags[k]).tools[0].flux for k in (3, -3))
        np.testing.assert_allclose(np.angle(done / clean)[0, 0], [4e-3, -3e-3, 6e-3], atol=1e-9)
