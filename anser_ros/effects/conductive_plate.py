"""A metal sheet parallel to the board distorts the field by its eddy currents."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import (
    FROZEN,
    Array,
    ComplexArray,
    Effect,
    Family,
    Remedy,
    Resting,
    Term,
    needed,
    sigmas,
)
from anser_ros.effects.view import Apparatus, View
from anser_ros.field.dipoles import Dipoles
from anser_ros.field.model import EffectRecord
from anser_ros.metal.body import sheet_shapes, sheet_sizes, sheet_sources

MESH = 12
"""Loops along an edge of the sheet's mesh: a loop is then as wide as a twelfth of the edge, less
than the distance to the sensors for any sheet that is found."""
DIFFERENCE_STEPS = np.array([1e-3, 1e-3, 1e-3, 1e-3, 0.05])
"""Steps of the central differences, in theta's units: small compared with the distances and with
a change of the resistance that shows."""
TYPICAL_OHM = 3e-5
"""Surface resistance, ohm, that a plate's fit starts from: about that of a millimetre of
aluminium. It is only a start, from which the fit moves."""

HEIGHT, RIM, OHM = 0.005, 0.03, 0.1
"""How well a sheet is known at best, whose true outline, thickness and bend are unknown: its
height and each rim as shares of its edge, and its resistance."""


class ConductivePlate(Effect[Term]):
    """Theta is height z, edge, centre x and y (m), and the log of the sheet resistance (ohm)."""

    name = 'conductive_plate'
    summary = 'a metal sheet lies parallel to the board'
    units = {
        'z_m': 'm',
        'edge_m': 'm',
        'centre_m': 'm',
        'sheet_ohm': 'ohm',
    }
    plausible = {
        'z_m': (-1.0, 1.0),
        'edge_m': (0.02, 2.0),
        'sheet_ohm': (1e-7, 1.0),
    }
    remedy = Remedy.FIELD
    family = Family.METAL_AT_REST
    inexact = np.inf

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Try heights below the board and above the volume, in two sizes."""
        size = float(np.max(apparatus.board[1, :2] - apparatus.board[0, :2]))
        middle = apparatus.board.mean(axis=0)
        below = apparatus.board[0, 2] - size * np.array([0.08, 0.16, 0.26, 0.4, 0.6])
        above = apparatus.visited_box[1, 2] + size * np.array([0.25, 0.5])
        return [
            Term(
                self,
                {'z': float(z), 'edge': float(edge)},
                np.array([z, edge, middle[0], middle[1], np.log(TYPICAL_OHM)]),
            )
            for z in (*below, *above)
            for edge in (0.6 * size, size, 1.8 * size)
        ]

    def amounts(self, term: Term) -> NDArray[np.int64]:
        """Return the edge's index: a sheet without size has no effect."""
        return np.array([1])

    def prior(self, term: Term) -> Array:
        """Expect heights and places near the board, resistances over decades; a held sheet
        stays.
        """
        if term.held:
            return np.full(5, FROZEN)
        return np.array([0.1, 0.2, 0.1, 0.1, 3.0])

    def bounded(self, term: Term) -> Term:
        """Keep the edge length and the sheet resistance within what exists."""
        theta = term.theta.copy()
        theta[1] = np.clip(theta[1], 0.02, 2.0)
        theta[4] = np.clip(theta[4], np.log(1e-7), 0.0)
        return term.with_theta(theta)

    def covers(self, term: Term, candidate: Term) -> bool:
        """Cover a sheet of any height and size: only one sheet is looked for."""
        return candidate.effect is self

    def resting(self, term: Term) -> Resting:
        """Return what the sheet's currents lack, in waves over the sheet."""
        edge = float(term.theta[1])
        return Resting(term.theta[[2, 3, 0]], [(sheet_shapes(edge), sheet_sizes(edge))])

    def sources(
        self, term: Term, base: Dipoles, illumination: Dipoles, omega: Array
    ) -> Dipoles | None:
        """Return the loops of the sheet; none where no amount has been set yet."""
        z, edge, x, y, log_ohm = term.theta
        centre, edges = np.array([x, y, z]), np.array([edge, edge])
        return sheet_sources(centre, edges, float(np.exp(log_ohm)), MESH, illumination, omega)

    def _flux(self, theta: Array, view: View) -> ComplexArray:
        added = self.sources(Term(self, {}, theta), view.dipoles, view.illumination, view.omega)
        assert added is not None
        return view.along(added.flux(*view.flat))

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return the flux's derivatives, taken by central differences with `DIFFERENCE_STEPS`."""
        if term.held:
            return view.columns(5)
        parts = [
            (self._flux(term.theta + step, view) - self._flux(term.theta - step, view))
            / (2 * DIFFERENCE_STEPS[i])
            for i, step in enumerate(np.diag(DIFFERENCE_STEPS))
        ]
        return np.stack(parts, axis=-1)

    def probe(self, term: Term, view: View) -> ComplexArray | None:
        """Return the columns of a sheet of this height and size, of any strength and phase."""
        unit = self._flux(term.theta, view)
        return np.stack([unit, 1j * unit], axis=-1)

    def started(self, term: Term, solution: Array) -> Sequence[Term]:
        """Return the term of the sheet as it was probed."""
        return (term,)

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Record height, edge length and centre of the sheet, m, and its resistance, ohm."""
        z, edge, x, y, log_ohm = (float(v) for v in term.theta)
        ohm, rim = float(np.exp(log_ohm)), RIM * edge
        least = [HEIGHT * edge, np.sqrt(2) * rim, rim / np.sqrt(2), rim / np.sqrt(2), OHM]
        sigma = np.hypot(sigmas(covariance), least)
        return EffectRecord(
            self.name,
            {'z_m': z, 'edge_m': edge, 'centre_m': [x, y], 'sheet_ohm': ohm},
            {
                'z_m': float(sigma[0]),
                'edge_m': float(sigma[1]),
                'centre_m': sigma[2:4].tolist(),
                'sheet_ohm': ohm * float(sigma[4]),
            },
        )

    def term(self, record: EffectRecord) -> Term:
        """Read height, edge length, centre and sheet resistance from a record."""
        x, y = needed(record, 'centre_m')
        theta = np.array(
            [
                float(needed(record, 'z_m')),
                float(needed(record, 'edge_m')),
                float(x),
                float(y),
                np.log(float(needed(record, 'sheet_ohm'))),
            ]
        )
        return Term(self, {}, theta)


EFFECTS = (ConductivePlate(),)
