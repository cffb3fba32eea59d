"""Known metal: the physics of a lattice, and its file."""

from dataclasses import replace

import known_metal_world as world
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from tracking_world import certain_model

from anser_ros.apps.lab.metal_lattice import (
    Coils,
    KnownMetal,
    Lattice,
    Setting,
    ball_answer,
    from_document,
    lattice_points,
    load_known_metal,
    moved,
    save_known_metal,
    step_between,
    to_document,
)
from anser_ros.errors import ModelFileError
from anser_ros.physics.constants import MU_0

TILT = np.log(np.array(certain_model().frequencies_hz) / 6500.0)
POSE = np.array([0.03, -0.02, -0.11, 0.2, -0.1, 0.4])


def lattice_of(points, unit=20.0, seed=2) -> Lattice:
    """A lattice with any answers, about those of a conductor."""
    rng = np.random.default_rng(seed)
    n = len(points)
    answers = -0.8 + 0.3 * rng.normal(size=n) + 0.3j * rng.normal(size=n)
    slopes = 0.2 * rng.normal(size=n) + 0.2j * rng.normal(size=n)
    return Lattice(np.asarray(points, dtype=float), unit, answers, slopes, 6500.0)


@pytest.fixture(scope='module')
def lattice() -> Lattice:
    return lattice_of(lattice_points((2, 2, 2), 0.03), ball_answer(0.03))


@pytest.fixture(scope='module')
def setting() -> Setting:
    return Setting(world.excitation(), TILT)


@pytest.fixture(scope='module')
def coils() -> Coils:
    table = world.references()
    return Coils(table.position, table.axis, np.full(len(table), 0.008))


def by_hand(moment, away):
    """The textbook's field of a dipole (Jackson, eq. 5.56), T."""
    r = np.linalg.norm(away)
    return MU_0 / (4 * np.pi) * (3 * away * (away @ moment) / r**5 - moment / r**3)


