"""Frames for a refit of the tests' world, and the error of what it makes of them."""

from dataclasses import replace

import numpy as np
from refit_world import metal_block, volume_points

STEP_NS = 20_000_000
HEAD = metal_block([0.03, -0.02, -0.11], [0.1, 0.12, 0.06])


def run(refit, world, change, frames=3, seed=1, start=1, fault=None, flags=None):
    """Feed frames with noise; the last result."""
    rng, result = np.random.default_rng([seed, start]), None  # never the same noise again
    for frame in range(frames):
        flux = world.baseline + change + world.noise(rng)
        if fault is not None:
            fault(flux)
        stamp = (start + frame) * STEP_NS
        result = refit.update(stamp, world.references.channel, flux, flags)
    return result


def errors(world, model, points, polarisability=-600.0 + 80.0j):
    """Rms of the field's error before and after, and the predicted sigma, over the volume, T."""
    places, axes = volume_points()
    tools = replace_geometry(world.references, places, axes)
    truth = world.metal(points, tools, polarisability)
    made = model.flux(places, axes) - world.model.flux(places, axes)
    modes = np.zeros((0, 1)) if model.modes is None else model.modes
    spread = np.full(truth.shape, model.flux_error_t**2)
    for mode in modes:
        spread += np.abs(replace(model, moments=mode, modes=None).flux(places, axes)) ** 2 / 2.0
    return rms(truth), rms(truth - made), np.sqrt(spread), truth - made


def share_left(world, model, points):
    """What is left of the field's error over the volume."""
    before, after, _, _ = errors(world, model, points)
    return after / before


def replace_geometry(table, places, axes):
    """The references' table cut or repeated to other places."""
    rows = np.arange(len(places)) % len(table)
    return table.select(rows).with_geometry(places, axes, np.zeros(len(places)))


def rms(values):
    return float(np.sqrt(np.mean(np.abs(values) ** 2)))
