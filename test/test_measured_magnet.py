"""A magnet before sensors: physics of the model, effects found in made-up data, the real files."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from anser_ros.errors import BagError, FitError
from anser_ros.measured import magnet_patch
from anser_ros.measured.magnet_fit import Jitter, fit, search
from anser_ros.measured.magnet_model import (
    EFFECTS,
    Recording,
    Source,
    columns,
    point_source,
    predict,
    zero,
)
from anser_ros.measured.magnet_patch import UPWARDS, patch_in_fg, setup_of, write_session
from anser_ros.measured.magnet_step import analyse_step, shift_mm
from anser_ros.sessions.session import load_session

ROOT = Path(__file__).resolve().parents[1]
FOLDER = Path(os.environ.get('ANSER_SHARED', ROOT.parent / 'shared')) / 'measured' / 'magnet_patch'
needs_data = pytest.mark.skipif(not FOLDER.is_dir(), reason='no shared folder with measured data')
NOISE_T = 3e-6
OPTICAL = Jitter(1e-4, 2e-3)
CANDIDATES = tuple(name for name in EFFECTS if name not in ('moment', 'source_size'))


def cylinder(radius_m, half_length_m):
    """A uniformly magnetised cylinder: Gauss nodes over its volume.

    Three nodes along the axis, two radii (in the square of the radius), six angles: exact up to
    the fifth order of the size over the distance.
    """
    height, along = np.polynomial.legendre.leggauss(3)
    square, across = np.polynomial.legendre.leggauss(2)
    angle = 2.0 * np.pi * np.arange(6) / 6.0
    z, rho, phi = np.meshgrid(
        half_length_m * height, radius_m * np.sqrt(0.5 * (square + 1.0)), angle, indexing='ij'
    )
    weights = np.broadcast_to(along[:, None, None] * across[None, :, None] / 24.0, z.shape)
    nodes = np.stack([rho * np.cos(phi), rho * np.sin(phi), z], axis=-1).reshape(-1, 3)
    return Source(nodes, np.ascontiguousarray(weights).ravel())


def made_up(frames=42, found=None, seed=0, source=None, noise=NOISE_T, jitter=None, turning=True):
    """A magnet of 0.86 A m^2 in 25 to 50 mm before a 4 x 4 patch."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(*[np.arange(4) - 1.5] * 2, indexing='ij'), axis=-1)
    place = np.zeros((16, 3))
    place[:, :2] = grid.reshape(-1, 2) * [6e-3, 12e-3]
    time = np.linspace(0.0, 1.0, frames)
    path = np.column_stack(
        [
            0.02 * np.sin(9 * time),
            0.02 * np.cos(14 * time),
            0.037 - 0.012 * np.cos(2 * np.pi * time),
        ]
    )
    tilt = 0.3 * rng.normal(size=(frames, 3)) * turning
    turns = Rotation.from_rotvec(tilt).as_matrix()
    sensor = Rotation.from_rotvec(0.03 * rng.normal(size=(16, 3))).as_matrix()
    recording = Recording(
        'made up',
        np.zeros((frames, 16, 3)),
        np.tile(place, (frames, 1, 1)),
        np.tile(sensor, (frames, 1, 1, 1)),
        path,
        turns,
        5.0 * np.arange(frames),
    )
    field = predict(recording, source or cylinder(5e-3, 5e-3), 0.86, found or {})
    field = field + noise * rng.normal(size=field.shape)
    if jitter:
        turn = Rotation.from_rotvec(jitter.angle_rad * rng.normal(size=(frames, 3))).as_matrix()
        recording = recording.with_pose(
            path + jitter.position_m * rng.normal(size=path.shape), turns @ turn
        )
    return replace(recording, field_t=field)