class TestLattice:
    def test_one_point_is_a_dipole_of_its_answer_times_the_field(self, setting):
        one = Lattice(np.zeros((1, 3)), 20.0, np.array([-0.7 + 0.2j]), np.array([0.3j]), 6500.0)
        at, axis = np.array([[0.05, -0.08, 0.15]]), np.array([[0.6, 0.0, 0.8]])
        pose = np.concatenate([[0.02, 0.01, -0.1], [0.3, 0.2, 0.1]])
        flux = setting.flux(one, setting.placed(one, pose), Coils(at, axis, None))
        field = world.anser_board().field(pose[None, :3])[0]
        for k, tilt in enumerate(TILT):
            moment = 20.0 * (-0.7 + 0.2j + 0.3j * tilt) * field[k]
            parts = [by_hand(part, at[0] - pose[:3]) for part in (moment.real, moment.imag)]
            expected = (parts[0] + 1j * parts[1]) @ axis[0]
            assert flux[0, k] == pytest.approx(expected, rel=1e-4)

    def test_two_points_solve_the_coupled_equations(self):
        points = np.array([[0.0, 0.0, 0.0], [0.02, 0.01, -0.015]])
        two = lattice_of(points)
        driving = np.random.default_rng(1).normal(size=6)
        (moments,) = two.moments(driving[None], np.zeros(1))
        first, second = moments[:3], moments[3:]
        for here, there, own, answer in (
            (first, second, driving[:3], two.answers[0]),
            (second, first, driving[3:], two.answers[1]),
        ):
            away = points[0] - points[1]
            felt = own + by_hand(there.real, away) + 1j * by_hand(there.imag, away)
            np.testing.assert_allclose(here, 20.0 * answer * felt, rtol=1e-9)
        alone = 20.0 * np.repeat(two.answers, 3) * driving
        assert np.abs(moments - alone).max() > 0.05 * np.abs(alone).max(), 'they drive each other'

    def test_the_response_is_reciprocal_at_any_frequency(self, lattice):
        _, response, _ = lattice.scattering
        base, sloped = lattice.responses
        for matrix in (response, base, sloped):
            np.testing.assert_allclose(matrix, matrix.T, rtol=0, atol=1e-9 * abs(matrix).max())
        assert np.abs(response - np.diag(np.diag(response))).max() > 0.01 * np.abs(response).max()

    def test_the_slope_is_the_change_with_the_frequency(self, lattice):
        driving, step = np.random.default_rng(3).normal(size=(1, 24)), 1e-4
        there = replace(lattice, answers=lattice.answers + step * lattice.slopes)
        change = (there.moments(driving, np.zeros(1)) - lattice.moments(driving, np.zeros(1)))[0]
        sloped = lattice.moments(driving, np.ones(1)) - lattice.moments(driving, np.zeros(1))
        np.testing.assert_allclose(change / step, sloped[0], atol=1e-3 * np.abs(sloped).max())

    def test_a_small_change_of_the_answers_is_right_to_first_order(self, lattice):
        rng = np.random.default_rng(4)
        driving, change = rng.normal(size=(8, 24)), rng.normal(size=4 * len(lattice))
        # The slopes themselves are first order: what both do together is left out.
        tilt = np.full(8, 1e-9)
        left = []
        for size in (0.02, 0.01):
            whole = lattice.with_parameters(lattice.parameters + size * change)
            near = lattice.near(size * change)
            exact = whole.moments(driving, tilt)
            left.append(np.abs(near.moments(driving, tilt) - exact).max())
            assert left[-1] < 0.2 * np.abs(exact - lattice.moments(driving, tilt)).max()
        assert left[0] / left[1] == pytest.approx(4.0, rel=0.1), 'of second order'

    def test_columns_by_the_pose_are_the_differences(self, lattice, setting, coils):
        columns = setting.pose_columns(lattice, POSE, coils)
        for i, size in enumerate([2e-5] * 3 + [2e-4] * 3):
            step = size * np.eye(6)[i]
            ends = [
                setting.flux(lattice, setting.placed(lattice, moved(POSE, way)), coils)
                for way in (step, -step)
            ]
            slope = (ends[0] - ends[1]) / (2 * size)
            np.testing.assert_allclose(
                columns[..., i], slope, rtol=0, atol=2e-3 * np.abs(slope).max()
            )

    def test_columns_by_the_answers_are_the_differences(self, lattice, setting, coils):
        # With slopes, they leave out what a changed answer makes of these: that is second order.
        flat = replace(lattice, slopes=0.0 * lattice.slopes)
        placed = setting.placed(flat, POSE)
        columns = setting.answer_columns(lattice, placed, coils)
        for i, step in enumerate(1e-4 * np.eye(4 * len(flat))):
            ends = [
                setting.flux(flat.with_parameters(flat.parameters + way), placed, coils)
                for way in (step, -step)
            ]
            atol = 1e-6 * np.abs(columns).max()
            np.testing.assert_allclose(columns[..., i], (ends[0] - ends[1]) / 2e-4, 0, atol)

    def test_a_model_with_it_reads_what_it_adds(self, lattice, setting, coils):
        placed, model = setting.placed(lattice, POSE), certain_model()
        whole = setting.in_field(lattice, placed, model)
        told = (coils.at, coils.axes, coils.lengths)
        added = whole.flux(*told) - model.flux(*told)
        flux = setting.flux(lattice, placed, coils) * setting.excitation.phase
        np.testing.assert_allclose(added, flux, rtol=0, atol=1e-9 * np.abs(flux).max())

    def test_many_poses_at_once_are_one_after_the_other(self, lattice, setting, coils):
        poses = np.array([POSE, moved(POSE, np.full(6, 0.05))])
        one_by_one = [setting.flux(lattice, setting.placed(lattice, p), coils) for p in poses]
        np.testing.assert_allclose(setting.fluxes(lattice, poses, coils), one_by_one, rtol=1e-9)

    def test_a_step_leads_where_it_says(self):
        other = np.array([0.1, 0.2, -0.3, -0.5, 0.4, 0.9])
        step = step_between(POSE, other)
        np.testing.assert_allclose(moved(POSE, step), other, atol=1e-12)
        turned = Rotation.from_rotvec(step[3:]) * Rotation.from_rotvec(POSE[3:])
        np.testing.assert_allclose(turned.as_rotvec(), other[3:], atol=1e-12)

    def test_a_ball_answers_as_a_perfect_conductor(self):
        polarizability = world.of_world('spheres').polarizability
        theirs = polarizability(0.02, 1e13, 1.0, 2 * np.pi * 6500)
        assert -ball_answer(0.04) == pytest.approx(theirs.real, rel=2e-3)


