"""Moves a drawn board's coils to where the readings put them.

A board's coils are etched, glued and soldered a fraction of a millimetre off, and near them that
is most of what a nominal model misses. Far fewer readings determine six coordinates and a complex
gain per coil than free moments.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.arrays import Array, ComplexArray, Integers
from anser_ros.calibration.readings import DipoleSites, weighted_readings
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel
from anser_ros.physics.dipole import flux_basis

SHIFT_M = 2e-3
"""Prior width of a coil's shift along each axis, m: some times what boards differ by."""
TURN_RAD = 0.03
"""Prior width of a coil's turn about each axis, rad, for the same reason."""
DIFFERENCE = 1e-2
"""Step by which derivatives are taken, as a fraction of these widths."""
COIL_STEPS = 5
"""Gauss-Newton steps of a coil at most; two are enough for shifts of a millimetre."""
COIL_AT_REST = 1e-3
"""Step, as a fraction of the widths, below which a coil stays where it is."""


class CoilPlacer:
    """Places the coils of a drawn board by readings whose poses are right."""

    def __init__(self, nominal: FieldModel) -> None:
        self.nominal = nominal
        used = nominal.moments != 0.0
        self.rows = [np.flatnonzero(used[:, k]) for k in range(used.shape[1])]
        self.possible = bool((used.sum(axis=1) == 1).all() and used.any(axis=0).all())

    @property
    def sites(self) -> DipoleSites:
        """Return the dipoles of the coils as drawn."""
        return DipoleSites(self.nominal.positions, self.nominal.directions)

    def fit(
        self, corrected: Sequence[Measurements], weights: Sequence[Array]
    ) -> tuple[DipoleSites, ComplexArray]:
        """Return the coils' dipoles where the readings put them, and their moments.

        Returns N dipoles, and their moments (N, K), A m^2.
        """
        (points, axes, lengths, flux), root = weighted_readings(corrected, weights)
        positions, directions = self.nominal.positions.copy(), self.nominal.directions.copy()
        moments = np.zeros_like(self.nominal.moments)
        for k, rows in enumerate(self.rows):
            strength = self.nominal.moments[rows, k]

            def field(
                at: Array, rows: Integers = rows, strength: ComplexArray = strength
            ) -> ComplexArray:
                place, turned = self._placed(rows, at)
                made = flux_basis(points, axes, lengths, place, turned) @ strength
                return np.asarray(root * made)

            at, gain = _coil_fit(field, root * flux[:, k])
            positions[rows], directions[rows] = self._placed(rows, at)
            moments[rows, k] = gain * strength
        return DipoleSites(positions, directions), moments

    def _placed(self, rows: Integers, at: Array) -> tuple[Array, Array]:
        """Return a coil's dipoles shifted by at[:3] (m) and turned by at[3:] (rad) about it."""
        where = self.nominal.positions[rows]
        middle = where.mean(axis=0)
        turn = Rotation.from_rotvec(at[3:]).as_matrix()
        placed = (where - middle) @ turn.T + middle + at[:3]
        return placed, self.nominal.directions[rows] @ turn.T


def _coil_fit(field: Callable[[Array], ComplexArray], flux: ComplexArray) -> tuple[Array, complex]:
    """Return the shift and turn (6,) of one coil, and its complex gain, by weighted readings."""
    widths = np.repeat([SHIFT_M, TURN_RAD], 3)
    at, best = np.zeros(6), None
    for _ in range(COIL_STEPS):
        drawn = field(at)
        gain = complex(np.vdot(drawn, flux)) / max(float(np.vdot(drawn, drawn).real), 1e-300)
        rest = flux - gain * drawn
        noise = float(np.sqrt(np.mean(np.abs(rest) ** 2) / 2.0))
        cost = float(np.vdot(rest, rest).real)
        if best is not None and cost >= best[0]:
            break
        best = (cost, at, gain)
        steps = DIFFERENCE * np.diag(widths)
        slopes = np.stack([(field(at + step) - drawn) / DIFFERENCE for step in steps], axis=1)
        columns = np.concatenate([gain * slopes, drawn[:, None], 1j * drawn[:, None]], axis=1)
        rows = np.concatenate([columns.real, columns.imag])
        hold = noise * np.eye(6, columns.shape[1])
        right = np.concatenate([rest.real, rest.imag, -noise * at / widths])
        step = np.linalg.lstsq(np.concatenate([rows, hold]), right, rcond=None)[0][:6]
        at = at + widths * step
        if np.abs(step).max() < COIL_AT_REST:
            break
    assert best is not None
    return best[1], best[2]
