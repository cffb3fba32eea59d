"""The size of an emitter without a drawing: magnets as magpylib's closed form has them."""

from dataclasses import dataclass, replace

import magpylib
import numpy as np
import pytest
from diagnosis_world import world as board_world
from scipy.spatial.transform import Rotation
from test_sources import AXIS, CENTRE, array_of_sensors

from anser_ros.apps.lab.calibration_engines import with_source_sizes
from anser_ros.calibration.calibrate import Options, fit_scan
from anser_ros.calibration.layouts import Generator
from anser_ros.calibration.result import Scan, to_document
from anser_ros.diagnosis.diagnose import diagnose
from anser_ros.diagnosis.problem import Spread, build_problem
from anser_ros.effects.effect import effect_named
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel, symmetry_axis
from anser_ros.physics.rotations import tangents
from anser_ros.settings import Accuracy

EFFECT = effect_named('emitter_size')
MOMENT_AM2, NOISE_T = 0.5, 2e-8
ACCURACY = Accuracy(NOISE_T, 1e-4, 5e-4)


@dataclass(frozen=True)
class Cylinder:
    """A uniformly magnetised cylinder; a dipole where it has no size."""

    length_m: float
    radius_m: float

    @property
    def second_moment_m2(self):
        return self.length_m**2 / 12 - self.radius_m**2 / 4

    def field(self, points):
        turn = Rotation.from_matrix(np.stack([*tangents(AXIS[None])[0], AXIS], axis=1))
        if not self.length_m:
            source = magpylib.misc.Dipole(moment=(0, 0, MOMENT_AM2))
        else:
            size = 2 * self.radius_m, self.length_m
            volume = np.pi * self.radius_m**2 * self.length_m
            source = magpylib.magnet.Cylinder(
                dimension=size, magnetization=(0, 0, MOMENT_AM2 / volume)
            )
        source.position, source.orientation = CENTRE, turn
        return source.getB(points)


LONG, FLAT, POINT = Cylinder(0.024, 0.006), Cylinder(0.004, 0.012), Cylinder(0.0, 0.0)
DIPOLE = FieldModel(
    CENTRE[None], AXIS[None], np.full((1, 1), MOMENT_AM2, dtype=complex), ('magnet',), (1.0,)
)


def recorded(world, rng, frames):
    """Readings of an array that moves about a magnet, 80 to 160 mm away, and its optical poses."""
    table, time = array_of_sensors(rng), np.arange(frames) / 25.0
    place = np.stack(
        [0.08 * np.sin(1.9 * time), 0.08 * np.sin(2.3 * time + 0.5), 0.13 + 0.03 * np.sin(time)],
        axis=1,
    )
    turn = Rotation.from_rotvec(
        np.stack([np.sin(0.7 * time), np.sin(1.1 * time), 2 * np.sin(0.5 * time)], axis=1)
    )
    points, axes = table.placed(place, turn.as_matrix())
    flux = np.einsum('fsi,fsi->fs', world.field(points.reshape(-1, 3)).reshape(axes.shape), axes)
    noise = NOISE_T * rng.normal(size=(*flux.shape, 2)) @ [1.0, 1j]
    jitter = Rotation.from_rotvec(ACCURACY.optical_rotation_rad * rng.normal(size=(frames, 3)))
    return Measurements(
        'array', table, time, (flux + noise)[:, :, None], np.ones(flux.shape, dtype=bool),
        np.zeros(flux.shape, dtype=int),
        place + ACCURACY.optical_position_m * rng.normal(size=place.shape),
        (jitter * turn).as_matrix(), np.ones(frames, dtype=bool),
    )  # fmt: skip


def diagnosed(tool, model=DIPOLE):
    problem = build_problem((tool,), None, None, model, None, Spread(NOISE_T, ACCURACY))
    return diagnose(problem, model)


@pytest.fixture(scope='module')
def apparatus():
    tool = recorded(POINT, np.random.default_rng(1), 60)
    return build_problem((tool,), None, None, DIPOLE, None, Spread(NOISE_T, ACCURACY)).apparatus


