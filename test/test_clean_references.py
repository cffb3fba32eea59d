"""Reference readings that are no baseline: metal at rest or moving is seen, the rest not."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import REPO
from refit_world import anser_world, metal_block, three_coil_world
from tracking_world import triaxial_tool

from anser_ros.calibration.disturbances import at_strength, emitter_strength
from anser_ros.calibration.result import drift_records
from anser_ros.errors import BagError, FitError
from anser_ros.field.model import ReferenceReadings
from anser_ros.frames.intake import Intake
from anser_ros.integrity.clean_references import (
    change_without_gains,
    check_as_calibrated,
    check_as_drawn,
    check_steady,
)
from anser_ros.refit.frame import ReadingWindow
from anser_ros.sessions.baseline import baseline_flux, check_clean, clean_flux, readings_of
from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import load_model
from anser_ros.settings import Accuracy

SEED = 7
ACCURACY = Accuracy()
SIGMA_T = 2e-12


def known_of(world):
    table = world.references
    return ReferenceReadings(table.name, table.position, table.axis, world.baseline, SIGMA_T)


def drifted(world, rng):
    """Other strengths of the emitters, one sensor turned, one without a reading, and noise."""
    gains = 1 + 0.05 * rng.normal(size=world.baseline.shape[1])
    flux = world.baseline * gains + world.noise(rng, SIGMA_T)
    flux[3] *= 1.1
    flux[7] = np.nan
    return flux


@pytest.mark.parametrize('world', [anser_world(), three_coil_world()])
def test_metal_at_rest_differs_from_the_calibration_and_drift_does_not(world, rng):
    flux = drifted(world, rng)
    assert check_as_calibrated(known_of(world), world.references, flux, SIGMA_T, ACCURACY)
    change = change_without_gains(flux, world.baseline)
    assert np.isnan(change[7]) and change[3] > 0.05
    assert np.nanmedian(change) < 1e-4
    metal = world.metal(metal_block((0.05, 0.0, -0.08), (0.06, 0.06, 0.02)))
    with pytest.raises(FitError, match='those of the calibration; is metal nearby'):
        check_as_calibrated(known_of(world), world.references, flux + metal, SIGMA_T, ACCURACY)
    moved = replace(world.references, position=world.references.position + 0.001)
    assert not check_as_calibrated(known_of(world), moved, flux + metal, SIGMA_T, ACCURACY)


def recorded(world, rng, sigma_t, metal=0.0, parts=()):
    """12 frames while emitters drift; metal is there in some of three parts, a coil jumps."""
    drift = 1 + 1e-3 * np.outer(np.arange(12) / 12, rng.normal(size=world.baseline.shape[1]))
    flux = world.baseline * drift[:, None] + [world.noise(rng, sigma_t) for _ in range(12)]
    flux[6:, 2] *= 1.1
    flux[:, 7] = np.nan
    for part in parts:
        flux[4 * part : 4 * part + 4] += metal
    return flux


def test_metal_that_moves_is_seen_whenever_it_is_there(rng):
    world = anser_world()
    metal = 0.05 * world.metal(metal_block((0, 0, -0.08), (0.1, 0.1, 0.02)))
    sigma = check_steady(recorded(world, rng, SIGMA_T))
    assert sigma == pytest.approx(SIGMA_T / np.sqrt(12), rel=0.2)
    for when in range(3):
        with pytest.raises(FitError, match='is metal moving'):
            check_steady(recorded(world, rng, SIGMA_T, metal, [when]))
        assert check_steady(recorded(world, rng, 1e-7, metal, [when]))  # lost in noise
    assert check_steady(recorded(world, rng, SIGMA_T)[:11]) is None
    lossy = recorded(world, rng, SIGMA_T)
    lossy[2:4] = np.nan  # windows that were lost
    assert check_steady(lossy) == pytest.approx(sigma, rel=0.3)


@pytest.mark.parametrize('world', [anser_world(), three_coil_world()])
def test_the_drawing_knows_the_survey_and_the_tolerances_but_no_plate(world, rng):
    table, board = world.references, world.board
    off = table.position + ACCURACY.reference_position_m * rng.normal(size=table.position.shape)
    surveyed = replace(table, position=off)
    gain = 1 + 0.02 * rng.normal(size=world.baseline.shape[1])
    own = 1 + ACCURACY.reference_gain * rng.normal(size=(len(table), 1))
    flux = gain * own * world.baseline
    check_as_drawn(board.field, board.centres, surveyed, flux, ACCURACY)
    plate = world.metal(metal_block((0, 0, -0.06), (0.2, 0.2, 0.001)), polarisability=-2000.0)
    with pytest.raises(FitError, match='drawn board by'):
        check_as_drawn(board.field, board.centres, surveyed, flux + plate, ACCURACY)


def test_a_recording_with_metal_is_no_baseline():
    clean, metal = (load_session(REPO / 'bags' / f'{n}.mcap') for n in ('factory', 'metal'))
    model, sensors = load_model(REPO / 'config/demo_model.yaml'), clean.reference.sensors
    assert np.isfinite(clean_flux(clean, sensors, model)).all()
    with pytest.raises(BagError, match=r'metal.mcap is not usable as a baseline: reference'):
        clean_flux(metal, sensors, model)
    assert readings_of(metal) is None and readings_of(replace(clean, reference=None)) is None
    kept = replace(model, references=readings_of(clean))
    assert kept.references.sigma_t < 5e-12
    flux = baseline_flux(clean, sensors)
    check_clean(kept, sensors, flux, SIGMA_T, clean.setup)
    near = np.where(np.arange(8) < 4, 1.0, 1.0 + 0.02 * sensors.axis[:, :1]) * flux
    with pytest.raises(FitError, match='those of the calibration'):
        check_clean(kept, sensors, near, SIGMA_T, clean.setup)


TOOL = triaxial_tool()
CHANNELS = TOOL.channel
STEP_NS = 20_000_000


def test_baseline_window():
    window, intake = ReadingWindow(TOOL, 8, 0.1), Intake(CHANNELS)
    with pytest.raises(FitError, match='needs 3 frames'):
        window.mean()
    flux = 1e-3 * (np.arange(72.0).reshape(9, 8) + 1j)
    flags = np.zeros(9, int)
    for i in range(10):
        noisy = flux + (1e-3 if i % 2 else -1e-3)
        noisy[0] = np.nan
        flags[1] = 1 if i < 8 else 0
        window.add(intake.judge((i + 1) * STEP_NS, CHANNELS[::-1], noisy[::-1], flags[::-1]))
    assert window.full
    assert len(window) == 6, 'only the last tenth of a second'
    mean = window.mean()
    assert np.isnan(mean[0]).all()
    assert np.isnan(mean[1]).all(), 'flagged in most frames'
    np.testing.assert_allclose(mean[2:], flux[2:])
    window.add(intake.judge(1, CHANNELS, flux, flags))
    assert len(window) == 1, 'a jump back starts anew'
    assert not window.full
    with pytest.raises(FitError, match='8 emitters'):
        window.add(intake.judge(1, CHANNELS, flux[:, :3], flags))
    with pytest.raises(FitError, match='positive'):
        ReadingWindow(TOOL, 8, 0.0)
    dead = ReadingWindow(TOOL, 8, 1.0)
    for i in range(4):
        dead.add(intake.judge(i + 1, CHANNELS, np.full((9, 8), np.nan, complex), flags))
    with pytest.raises(FitError, match='no reference'):
        dead.mean()


@pytest.fixture(scope='module')
def references():
    """References of simulated recordings: without metal, and with metal that comes near."""
    return [load_session(REPO / 'bags' / f'{name}.mcap').reference for name in ('moving', 'metal')]


def test_a_drift_is_found_and_taken_away(references):
    steady, _ = references
    time = steady.time - steady.time[0]
    true = np.ones((time.size, steady.flux.shape[2]), dtype=complex)
    true[:, 5] = 1.0 + (0.03 + 0.005j) * (1.0 - np.exp(-time / 6.0))
    drifting = replace(steady, flux=steady.flux * true[:, None])
    strength = emitter_strength(drifting)
    assert (np.delete(strength, 5, axis=1) == 1.0).all()
    # The state is that of the start, which the next session begins in.
    assert np.abs(strength[:, 5] / true[:, 5] - 1.0).max() < 2e-3
    constant = at_strength(drifting, drifting.time, strength)
    assert (emitter_strength(constant) == 1.0).all()
    (record,) = drift_records(strength)
    assert record.parameters['coil'] == 5
    way = np.ptp(np.abs(true[:, 5]))
    assert record.parameters['amount'] == pytest.approx(way, rel=0.05)


def test_steady_emitters_and_metal_are_no_drift(references):
    for reference in references:
        assert (emitter_strength(reference) == 1.0).all()
    few = references[0].sensors_only(np.arange(3))
    assert (emitter_strength(replace(few, flux=few.flux * 1.5)) == 1.0).all()
    assert drift_records(emitter_strength(references[1])) == ()
