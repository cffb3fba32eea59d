"""Closed current paths of printed coils as a factory makes them: two layers, errors, leads.

A coil is wound inwards on the top layer, goes down through a via, and outwards on the bottom
layer; two leads, one above the other with a small offset, run to the board's edge and back, which
closes the path. Everything is drawn track by track; there is no equivalent loop anywhere.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Winding:
    """What a coil is meant to be."""

    side_x_m: float  # outer sides between track centres
    side_y_m: float
    pitch_m: float  # distance of neighbouring turns
    turns: float  # of both layers together
    thickness_m: float  # of the board, hence between the layers


@dataclass(frozen=True)
class Errors:
    """Standard deviations of what manufacturing gets wrong."""

    shift_m: float = 0.2e-3
    height_m: float = 0.05e-3
    turn_rad: float = np.radians(0.2)
    tilt_rad: float = np.radians(0.1)
    pitch: float = 0.004
    gap: float = 0.04
    corner_m: float = 0.03e-3
    strength: float = 0.002


SIDES = np.array([[0, 1], [1, 0], [0, -1], [-1, 0]])
"""Outward normals of the tracks of a turn, clockwise seen from +z: far, right, near, left."""


def _tracks(winding, pitch):
    """Corners (n, 2) of both layers in turn, and the layer (n,) that each lies on."""
    each = round(2 * winding.turns)
    inset = pitch * (np.arange(each) // 4)
    inset = np.concatenate([inset, inset[::-1]])
    half = 0.5 * np.array([winding.side_x_m, winding.side_y_m])
    line = [SIDES[j % 4] * (half - inset[j]) for j in range(2 * each)]  # the one coordinate set
    corners = [line[0] - SIDES[1] * half]
    corners += [line[j - 1] + line[j] for j in range(1, 2 * each)]
    corners.append(line[-1] + SIDES[2 * each % 4] * half)
    corners.insert(each, corners[each])  # the via
    layer = np.repeat([0, 1], [each + 1, each + 1])
    return np.array(corners), layer


def draw(winding, centre, rotation_deg, lead_to, errors, rng, clockwise=True):
    """Draw one coil with errors of its own.

    Returns its corners (M, 3), m, of which the last is joined to the first, and what the current
    is really worth, near 1. ``centre`` (3,), m, is on the top copper; the leads end at ``lead_to``
    (2,), m, on the board's edge; a positive current goes ``clockwise`` seen from +z, or not.
    """
    pitch = winding.pitch_m * (1 + errors.pitch * rng.normal())
    gap = winding.thickness_m * (1 + errors.gap * rng.normal())
    corners, layer = _tracks(winding, pitch)
    path = np.column_stack([corners, -gap * layer])
    path[:, :2] += errors.corner_m * rng.normal(size=(len(path), 2))
    path = path @ _placed(rotation_deg, errors, rng).T + centre
    path = path + rng.normal(size=3) * [errors.shift_m, errors.shift_m, errors.height_m]
    edge = np.array([*lead_to, centre[2]])
    away = [edge - [0.0, 0.0, gap], edge + [0.0005, 0.0003, 0.0]]
    path = np.concatenate([path, away])
    strength = 1 + errors.strength * rng.normal()
    return (path if clockwise else path[::-1].copy()), strength


def _placed(rotation_deg, errors, rng):
    """Turn about z with its error, then a small tilt."""
    angle = np.radians(rotation_deg) + errors.turn_rad * rng.normal()
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]]
    )
    x, y = errors.tilt_rad * rng.normal(size=2)
    return np.array([[1, 0, y], [0, 1, -x], [-y, x, 1]]) @ turn
