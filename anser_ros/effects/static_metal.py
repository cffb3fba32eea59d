"""A metal object rests near the volume."""

from collections.abc import Sequence
from itertools import product

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
from anser_ros.metal.body import (
    BODIES,
    COMPACT,
    SPACINGS,
    ball_modes,
    body_sizes,
    centre_sigma,
    multipoles,
)
from anser_ros.metal.scattering import UNIT
from anser_ros.physics.constants import MU_0

STEP = 1e-3
"""Step (m) of the central differences that give the derivative by the place, small compared with a
decimetre."""
CLOSEST = 0.02
"""Metal that is searched keeps this distance (m) from where sensors were: a point-like answer is
no model of a body that is nearer than its own size."""
SAME_BODY_M = 0.12
"""Distance (m) from active metal within which further metal is taken for the same body: about
the step of the grid of places. Nearer candidates only stand in for the body's shape."""


def places(apparatus: Apparatus) -> Array:
    """Return where metal is looked for: a grid about the board and the volume, (n, 3), m, fg."""
    low = np.minimum(apparatus.board[0], apparatus.visited_box[0])
    high = np.maximum(apparatus.board[1], apparatus.visited_box[1])
    size = float(np.max(high[:2] - low[:2]))
    lateral = [np.linspace(low[i] - 0.2 * size, high[i] + 0.2 * size, 7) for i in (0, 1)]
    around = [np.linspace(low[i] - 0.5 * size, high[i] + 0.5 * size, 5) for i in (0, 1)]
    below = apparatus.board[0, 2] - size * np.array([0.06, 0.14, 0.24, 0.38, 0.6])
    above = apparatus.visited_box[1, 2] + size * np.array([0.2, 0.45])
    beside = np.linspace(apparatus.board[1, 2], apparatus.visited_box[1, 2], 3)
    grid = [(x, y, z) for z in (*below, *beside, *above) for x, y in product(*lateral)]
    ring = [
        (x, y, z)
        for z in beside
        for x, y in product(*around)
        if x in around[0][[0, -1]] or y in around[1][[0, -1]]
    ]
    points = np.array(grid + ring)
    inside = np.all(
        (points > apparatus.visited_box[0] - CLOSEST)
        & (points < apparatus.visited_box[1] + CLOSEST),
        axis=1,
    )
    on_board = np.all(
        (points > apparatus.board[0] - [0, 0, 0.01])
        & (points < apparatus.board[1] + [0, 0, 0.04]),
        axis=1,
    )
    return np.asarray(points[~inside & ~on_board])