@pytest.mark.parametrize('world', [LONG, FLAT])
def test_a_second_moment_is_what_a_cylinder_has_beyond_its_dipole(world, apparatus):
    (term,) = EFFECT.candidates(apparatus)
    term = term.with_theta(np.array([world.second_moment_m2 / 1e-4]))
    base = DIPOLE.dipoles
    added = EFFECT.sources(term, base, base, np.ones(1))
    away = np.random.default_rng(2).normal(size=(200, 3))
    away /= np.linalg.norm(away, axis=1)[:, None]
    size, left = max(world.length_m, 2 * world.radius_m), []
    for distance in (4.0, 8.0):
        points = CENTRE + distance * size * away
        beyond = world.field(points) - base.field(points)[..., 0].real
        rest = beyond - added.field(points)[..., 0].real
        left.append(np.linalg.norm(rest) / np.linalg.norm(beyond))
    # The next multipole falls with the square of the distance over the size.
    assert left[1] < 0.01
    assert left[1] == pytest.approx(left[0] / 4.0, rel=0.3)


@pytest.mark.long
@pytest.mark.parametrize(
    ('world', 'key', 'gain', 'frames'),
    [(LONG, 'length_m', 1.0, 150), (FLAT, 'diameter_m', 1.03, 120)],
)
def test_the_size_of_a_magnet_is_named_and_nothing_else(world, key, gain, frames):
    """But, of one of them, the gain of a sensor that is wrong too."""
    tool = recorded(world, np.random.default_rng(6), frames)
    tool = replace(tool, flux=tool.flux * np.where(np.arange(21) == 4, gain, 1.0)[:, None])
    result = diagnosed(tool)
    found = {f.record.name: f.record for f in result.findings}
    record = found.pop(EFFECT.name)
    assert record.parameters['coil'] == 0
    off = record.parameters['second_moment_m2'] - world.second_moment_m2
    assert abs(off) < 0.02 * abs(world.second_moment_m2)
    assert abs(off) < 5 * record.uncertainty['second_moment_m2']
    assert record.parameters[key] == pytest.approx(
        np.sqrt((12 if key == 'length_m' else -16) * world.second_moment_m2), rel=0.01
    )
    assert result.unexplained == 0.0
    # The corrected model has it in its dipoles, on which nothing more is found.
    axis = symmetry_axis(result.model.positions, result.model.directions, result.model.moments)
    np.testing.assert_allclose(
        axis.second_moment_m2, record.parameters['second_moment_m2'], rtol=1e-6
    )
    assert not diagnosed(recorded(world, np.random.default_rng(4), frames), result.model).findings
    assert set(found) == ({'sensor_gain'} if gain != 1.0 else set())
    if found:
        assert found['sensor_gain'].parameters['gain'] == pytest.approx(gain, abs=1e-3)


@pytest.mark.long
def test_a_magnet_without_a_size_is_not_given_one():
    result = diagnosed(recorded(POINT, np.random.default_rng(5), 120))
    assert not result.findings and result.unexplained == 0.0


def test_an_emitter_that_is_drawn_is_no_candidate():
    assert not EFFECT.candidates(board_world(frames=60).problem().apparatus)


@pytest.mark.long
@pytest.mark.parametrize('world', [FLAT, POINT])
def test_calibrate_tells_the_size_from_blocks_left_out(world):
    tool = recorded(world, np.random.default_rng(7), 100)
    generator = Generator(np.zeros((1, 3)), np.zeros(1), 0.1, ('magnet',), (1.0,))
    scan = Scan((tool,), ACCURACY)
    calibration = with_source_sizes(
        fit_scan(scan, ['scan'], generator, Options(accuracy=ACCURACY))
    )
    assert 'axis of its own' in calibration.layout.describe()
    found = to_document(calibration)['effects']
    if world is POINT:
        assert not found
        return
    (effect,) = found
    assert effect['name'] == EFFECT.name and not calibration.model.effects
    off = effect['parameters']['second_moment_m2'] - world.second_moment_m2
    assert abs(off) < 0.1 * abs(world.second_moment_m2)
    assert effect['evidence']['heldout_point_t'] > 1.08 * effect['evidence']['heldout_sized_t']
