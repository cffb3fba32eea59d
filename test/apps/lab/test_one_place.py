"""Sources of unknown place before a body at rest, and sensors that are sums of windings."""

import dataclasses
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from anser_ros.apps.lab.calibration_engines import is_at_one_place
from anser_ros.apps.lab.one_place import calibrate_at_one_place
from anser_ros.apps.lab.source_calibration import KINDS
from anser_ros.calibration.layouts import Generator
from anser_ros.calibration.readings import check_single_coils
from anser_ros.diagnosis.problem import Spread, build_problem
from anser_ros.errors import DiagnosisError, FitError, SetupError, TrackingError
from anser_ros.field.measurements import Measurements
from anser_ros.physics.dipole import flux_basis
from anser_ros.physics.sensor import PlacedPoints, SensorTable, Windings
from anser_ros.settings import Accuracy
from anser_ros.tracking.tracker import Tracker
from anser_ros.wire.setup import Coil, Emitter, SensorSpec, Setup, dump_setup, parse_setup

pytestmark = pytest.mark.long

BASE_M = 0.017
ACCURACY = Accuracy(flux_noise_t=1e-14, optical_position_m=1e-6, optical_rotation_rad=1e-6)
NAMES, TONES = ('one', 'two'), (70.0, 72.0)


def helmet(count, rng):
    """Sensors on a half sphere of 12 cm, by turns a loop's centre and a gradiometer."""
    up = rng.normal(size=(count, 3))
    up[:, 2] = np.abs(up[:, 2])
    axis = up / np.linalg.norm(up, axis=1)[:, None]
    across = np.cross(axis, [0.3, 0.5, 0.8])
    across *= 0.5 * BASE_M / np.linalg.norm(across, axis=1)[:, None]
    rows = [
        [(*a, 1.0), (*-a, -1.0)] if k % 2 else [(*a, 0.5), (*-a, 0.5)]
        for k, a in enumerate(across)
    ]
    return SensorTable(
        np.arange(count), tuple(f'h/s{k}' for k in range(count)), ('h',) * count,
        0.12 * axis + [0.0, 0.0, 0.1], axis, np.zeros(count), Windings.of(rows),
    )  # fmt: skip


PLACES = np.array([[0.05, 0.02, 0.13], [-0.04, 0.04, 0.15]])
GENERATOR = Generator(PLACES, np.zeros(2), 0.01, NAMES, TONES)
MOMENTS = np.array([[2e-9, 1e-9, 8e-9], [-5e-9, 3e-9, 6e-9]])


def resting(rng, *, tilt=0.01, inverted=(), noisy=(), count=60):
    """Two frames of a helmet before two coils; its sensors' axes are off by a tilt."""
    table = helmet(count, rng)
    turned = table.axis + tilt * rng.normal(size=(count, 3))
    true = dataclasses.replace(table, axis=turned / np.linalg.norm(turned, axis=1)[:, None])
    points = PlacedPoints.of(true, np.zeros(3), np.eye(3))
    flux = np.stack(
        [
            points.basis(np.tile(place, (3, 1)), np.eye(3)) @ moment
            for place, moment in zip(PLACES, MOMENTS, strict=True)
        ],
        axis=1,
    )
    flux[list(inverted)] *= -1.0
    noise = np.full(count, 1e-14)
    noise[list(noisy)] *= 40.0
    noise = noise[:, None] * (rng.normal(size=(2, count, 2)) + 1j * rng.normal(size=(2, count, 2)))
    eye = np.tile(np.eye(3), (2, 1, 1))
    good = np.ones((2, count), dtype=bool)
    return Measurements(
        'h', table, np.array([0.0, 1.0]), flux + noise, good, (~good).astype(np.int64),
        np.zeros((2, 3)), eye, np.ones(2, dtype=bool),
    )  # fmt: skip


def calibrated(measured, kinds=KINDS):
    return calibrate_at_one_place(measured, GENERATOR, kinds, ACCURACY)