class TestModel:
    def test_small_cylinder_is_a_dipole(self):
        points = np.array([[0.03, 0.01, 0.05], [0.0, 0.04, -0.02]])
        small, dipole = cylinder(1e-4, 1e-4).field(points), point_source().field(points)
        np.testing.assert_allclose(small, dipole, rtol=1e-4, atol=1e-12)

    def test_cylinder_agrees_with_the_exact_field(self):
        magpylib = pytest.importorskip('magpylib')
        radius, half, moment = 5e-3, 5e-3, 0.86
        magnetisation = moment / (2.0 * np.pi * radius**2 * half)
        exact = magpylib.magnet.Cylinder(
            magnetization=(0, 0, magnetisation), dimension=(2 * radius, 2 * half)
        )
        points = np.array([[0.02, 0.0, 0.012], [0.0, 0.015, 0.03], [0.01, 0.01, -0.04]])
        mine = moment * cylinder(radius, half).field(points)
        np.testing.assert_allclose(mine, exact.getB(points), rtol=2e-3, atol=1e-7)

    def test_octupole_effect_is_the_second_derivative(self):
        recording = made_up(3, noise=0.0, source=point_source())
        half = 3e-3  # two dipoles at +- half along z: second moment half^2 over 2
        pair = replace(point_source(), nodes_m=half * np.array([[0, 0, 1.0], [0, 0, -1.0]]))
        pair = replace(pair, weights=np.array([0.5, 0.5]))
        with_size = predict(
            recording, point_source(), 0.86, {'source_size': np.array([0.5 * half**2])}
        )
        without = recording.field_t
        wanted = predict(recording, pair, 0.86, {})
        assert np.abs(with_size - wanted).max() < 0.1 * np.abs(without - wanted).max()

    @pytest.mark.parametrize('name', sorted(EFFECTS))
    def test_columns_are_the_change_by_one_spread(self, name):
        recording, source = made_up(4), cylinder(5e-3, 5e-3)
        block = columns(recording, source, 0.86, {}, name)
        here = zero(name, 16)
        assert block.shape == (4, 16, 3, here.size)
        step = np.zeros(here.size)
        step[here.size // 2] = 0.01
        change = {name: (step * EFFECTS[name].spread).reshape(here.shape)}
        difference = predict(recording, source, 0.86, change) - predict(
            recording, source, 0.86, {}
        )
        linear = 0.01 * block[..., here.size // 2]
        assert np.abs(difference - linear).max() <= 0.05 * np.abs(linear).max() + 1e-15


class TestSearch:
    @pytest.mark.parametrize(
        ('name', 'size'),
        [
            ('sensor_gain', 0.01),
            ('sensor_axis', 0.01),
            ('pickup', 2e-5),
            ('sensor_position', 3e-4),
        ],
    )
    def test_names_the_effect_and_its_parameters(self, name, size):
        truth = size * np.random.default_rng(5).normal(size=zero(name, 16).shape)
        if name == 'sensor_gain':
            truth -= truth.mean()
        recording = made_up(found={name: truth}, jitter=OPTICAL)
        source = cylinder(5e-3, 5e-3)
        found = search(recording, source, CANDIDATES, NOISE_T, OPTICAL)
        assert found.chosen == (name,)
        result = fit(recording, source, found.chosen, NOISE_T, OPTICAL)
        off = (result.found[name] - truth) / result.sigma[name]
        assert np.sqrt(np.mean(off**2)) < 1.5
        assert result.noise_t == pytest.approx(NOISE_T, rel=0.1)

    def test_clean_recording_has_no_effect(self):
        recording = made_up(jitter=OPTICAL, seed=4)
        found = search(recording, cylinder(5e-3, 5e-3), CANDIDATES, NOISE_T, OPTICAL)
        assert found.chosen == ()

    def test_too_few_readings_are_an_error(self):
        with pytest.raises(FitError, match='cannot give'):
            fit(made_up(1), point_source(), ('channel_crosstalk',), NOISE_T, OPTICAL)


class TestStep:
    def test_size_of_the_magnet_is_not_taken_for_a_shift_of_the_patch(self):
        recording = made_up(30, {'source_size': np.array([4e-6])}, source=point_source())
        step = analyse_step(recording, point_source())
        assert 'source_size' in step.search.chosen
        assert shift_mm(step.final) < 0.3 * shift_mm(step.naive)


class TestSession:
    def test_bag_holds_fluxes_and_poses(self, tmp_path):
        recording = made_up(5)
        path = tmp_path / 'magnet.mcap'
        write_session(recording, path)
        session = load_session(path)
        assert len(session.setup.tool_sensors) == 48
        turn, place = patch_in_fg(recording)
        sensor = setup_of(recording).sensors[7]
        world = recording.magnet_m[2] + recording.magnet_rotation[2] @ UPWARDS.T @ (
            place[2] + turn[2] @ np.array(sensor.position_m)
        )
        np.testing.assert_allclose(world, recording.sensor_m[2, 2], atol=1e-9)
        assert place[:, 2].min() > 0.0, 'the patch is above the magnet'
        with pytest.raises(BagError):
            write_session(recording, path)


class TestFiles:
    def test_missing_and_broken_files_are_one_line(self, tmp_path):
        with pytest.raises(FitError, match='no such file'):
            magnet_patch.read_table(tmp_path / 'none.csv')
        (tmp_path / 'empty.csv').write_text('a,b\n')
        with pytest.raises(FitError, match='no rows'):
            magnet_patch.read_table(tmp_path / 'empty.csv')
        (tmp_path / 'part.csv').write_text('id,Bx\n' + '1,2\n' * 5)
        with pytest.raises(FitError, match='not poses'):
            magnet_patch.read_poses(tmp_path / 'part.csv', 'm')
        (tmp_path / 'lacks.csv').write_text('id,Bx\n' + '1,2\n' * 16)
        with pytest.raises(FitError, match='lacks the columns'):
            magnet_patch.read_poses(tmp_path / 'lacks.csv', 'm')
        with pytest.raises(FitError, match='at least two'):
            magnet_patch.file_names(tmp_path)

    @needs_data
    def test_background_of_another_shape_is_refused(self, tmp_path):
        for name in ('data1.csv', 'data1_background_uT.csv'):
            text = (FOLDER / name).read_text()
            lines = text.splitlines()[: 9 if 'background' in name else None]
            (tmp_path / name).write_text('\n'.join(lines))
        with pytest.raises(FitError, match='background'):
            magnet_patch.load(tmp_path, 'data1')
