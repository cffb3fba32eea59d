"""Puts fitted coils beside digitised places: rigid alignment, and where the stylus touched."""

import itertools

import numpy as np
from numpy.typing import NDArray

from anser_ros.assessment.hummel import rigid_distance, rigid_distances

Array = NDArray[np.float64]

ARMS_M = np.arange(-6e-3, 6.001e-3, 5e-5)
"""Distances tried between a coil's magnetic centre and the digitised point, along its axis."""


def order_of(places_m: Array, digitised_m: Array) -> list[int]:
    """Return which fitted coil each digitised point is; far apart, only one order fits."""
    orders = itertools.permutations(range(len(digitised_m)))
    best = min(orders, key=lambda o: rigid_distance(places_m[list(o)], digitised_m))
    return list(best)


def distance_mm(places_m: Array, digitised_m: Array) -> float:
    """Return the rms distance to the digitised places after rigid alignment, mm."""
    order = order_of(places_m, digitised_m)
    return 1e3 * rigid_distance(places_m[order], digitised_m)


def outward(places_m: Array, moments: Array) -> Array:
    """Return axes of the coils, away from the middle of the head."""
    axes = moments / np.linalg.norm(moments, axis=1, keepdims=True)
    away = places_m - places_m.mean(axis=0) + np.array([0.0, 0.0, 0.05])
    return np.asarray(axes * np.sign(np.sum(axes * away, axis=1))[:, None])


def best_arm(places_m: Array, axes: Array, digitised_m: Array) -> float:
    """Return the arm (m) along the axes that brings rows of places closest to digitised ones."""
    misfit = [rigid_distance(places_m - arm * axes, digitised_m) for arm in ARMS_M]
    return float(ARMS_M[int(np.argmin(misfit))])


def arms_left_out(places_m: Array, moments: Array, digitised_m: Array) -> tuple[Array, Array]:
    """Return a lever arm that every coil shares, found without the coil that it is scored on.

    Returns
    -------
    arms : ndarray, shape (K,)
        Arm found on the other coils, m: the digitised point lies that much further in.
    distances : ndarray, shape (K,)
        Distance of the coil left out after rigid alignment of all with that arm, m.
    """
    order = order_of(places_m, digitised_m)
    places, axes = places_m[order], outward(places_m, moments)[order]
    arms, distances = np.zeros(len(order)), np.zeros(len(order))
    for k in range(len(order)):
        rest = np.arange(len(order)) != k
        arms[k] = best_arm(places[rest], axes[rest], digitised_m[rest])
        distances[k] = rigid_distances(places - arms[k] * axes, digitised_m)[k]
    return arms, distances