def known_of(lattice, directions=3) -> KnownMetal:
    """Metal that nobody has learnt."""
    rng = np.random.default_rng(6)
    return KnownMetal(
        'lump', lattice, rng.normal(size=(4 * len(lattice), directions)), 0.01 / 3, 3.1e-6 / 7,
        0.1, *rng.normal(size=(3, 3)),
    )  # fmt: skip


class TestFile:
    def test_it_comes_back_bit_by_bit(self, lattice, tmp_path):
        known = known_of(lattice)
        save_known_metal(tmp_path / 'new' / 'a.yaml', known)
        again = load_known_metal(tmp_path / 'new' / 'a.yaml')
        for name in ('directions', 'low', 'high', 'turn'):
            np.testing.assert_array_equal(getattr(again, name), getattr(known, name))
        for name in ('name', 'misfit', 'strongest_t', 'nearest_m'):
            assert getattr(again, name) == getattr(known, name)
        for name in ('points', 'answers', 'slopes', 'unit', 'frequency_hz'):
            np.testing.assert_array_equal(
                getattr(again.lattice, name), getattr(known.lattice, name)
            )

    @pytest.mark.parametrize(
        ('key', 'value', 'words'),
        [
            ('schema', 'anser_model/1', "its schema must be 'anser_known_metal/1'"),
            ('name', 5, 'name must be a text, got 5'),
            ('unit', -1.0, 'unit must be positive, got -1'),
            ('unit', None, 'unit is missing'),
            ('misfit', 'small', 'misfit is not a number'),
            pytest.param('misfit', 10**400, 'misfit is not a number', id='too large'),
            ('nearest_m', [0.1], 'nearest_m must be one number, got the shape (1,)'),
            ('strongest_t', float('nan'), 'strongest_t holds values that are not finite'),
            ('points', [[0.0, 1.0]], 'points must be any x 3, got the shape (1, 2)'),
            ('points', [[0.0], [1.0, 2.0]], 'points is not a table of numbers'),
            ('parameters', [0.0] * 31, 'parameters must be 32, got the shape (31,)'),
            ('directions', [[0.0] * 31], 'directions must be any x 32, got the shape (1, 31)'),
            ('low_m', [0.0, 1.0], 'low_m must be 3, got the shape (2,)'),
            ('low_m', [0.5, 0.5, 0.5], 'must be the corners of a box within 3 m'),
            ('misfit', 50.0, 'misfit must be a share below 1, got 50'),
            ('high_m', {'x': 1.0}, 'high_m is not a table of numbers'),
        ],
    )
    def test_what_is_wrong_with_it_is_a_line(self, lattice, tmp_path, key, value, words):
        document = to_document(known_of(lattice))
        from_document(document)
        if value is None:
            del document[key]
        else:
            document[key] = value
        path = tmp_path / 'a.yaml'
        path.write_text(yaml.safe_dump(document), encoding='utf-8')
        with pytest.raises(ModelFileError) as raised:
            load_known_metal(path)
        said = str(raised.value)
        assert said.startswith(f'{path}: ') and said.endswith(words) and '\n' not in said

    @pytest.mark.parametrize(
        ('content', 'words'),
        [(b'\xff\xfe\xff', 'not a text'), (b'a: [1\nb: ]', 'not YAML'), (b'- 1', 'its schema')],
    )
    def test_a_file_of_something_else_is_a_line(self, tmp_path, content, words):
        path = tmp_path / 'a.yaml'
        path.write_bytes(content)
        with pytest.raises(ModelFileError, match=words) as raised:
            load_known_metal(path)
        assert str(raised.value).startswith(f'{path}: ') and '\n' not in str(raised.value)
