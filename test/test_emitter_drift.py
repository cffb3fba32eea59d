"""Emitters that drift during a scan are told from metal, and made constant."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from anser_ros.calibration.disturbances import at_strength, emitter_strength
from anser_ros.calibration.result import drift_records
from anser_ros.sessions.session import load_session

BAGS = Path(__file__).resolve().parents[1] / 'bags'


@pytest.fixture(scope='module')
def recorded():
    """References of simulated recordings: without metal, and with metal that comes near."""
    return [load_session(BAGS / f'{name}.mcap').reference for name in ('moving', 'metal')]


def test_a_drift_is_found_and_taken_away(recorded):
    steady, _ = recorded
    time = steady.time - steady.time[0]
    true = np.ones((time.size, steady.flux.shape[2]), dtype=complex)
    true[:, 5] = 1.0 + (0.03 + 0.005j) * (1.0 - np.exp(-time / 6.0))
    drifting = replace(steady, flux=steady.flux * true[:, None])
    strength = emitter_strength(drifting)
    assert (np.delete(strength, 5, axis=1) == 1.0).all()
    ratio = strength[:, 5] / true[:, 5]
    assert np.abs(ratio / ratio.mean() - 1.0).max() < 1e-3
    constant = at_strength(drifting, drifting.time, strength)
    assert (emitter_strength(constant) == 1.0).all()
    (record,) = drift_records(strength)
    assert record.parameters['coil'] == 5
    way = np.ptp(np.abs(true[:, 5]))
    assert record.parameters['amount'] == pytest.approx(way, rel=0.05)


def test_steady_emitters_and_metal_are_no_drift(recorded):
    for reference in recorded:
        assert (emitter_strength(reference) == 1.0).all()
    few = recorded[0].sensors_only(np.arange(3))
    assert (emitter_strength(replace(few, flux=few.flux * 1.5)) == 1.0).all()
    assert drift_records(emitter_strength(recorded[1])) == ()