class TestPlacedPoints:
    def test_a_gradiometer_is_the_difference_of_its_coils(self, rng):
        table = helmet(6, rng)
        turn = Rotation.from_rotvec([0.2, -0.4, 0.3]).as_matrix()
        points = PlacedPoints.of(table, np.array([0.01, 0.0, 0.02]), turn)
        basis = points.basis(PLACES[:1], np.array([[0.0, 0.0, 1.0]]))
        centre, axis = table.placed(np.array([0.01, 0.0, 0.02]), turn)
        arm = table.windings.offset[1, 0] @ turn.T
        one, other = (
            flux_basis(centre[1:2] + s * arm, axis[1:2], None, PLACES[:1], np.array([[0, 0, 1.0]]))
            for s in (1.0, -1.0)
        )
        assert basis[1, 0] == pytest.approx((one - other)[0, 0], rel=1e-12)

    def test_single_coils_beside_it_keep_their_length(self, rng):
        table = helmet(3, rng)
        long = SensorTable(
            np.array([9]), ('h/long',), ('h',), np.array([[0.0, 0.0, 0.3]]),
            np.array([[0.0, 0.0, 1.0]]), np.array([0.02]),
        )  # fmt: skip
        both = long.joined(table)
        assert both.is_single.tolist() == [True, False, False, False]
        points = PlacedPoints.of(both, np.zeros(3), np.eye(3))
        there = np.array([[0.0, 0.01, 0.1]]), np.array([[0.0, 0.0, 1.0]])
        alone = flux_basis(long.position, long.axis, long.length, *there)
        np.testing.assert_allclose(points.basis(*there)[0], alone[0], rtol=1e-12)
        parts = PlacedPoints.of(both.select([2]), np.zeros(3), np.eye(3)).basis(*there)
        np.testing.assert_allclose(points.basis(*there)[2], parts[0], rtol=1e-12)

    def test_slopes_are_differences(self, rng):
        table, step = helmet(4, rng), 1e-5
        dipole = np.tile(PLACES[0], (3, 1)), np.eye(3)
        moments = rng.normal(size=(3, 3))

        def flux(shift, turn):
            moved = dataclasses.replace(table, position=table.position + shift)
            rotation = Rotation.from_rotvec(turn).as_matrix()
            own = dataclasses.replace(
                moved,
                axis=table.axis @ rotation.T,
                windings=Windings(table.windings.offset @ rotation.T, table.windings.weight),
            )
            return PlacedPoints.of(own, np.zeros(3), np.eye(3)).basis(*dipole) @ moments

        shift, turn = PlacedPoints.of(table, np.zeros(3), np.eye(3)).slopes(*dipole, moments)
        none = np.zeros(3)
        for k, unit in enumerate(np.eye(3) * step):
            by_shift = (flux(unit, none) - flux(-unit, none)) / (2 * step)
            by_turn = (flux(none, unit) - flux(none, -unit)) / (2 * step)
            np.testing.assert_allclose(shift[:, k], by_shift, rtol=1e-5, atol=1e-9)
            np.testing.assert_allclose(turn[:, k], by_turn, rtol=1e-5, atol=1e-10)