class StaticMetal(Effect[Term]):
    """Theta is the centre (m), then real and imaginary parts of a simple body's modes.

    The rest of the body's response belongs to its remainder (`anser_ros.effects.metal_remainder`).
    """

    name = 'static_metal'
    summary = 'a metal object stands near the volume'
    units = {
        'position_m': 'm',
        'polarizability': 'm^3 (3x3, [re, im])',
    }
    plausible = {'position_m': (-1.0, 1.0)}
    remedy = Remedy.FIELD
    family = Family.METAL_AT_REST
    inexact = np.inf

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return a candidate at every place of a grid."""
        modes = 2 * ball_modes().shape[1]
        return [
            Term(
                self,
                {'place': tuple(float(v) for v in place)},
                np.concatenate([place, np.zeros(modes)]),
            )
            for place in places(apparatus)
        ]

    def amounts(self, term: Term) -> NDArray[np.int64]:
        """Return the indices of the modes' amplitudes."""
        return np.arange(3, term.theta.size)

    def prior(self, term: Term) -> Array:
        """Expect places within decimetres, a few litres of metal at most; held metal stays."""
        place = FROZEN if term.held else 0.1
        return np.concatenate([np.full(3, place), np.full(term.theta.size - 3, 10.0)])

    def _couplings(self, term: Term) -> ComplexArray:
        parts = term.theta[3:].reshape(2, -1)
        return np.asarray(ball_modes() @ (parts[0] + 1j * parts[1]))

    def _seen(self, centre: Array, view: View) -> tuple[Array, ComplexArray]:
        """Amplitudes of the sensors (F, S, M) and of the emitters (K, M) about a centre."""
        shapes = multipoles()
        ears = shapes.received(centre, view.centres, view.axes, view.sensors.length)
        return ears, shapes.driven(view.illumination.field(centre + shapes.offsets))

    def _flux(self, term: Term, centre: Array, view: View) -> ComplexArray:
        return multipoles().flux(*self._seen(centre, view), self._couplings(term), view.omega)

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return derivatives by place (differences) and by polarisability (exact)."""
        centre, alpha = term.theta[:3], term.theta[3:]
        out = view.columns(term.theta.size)
        if np.any(alpha) and not term.held:
            for i, step in enumerate(STEP * np.eye(3)):
                more, less = (self._flux(term, centre + s, view) for s in (step, -step))
                out[..., i] = (more - less) / (2 * STEP)
        unit = multipoles().mode_flux(*self._seen(centre, view), ball_modes(), view.omega)
        groups = unit.shape[-1]
        out[..., 3 : 3 + groups], out[..., 3 + groups :] = unit, 1j * unit
        return out

    def probe(self, term: Term, view: View) -> ComplexArray | None:
        """Return both columns, real and imaginary, of an isotropic scatterer."""
        points = term.theta[:3]
        field = view.illumination.field(points[None])[0] * (UNIT / MU_0)
        unit = view.along(Dipoles.vectors(points[None], field[None]).flux(*view.flat))
        return np.stack([unit, 1j * unit], axis=-1)

    def started(self, term: Term, solution: Array) -> Sequence[Term]:
        """Start with the isotropic scatterer that the probe found at its place."""
        alpha = np.zeros((2, ball_modes().shape[1]))
        alpha[:, 0] = solution
        return (term.with_theta(np.concatenate([term.theta[:3], alpha.ravel()])),)

    def covers(self, term: Term, candidate: Term) -> bool:
        """Count nearby candidates as covered: they are the same body."""
        if candidate.effect is not self:
            return False
        return bool(np.linalg.norm(candidate.theta[:3] - term.theta[:3]) < SAME_BODY_M)

    def resting(self, term: Term) -> Resting:
        """Return a compact body at its place; small pieces of an extended one if much is left."""
        lattices = [(BODIES[kind](), body_sizes(kind)) for kind in SPACINGS]
        return Resting(term.theta[:3], [(multipoles(), body_sizes(COMPACT))], lattices)

    def sources(
        self, term: Term, base: Dipoles, illumination: Dipoles, omega: Array
    ) -> Dipoles | None:
        """Return the dipoles that the emitters induce in the metal, or None without any."""
        if not np.any(term.theta[3:]):
            return None
        return multipoles().sources(term.theta[:3], self._couplings(term), illumination, omega)

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Record the place, m, and the whole polarisability of the metal."""
        total = multipoles().polarisability(self._couplings(term))
        return EffectRecord(
            self.name,
            {
                'position_m': term.theta[:3].tolist(),
                'polarizability': np.stack([total.real, total.imag], axis=-1).tolist(),
                'groups': (UNIT * term.theta[3:]).tolist(),
            },
            {'position_m': np.hypot(sigmas(covariance)[:3], centre_sigma(total)).tolist()},
        )

    def term(self, record: EffectRecord) -> Term:
        """Read the place, m, and the polarisability by groups of modes from a record."""
        place = np.asarray(needed(record, 'position_m'), dtype=np.float64)
        alpha = np.asarray(needed(record, 'groups'), dtype=np.float64) / UNIT
        return Term(self, {'place': tuple(place.tolist())}, np.concatenate([place, alpha]))


STATIC_METAL = StaticMetal()
EFFECTS = (STATIC_METAL,)
