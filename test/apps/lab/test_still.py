"""Few poses of a plate with many three-axis sensors: field, sensors, poses and bend (simulated).

Two or three emitters without a drawing make constant fields, and a piece of iron beside the plate
one of its own. Whatever is found is compared with what was put in.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tracking_world import three_axis

from anser_ros.apps.lab.calibration_engines import is_still
from anser_ros.apps.lab.still import AS_STATED, PLACEMENT, calibrate_still
from anser_ros.apps.lab.still_fit import StillFitter
from anser_ros.apps.lab.still_model import POSE, SmoothBend, StillModel, StillUnknowns
from anser_ros.calibration.held_out import rms
from anser_ros.calibration.layouts import Generator
from anser_ros.calibration.readings import DipoleSites
from anser_ros.calibration.result import to_document
from anser_ros.errors import FitError
from anser_ros.field.measurements import Measurements
from anser_ros.physics.dipole import dipole_field
from anser_ros.physics.rotations import tilted
from anser_ros.settings import Accuracy

pytestmark = pytest.mark.timeout(1800)  # half a minute of a quiet machine

CENTRES = np.array([[-0.08, 0.02, 0.0], [0.09, -0.01, 0.0], [0.0, 0.1, 0.0]])
DIRECTIONS = np.array([[0.0, 0.2, 0.98], [0.6, 0.0, 0.8], [0.0, -0.6, 0.8]])
IRON_AM2 = np.array([[0.3, 0.1, 0.2], [-0.1, 0.3, 0.1], [0.2, 0.2, -0.2]])
STRENGTH_AM2 = 60.0
IRON_M = np.array([0.13, 0.05, 0.3])
NOISE_T = 1e-6
HEIGHTS_M = np.array([0.24, 0.27, 0.3, 0.33])
KINDS = ('gains', 'axes', 'bend')
STATED = Accuracy(flux_noise_t=1e-5, optical_position_m=1e-3, optical_rotation_rad=5e-3)


def plate(per_side=5):
    """A square of three-axis sensors, 4 cm apart."""
    steps = 0.04 * (np.arange(per_side) - (per_side - 1) / 2)
    grid = np.array([[x, y, 0.0] for x in steps for y in steps])
    return three_axis('plate', grid)


def field(points, emitter, iron):
    """Field (P, 3), T, of one emitter, a magnet of some size, and of the iron that it drives."""
    half = 0.02 * DIRECTIONS[emitter]
    places = np.array([CENTRES[emitter] - half, CENTRES[emitter] + half])
    along, moments = np.tile(DIRECTIONS[emitter], (2, 1)), np.full((2, 1), STRENGTH_AM2 + 0j)
    if iron:
        size = np.linalg.norm(IRON_AM2[emitter])
        places, along = np.vstack([places, IRON_M]), np.vstack([along, IRON_AM2[emitter] / size])
        moments = np.vstack([moments, [[size + 0j]]])
    return dipole_field(points, places, along, moments)[..., 0].real


def recorded(
    seed, *, gain=0.02, tilt=0.03, bend=5e-4, iron=True, off=None, per_side=5, emitters=2
):
    """The plate's frames with these errors, and what they were.

    By ``off`` (F, 6) it is shifted (m) and turned (rad) from where it is stated, or drawn.
    """
    rng = np.random.default_rng(seed)
    sensors, frames = plate(per_side), len(HEIGHTS_M)
    gains = 1.0 + gain * rng.normal(size=len(sensors))
    tilts = tilt * rng.normal(size=(len(sensors), 2))
    shape = SmoothBend.of(sensors)
    terms = bend * rng.normal(size=(frames, shape.terms))
    shift, turned = shape.shape(terms)
    axes = tilted(sensors.axis, tilts)[None] + np.zeros((frames, 1, 1))
    axes = axes + np.cross(turned, axes)
    stated = np.column_stack([np.zeros((frames, 2)), HEIGHTS_M])
    drawn = [size * rng.normal(size=(frames, 3)) for size in (5e-4, 2e-3)]
    off = np.hstack(drawn) if off is None else off
    rotation = Rotation.from_rotvec(off[:, 3:]).as_matrix()
    points = np.einsum('fij,fsj->fsi', rotation, sensors.position + shift)
    points = points + (stated + off[:, :3])[:, None]
    axes = np.einsum('fij,fsj->fsi', rotation, axes)
    fields = [field(points.reshape(-1, 3), k, iron).reshape(axes.shape) for k in range(emitters)]
    flux = np.stack([np.einsum('psi,psi->ps', axes, one) for one in fields], axis=2)
    flux = gains[:, None] * flux + NOISE_T * rng.normal(size=flux.shape)
    valid = np.ones(flux.shape[:2], dtype=bool)
    measured = Measurements(
        'plate', sensors, np.arange(float(frames)), flux.astype(complex), valid,
        np.zeros(valid.shape, np.int64), stated, np.tile(np.eye(3), (frames, 1, 1)),
        np.ones(frames, dtype=bool),
    )  # fmt: skip
    return measured, gains, tilts


def calibrated(measured, kinds):
    count = measured.flux.shape[2]
    centres, tones = CENTRES[:count] + [[0.01, -0.01, 0.0]], (1.0, 2.0, 3.0)[:count]
    generator = Generator(centres, np.zeros(count), 0.1, tuple('abc'[:count]), tones)
    return calibrate_still(measured, generator, kinds, STATED)


class TestModel:
    @pytest.mark.parametrize('is_complex', [False, True])
    def test_columns_are_the_derivatives_of_the_fluxes(self, is_complex):
        rng = np.random.default_rng(3)
        measured, _, _ = recorded(1)
        sites = DipoleSites(np.repeat(CENTRES, 3, axis=0), np.tile(np.eye(3), (3, 1)))
        model = StillModel(measured, is_complex)
        nothing = model.nothing(9)
        now = StillUnknowns(
            50.0 * rng.normal(size=nothing.moments.shape),
            1e-5 * rng.normal(size=nothing.frames.shape),
            np.zeros_like(nothing.sensors),
        )
        columns = model.columns(now, sites, 1)

        def slope(size, changed):
            """Central differences (F, S, C) of the fluxes, and in the columns' order (S, R)."""
            ends = [model.flux(*changed(sign * size)) for sign in (-1.0, 1.0)]
            each = (ends[1] - ends[0]) / (2.0 * size)
            return each, each.transpose(1, 2, 0).reshape(each.shape[1], -1)

        def moved(part, where, step):
            values = getattr(now, part).copy()
            values[where] += step
            return replace(now, **{part: values}), sites

        for term in range(nothing.frames.shape[1]):
            each, _ = slope(1e-7, partial(moved, 'frames', (1, term)))
            given = columns.frames[:, :, 1, term]
            np.testing.assert_allclose(given, each[1], atol=3e-3 * np.abs(each[1]).max())
        for own in range(nothing.sensors.shape[1]):
            _, rows = slope(1e-6, partial(moved, 'sensors', (slice(None), own)))
            np.testing.assert_allclose(
                columns.own[:, :, own], rows, atol=3e-3 * np.abs(rows).max()
            )
        for j in range(3):
            last = np.where(np.arange(9)[:, None] > 5, np.eye(3)[j], 0.0)

            def shifted(step, last=last):
                return now, replace(sites, positions=sites.positions + step * last)

            _, rows = slope(1e-6, shifted)
            given = columns.places[:, :, j]
            np.testing.assert_allclose(given, rows, atol=1e-6 * np.abs(rows).max())

    def test_a_thick_body_does_not_bend(self):
        sensors = plate()
        thick = sensors.position + np.outer(np.arange(len(sensors)) % 2, [0.0, 0.0, 0.05])
        assert SmoothBend.of(replace(sensors, position=thick)) is None