class TestSetup:
    def document(self, windings=((0.01, 0.0, 0.0, 1.0), (-0.01, 0.0, 0.0, -1.0))):
        sensors = (
            SensorSpec(1, 't/plain', 't', (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.01),
            SensorSpec(2, 't/grad', 't', (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.0, windings),
        )
        return Setup('fg', 1.0, Emitter('magnet', {}, (Coil('c', (0, 0, 0), 0.0, 1.0),)), sensors)

    def test_windings_are_read_back_and_make_another_body(self):
        setup = self.document()
        assert parse_setup(dump_setup(setup)) == setup
        assert 'windings' not in dump_setup(self.document(()))
        assert setup.identity.bodies != self.document(()).identity.bodies

    def test_a_reference_is_a_single_coil(self):
        text = dump_setup(self.document()).replace('body: t\n', 'body: fg\n')
        with pytest.raises(SetupError, match='t/grad is a reference: it cannot have windings'):
            parse_setup(text)

    def test_a_diagnosis_takes_single_coils_only(self, rng):
        measured = resting(rng, count=30)
        with pytest.raises(DiagnosisError, match='has windings'):
            build_problem((measured,), None, None, None, None, Spread(flux_t=1e-12))

    @pytest.mark.parametrize(
        ('windings', 'words'),
        [
            ([[0, 0, 0, 1]], 'at least two windings'),
            ([[0, 0, 0], [0, 0, 0, 1]], r'must be \[x, y, z, weight\]'),
            ([[0, 0, 0, 'a'], [0, 0, 0, 1]], 'must be a number'),
        ],
    )
    def test_others_are_refused(self, windings, words):
        text = dump_setup(self.document()).replace(
            '  - - 0.01\n    - 0.0\n    - 0.0\n    - 1.0\n  - - -0.01\n    - 0.0\n    - 0.0\n'
            '    - -1.0\n', '',
        )  # fmt: skip
        assert text.count('windings:') == 1
        with pytest.raises(SetupError, match=words):
            parse_setup(text.replace('windings:', f'windings: {json.dumps(windings)}'))


class TestOnePlace:
    def test_places_and_inverted_sensors_are_found_none_falsely(self):
        rng = np.random.default_rng(4)
        wrong, noisy = (3, 10, 17, 28, 41, 44, 51, 57), (30,)
        measured = resting(rng, inverted=wrong, noisy=noisy)
        found = calibrated(measured)
        (polarity,) = found.model.effects
        assert polarity.name == 'sensor_polarity'
        named = set(polarity.parameters['channels'])
        assert named <= set(wrong) and len(named) >= 7
        assert polarity.evidence['held_out_log_probability'] > 0.0
        (loud,) = found.scan.reported_effects
        assert loud.name == 'excess_noise' and loud.parameters['channels'] == [30]
        for source, place, moment in zip(found.more['sources'], PLACES, MOMENTS, strict=True):
            assert np.linalg.norm(source['position_m'] - place) < 4.0 * source['sigma_m'] < 4e-3
            np.testing.assert_allclose(source['moment_am2'], moment, atol=5e-10)
        assert set(found.more['sensor_widths']) == set(KINDS)
        assert np.median(np.abs(found.held_out.error)) < 1e-3 * found.residuals.span_t
        # Without anything asked for, sensors are as stated.
        stated = calibrated(measured, ())
        assert stated.model.effects == () and stated.more['sensor_widths'] == {}
        error = [np.sqrt(np.mean(np.abs(c.held_out.error) ** 2)) for c in (stated, found)]
        assert error[1] < 0.5 * error[0]

    def test_sound_sensors_are_not_named(self):
        found = calibrated(resting(np.random.default_rng(5)))
        assert found.model.effects == () and found.scan.reported_effects == ()

    def test_a_field_of_zero_is_refused(self, rng):
        measured = resting(rng, count=30)
        for rows in (slice(None), slice(1, 2)):
            flux = measured.flux.copy()
            flux[:, :, rows] = 0.0
            with pytest.raises(FitError, match=r'all fluxes of .* are zero'):
                calibrated(dataclasses.replace(measured, flux=flux))

    def test_only_many_sensors_of_one_body_at_one_place(self, rng):
        measured = resting(rng, count=30)
        assert is_at_one_place([measured], ACCURACY)
        assert not is_at_one_place([measured, measured], ACCURACY)
        assert not is_at_one_place([measured.sensors_only(np.arange(29))], ACCURACY)
        moved = dataclasses.replace(measured, position=np.array([[0, 0, 0], [0, 0, 1e-5]]))
        assert not is_at_one_place([moved], ACCURACY)
        nowhere = dataclasses.replace(measured, has_pose=np.zeros(2, dtype=bool))
        assert not is_at_one_place([nowhere], ACCURACY)

    def test_windings_are_refused_elsewhere(self, rng):
        measured = resting(rng, count=30)
        with pytest.raises(FitError, match='h/s0 has windings'):
            check_single_coils([measured])
        with pytest.raises(TrackingError, match='single coil'):
            Tracker(None, measured.sensors)


@pytest.fixture
def rng():
    return np.random.default_rng(3)
