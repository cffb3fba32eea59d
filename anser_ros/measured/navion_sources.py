"""Locates the sources: one dipole a coil finds its magnet, a scan finds metal nearby.

Nothing here knows the rig's drawing. A magnet is where one dipole a coil fits that coil's field
best; its cloud is a cuboctahedron about that place. Metal is where one more dipole, free in all
coils, raises the evidence of a fit most.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from anser_ros.measured.navion_fit import PlateFit
from anser_ros.measured.navion_plate import PlateData, Sources, vector_basis

Array = NDArray[np.float64]

CLOUD_RADIUS = 0.05
"""Radius (m) of a magnet's cloud: about a coil's own radius."""

_SCAN_STEP = 0.06
"""Distance of neighbouring places of the scan for metal, m."""
_CLEARANCE = 0.015
"""Smallest distance of a scanned place from a sensor, m."""
_BATCH = 64
"""Places of the scan that are in memory at a time."""


def locate_magnets(data: PlateData) -> Array:
    """Return the place (K, 3), m, of the single dipole that explains each coil's field best.

    The start is the best point of a coarse grid around the plates; the moment is eliminated.
    """
    points = _nominal_points(data).reshape(-1, 3)
    grid = outside_points(data, 0.08, margin=0.08, reach=0.35)
    found = []
    for k in range(data.field_t.shape[1]):
        field = data.field_t[:, k].reshape(-1)

        def misfit(place: Array, field: Array = field) -> Array:
            basis = vector_basis(points, place[None]).reshape(len(field), 3)
            moment = np.linalg.lstsq(basis, field, rcond=None)[0]
            return np.asarray((basis @ moment - field) * 1e3)

        start = min(grid, key=lambda place: float((misfit(place) ** 2).sum()))
        found.append(least_squares(misfit, start, x_scale=0.01).x)
    return np.array(found)


def magnet_cloud(magnets_m: Array, radius_m: float = CLOUD_RADIUS) -> Array:
    """Return thirteen dipole places a magnet: its centre and the corners of a cuboctahedron."""
    pairs = [(0, 1), (0, 2), (1, 2)]
    corners = [np.zeros(3)]
    for i, j in pairs:
        for a in (-1.0, 1.0):
            for b in (-1.0, 1.0):
                corner = np.zeros(3)
                corner[i], corner[j] = a, b
                corners.append(corner * radius_m / np.sqrt(2.0))
    return np.asarray((magnets_m[:, None] + np.array(corners)).reshape(-1, 3))


def outside_points(data: PlateData, step_m: float, margin: float, reach: float) -> Array:
    """Return grid points (n, 3) around the measured volume, at least `margin` away from its
    box.
    """
    points = _nominal_points(data).reshape(-1, 3)
    low, high = points.min(axis=0), points.max(axis=0)
    axes = [
        np.arange(a - reach, b + reach + step_m / 2, step_m)
        for a, b in zip(low, high, strict=True)
    ]
    grid = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 3)
    inside = ((grid > low - margin) & (grid < high + margin)).all(axis=1)
    return np.asarray(grid[~inside])


def scan_for_metal(data: PlateData, fit: PlateFit, metal_am2: float) -> tuple[Array, float]:
    """Return the place (3,), m, where one more dipole gains most log evidence, and that gain.

    Parameters
    ----------
    data : PlateData
        What `fit` was fitted to, every reading taken at its word (``robust=False``): metal shows
        in few sensors, which a robust fit has learnt to distrust.
    fit : PlateFit
        Fit without the new object.
    metal_am2 : float
        Expected moment of an object.
    """
    grid = outside_points(data, _SCAN_STEP, _CLEARANCE, reach=0.17)
    gain = np.concatenate(
        [
            _gains(data, fit, grid[start : start + _BATCH], metal_am2)
            for start in range(0, len(grid), _BATCH)
        ]
    )
    best = int(np.argmax(gain))
    return grid[best], float(gain[best])


def polarizability(sources: Sources, index: int) -> tuple[Array, float]:
    """Return the polarisability (3, 3), m^3, of a metal object, and how far it is from symmetric.

    The object's moments were free in every coil. One small object answers all coils with one
    symmetric tensor, ``mu0 m_k = alpha B_k`` (reciprocity); large asymmetry, 0 to 1, says that the
    dipole stands for something extended.
    """
    place = sources.position_m[len(sources.position_m) - sources.n_metal + index]
    moment = sources.moment_am2[len(sources.position_m) - sources.n_metal + index]
    field = sources.magnets.field(place[None])[0]
    alpha = 4e-7 * np.pi * np.linalg.solve(field.T, moment.T).T
    odd = np.linalg.norm(alpha - alpha.T) / 2.0
    return alpha, float(odd / np.linalg.norm(alpha))


def _gains(data: PlateData, fit: PlateFit, places: Array, metal_am2: float) -> Array:
    white = fit.whitened
    n_planes, n_sensors = white.position.shape[:2]
    n_coils = data.field_t.shape[1]
    basis = vector_basis(white.position.reshape(-1, 3), places)
    reading = white.sensing @ basis.reshape(n_planes, n_sensors, 3, -1)
    reading = reading.transpose(1, 0, 2, 3).reshape(n_sensors, 3 * n_planes, -1)
    rows = white.inverse_root.shape[1]
    columns = np.zeros((n_coils, n_sensors, rows, reading.shape[2]))
    for k in range(n_coils):
        own = slice(k * 3 * n_planes, (k + 1) * 3 * n_planes)
        columns[k] = white.inverse_root[:, :, own] @ reading
    by_place = columns.reshape(n_coils, n_sensors * rows, len(places), 3).transpose(2, 0, 3, 1)
    flat = by_place.reshape(len(places) * n_coils * 3, -1)
    shadow = (flat @ white.reach).reshape(len(places), n_coils * 3, -1)
    pull = (flat @ white.residual).reshape(len(places), -1)
    free = flat.reshape(len(places), n_coils * 3, -1)
    normal = free @ free.transpose(0, 2, 1) - shadow @ shadow.transpose(0, 2, 1)
    normal = normal + np.eye(n_coils * 3) / metal_am2**2
    step = np.linalg.solve(normal, pull[..., None])[..., 0]
    volume = np.linalg.slogdet(normal * metal_am2**2)[1]
    return np.asarray(0.5 * (pull * step).sum(axis=1) - 0.5 * volume)


def _nominal_points(data: PlateData) -> Array:
    lift = np.stack([np.zeros_like(data.height_m)] * 2 + [data.height_m], axis=1)
    return np.asarray(data.grid_m[None] + lift[:, None])