class TestFit:
    @pytest.mark.long
    def test_what_was_put_in_is_found(self):
        measured, _, _ = recorded(11)
        fit = StillFitter(measured, CENTRES[:2], STATED).fit(KINDS)
        assert set(fit.evidence) == set(KINDS)
        assert 0.5 * NOISE_T < fit.widths.noise_t < 2.5 * NOISE_T
        assert fit.widths.sensors[0] == pytest.approx(0.02, rel=0.25)
        assert fit.widths.sensors[1] == pytest.approx(0.03, rel=0.25)
        assert fit.widths.frames[POSE] == pytest.approx(5e-4, rel=0.4)
        beside = fit.sites.positions[-3 * fit.beside :: 3]
        assert fit.beside and np.linalg.norm(beside - IRON_M, axis=1).min() < 0.02

    @pytest.mark.long
    def test_a_sound_plate_has_nothing(self):
        measured, _, _ = recorded(
            12, gain=0.0, tilt=0.0, bend=0.0, iron=False, off=np.zeros((4, 6))
        )
        fitter = StillFitter(measured, CENTRES[:2], STATED)
        fit = fitter.fit(KINDS)
        assert fit.evidence == {} and not fit.unknowns.sensors.any()
        assert fit.beside == 0 and fitter.evidence_of_poses(fit) < 0.0

    def test_zeros_are_refused(self):
        measured, _, _ = recorded(13)
        with pytest.raises(FitError, match='all fluxes are zero'):
            StillFitter(replace(measured, flux=0.0 * measured.flux), CENTRES, STATED)


@pytest.mark.long
def test_a_pose_that_took_no_part_is_predicted():
    measured, gains, _ = recorded(21, iron=False, bend=0.0, per_side=4)
    assert is_still([measured]) and not is_still([measured, measured])
    found, plain = calibrated(measured, KINDS[:2]), calibrated(measured, ())
    document = to_document(found)
    assert document['heldout_flux_rmse_t'] < 0.6 * to_document(plain)['heldout_flux_rmse_t']
    poses = document['heldout_by_pose']
    assert [pose['position_m'][2] for pose in poses] == HEIGHTS_M.tolist()
    mean = np.sqrt(np.mean([pose['flux_rmse_t'] ** 2 for pose in poses]))
    assert mean == pytest.approx(document['heldout_flux_rmse_t'])
    names = [effect['name'] for effect in document['effects']]
    assert names == ['sensor_gain_spread', 'sensor_axis_spread']
    assert document['unobservable'] == []
    assert found.model.effects[0].parameters['spread'] == pytest.approx(gains.std(), rel=0.25)
    # The model that is written explains the sensors so corrected.
    assert found.residuals.rmse_t < 0.2 * plain.residuals.rmse_t


@pytest.mark.long
def test_a_body_that_stands_elsewhere_than_stated_is_reported():
    off = np.random.default_rng(5).normal(size=(len(HEIGHTS_M), 6)) * ([2e-3] * 3 + [4e-3] * 3)
    sound = {'iron': False, 'bend': 0.0, 'per_side': 4, 'off': off}
    measured, _, _ = recorded(21, **sound, emitters=3)
    found = calibrated(measured, ('gains', 'axes', 'poses'))
    (told,) = found.scan.reported_effects
    assert told.name == PLACEMENT
    keys = 'shift_m', 'rotation_rad'
    error = np.hstack([told.parameters[key] for key in keys]) - (off - off.mean(axis=0))
    ratio = error / np.hstack([told.uncertainty[key] for key in keys])
    assert np.abs(error[:, :3]).max() < 8e-4 < 0.3 * told.parameters['largest_m']
    assert 0.3 < np.sqrt(np.mean(ratio**2)) < 1.5 and np.abs(ratio).max() < 4.0
    # The others' field explains the readings at the pose that was found, though not as stated.
    assert rms(found.held_out.error) < 0.4 * told.evidence[AS_STATED]
    three = calibrated(measured.frames(np.arange(3)), ('poses',))
    assert three.scan.reported_effects == ()  # so few poses don't tell it
    (line,) = to_document(three)['unobservable']
    assert line.startswith('poses:') and '4' in line


@pytest.mark.long
def test_what_no_fold_finds_is_not_corrected():
    """The evidence of all frames alone gave this sound plate tilts of 0.4 mrad."""
    measured, _, _ = recorded(13, gain=0.0, tilt=0.0, bend=0.0, off=np.zeros((4, 6)), emitters=3)
    fit = StillFitter(measured, CENTRES, STATED).fit(['axes'])
    assert 'axes' in fit.evidence
    scan = calibrated(measured, ('axes', 'poses')).scan
    assert not (*scan.corrections, *scan.reported_effects)
