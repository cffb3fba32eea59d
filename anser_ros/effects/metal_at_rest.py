"""A metal object or a metal sheet rests near the volume.

What its few parameters leave (finer couplings, errors of the illumination) is no effect of its
own: the remainder belongs to the metal that it refines.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from anser_ros.arrays import Array, Booleans, ComplexArray, Integers, complex_of, pairs_of
from anser_ros.effects.base import Apparatus, View
from anser_ros.effects.effect import FROZEN, Effect, Family, Remedy, Resting, Term, sigmas
from anser_ros.field.model import Dipoles, EffectRecord
from anser_ros.metal import body
from anser_ros.metal.scattering import UNIT, Shapes, both_phases
from anser_ros.physics.constants import MU_0

STEP = 1e-3
"""Step (m) of the central differences that give the derivative by the place."""
CLOSEST = 0.02
"""Distance (m) from where sensors were within which no metal is looked for."""
SAME_BODY_M = 0.12
"""Distance (m) from active metal within which further metal is taken for the same body: about
the step of the grid of places."""


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
    inside = _within(points, apparatus.visited_box + [[-CLOSEST], [CLOSEST]])
    on_board = _within(points, apparatus.board + [[0, 0, -0.01], [0, 0, 0.04]])
    return np.asarray(points[~inside & ~on_board])


def _within(points: Array, box: Array) -> Booleans:
    return np.asarray(np.all((points > box[0]) & (points < box[1]), axis=1))


class MetalAtRest(Effect[Term]):
    """Is metal of a shape that is never known, which the field model can take in."""

    remedy = Remedy.FIELD
    family = Family.METAL_AT_REST
    inexact = np.inf


class StaticMetal(MetalAtRest):
    """Theta is the centre (m), then real and imaginary parts of a simple body's modes.

    The rest of the body's response belongs to its remainder (`anser_ros.effects.metal_at_rest`).
    """

    name = 'static_metal'
    summary = 'a metal object stands near the volume'
    units = {'position_m': 'm', 'polarizability': 'm^3 (3x3, [re, im])'}
    plausible = {'position_m': (-1.0, 1.0)}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        none = np.zeros(2 * body.ball_modes().shape[1])
        return [
            Term(self, {'place': tuple(place.tolist())}, np.concatenate([place, none]))
            for place in places(apparatus)
        ]

    def amounts(self, term: Term) -> Integers:
        return np.arange(3, term.theta.size)

    def prior(self, term: Term) -> Array:
        """Expect places within decimetres, a few litres of metal at most; held metal stays."""
        place = FROZEN if term.held else 0.1
        return np.concatenate([np.full(3, place), np.full(term.theta.size - 3, 10.0)])

    def _couplings(self, term: Term) -> ComplexArray:
        return np.asarray(body.ball_modes() @ complex_of(term.theta[3:]))

    def _seen(self, centre: Array, view: View) -> tuple[Array, ComplexArray]:
        """Amplitudes of the sensors (F, S, M) and of the emitters (K, M) about a centre."""
        shapes = body.multipoles()
        ears = shapes.received(centre, view.centres, view.axes, view.sensors.length)
        return ears, shapes.driven(view.illumination.field(centre + shapes.offsets))

    def _flux(self, term: Term, centre: Array, view: View) -> ComplexArray:
        return body.multipoles().flux(*self._seen(centre, view), self._couplings(term), view.omega)

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return derivatives by place (differences) and by polarisability (exact)."""
        centre, alpha = term.theta[:3], term.theta[3:]
        out = view.columns(term.theta.size)
        if np.any(alpha) and not term.held:
            for i, step in enumerate(STEP * np.eye(3)):
                more, less = (self._flux(term, centre + s, view) for s in (step, -step))
                out[..., i] = (more - less) / (2 * STEP)
        unit = body.multipoles().mode_flux(
            *self._seen(centre, view), body.ball_modes(), view.omega
        )
        out[..., 3:] = both_phases(unit)
        return out

    def probe(self, term: Term, view: View) -> ComplexArray | None:
        """Return both columns, real and imaginary, of an isotropic scatterer."""
        points = term.theta[:3]
        field = view.illumination.field(points[None])[0] * (UNIT / MU_0)
        unit = view.along(Dipoles.vectors(points[None], field[None]).flux(*view.flat))
        return both_phases(unit[..., None])

    def started(self, term: Term, solution: Array) -> Sequence[Term]:
        """Start with the isotropic scatterer that the probe found at its place."""
        alpha = np.zeros((2, body.ball_modes().shape[1]))
        alpha[:, 0] = solution
        return (term.with_theta(np.concatenate([term.theta[:3], alpha.ravel()])),)

    def covers(self, term: Term, candidate: Term) -> bool:
        """Count nearby candidates as covered: they are the same body."""
        if candidate.effect is not self:
            return False
        return bool(np.linalg.norm(candidate.theta[:3] - term.theta[:3]) < SAME_BODY_M)

    def resting(self, term: Term) -> Resting:
        """Return a compact body at its place; small pieces of an extended one if much is left."""
        lattices = [(body.BODIES[kind](), body.body_sizes(kind)) for kind in body.SPACINGS]
        return Resting(
            term.theta[:3], [(body.multipoles(), body.body_sizes(body.COMPACT))], lattices
        )

    def sources(self, term: Term, base: Dipoles, light: Dipoles, omega: Array) -> Dipoles | None:
        if not np.any(term.theta[3:]):
            return None
        return body.multipoles().sources(term.theta[:3], self._couplings(term), light, omega)

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        total = body.multipoles().polarisability(self._couplings(term))
        return EffectRecord(
            self.name,
            {
                'position_m': term.theta[:3].tolist(),
                'polarizability': pairs_of(total),
                'groups': (UNIT * term.theta[3:]).tolist(),
            },
            {'position_m': np.hypot(sigmas(covariance)[:3], body.centre_sigma(total)).tolist()},
        )

    def term(self, record: EffectRecord) -> Term:
        place = np.asarray(record.needed('position_m'), dtype=np.float64)
        alpha = np.asarray(record.needed('groups'), dtype=np.float64) / UNIT
        return Term(self, {'place': tuple(place.tolist())}, np.concatenate([place, alpha]))


MESH = 12
"""Loops along an edge of the sheet's mesh, each less wide than the distance to the sensors."""
DIFFERENCE_STEPS = np.array([1e-3, 1e-3, 1e-3, 1e-3, 0.05])
"""Steps of the central differences, in theta's units."""
TYPICAL_OHM = 3e-5
"""Surface resistance, ohm, that a plate's fit starts from: of a millimetre of aluminium."""

HEIGHT, RIM, OHM = 0.005, 0.03, 0.1
"""How well a sheet is known at best, whose true outline, thickness and bend are unknown: its
height and each rim as shares of its edge, and its resistance."""


class ConductivePlate(MetalAtRest):
    """Theta is height z, edge, centre x and y (m), and the log of the sheet resistance (ohm)."""

    name = 'conductive_plate'
    summary = 'a metal sheet lies parallel to the board'
    units = {'z_m': 'm', 'edge_m': 'm', 'centre_m': 'm', 'sheet_ohm': 'ohm'}
    plausible = {'z_m': (-1.0, 1.0), 'edge_m': (0.02, 2.0), 'sheet_ohm': (1e-7, 1.0)}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        size = float(np.max(apparatus.board[1, :2] - apparatus.board[0, :2]))
        middle = apparatus.board.mean(axis=0)
        below = apparatus.board[0, 2] - size * np.array([0.08, 0.16, 0.26, 0.4, 0.6])
        above = apparatus.visited_box[1, 2] + size * np.array([0.25, 0.5])
        return [
            Term(
                self, {'z': float(z), 'edge': float(edge)},
                np.array([z, edge, middle[0], middle[1], np.log(TYPICAL_OHM)]),
            )
            for z in (*below, *above)
            for edge in (0.6 * size, size, 1.8 * size)
        ]  # fmt: skip

    def amounts(self, term: Term) -> Integers:
        """Return the edge's index: a sheet without size has no effect."""
        return np.array([1])

    def prior(self, term: Term) -> Array:
        """Expect places near the board, resistances over decades; a held sheet stays."""
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
        return Resting(term.theta[[2, 3, 0]], [(body.sheet_shapes(edge), body.sheet_sizes(edge))])

    def sources(self, term: Term, base: Dipoles, light: Dipoles, omega: Array) -> Dipoles | None:
        z, edge, x, y, log_ohm = term.theta
        centre, edges = np.array([x, y, z]), np.array([edge, edge])
        return body.sheet_sources(centre, edges, float(np.exp(log_ohm)), MESH, light, omega)

    def _flux(self, theta: Array, view: View) -> ComplexArray:
        added = self.sources(Term(self, {}, theta), view.dipoles, view.illumination, view.omega)
        assert added is not None
        return view.along(added.flux(*view.flat))

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        if term.held:
            return view.columns(5)
        steps, theta = np.diag(DIFFERENCE_STEPS), term.theta
        differences = [self._flux(theta + s, view) - self._flux(theta - s, view) for s in steps]
        return np.asarray(np.stack(differences, axis=-1) / (2 * DIFFERENCE_STEPS))

    def probe(self, term: Term, view: View) -> ComplexArray | None:
        """Return the columns of a sheet of this height and size, of any strength and phase."""
        return both_phases(self._flux(term.theta, view)[..., None])

    def started(self, term: Term, solution: Array) -> Sequence[Term]:
        return (term,)

    def record(self, term: Term, covariance: Array) -> EffectRecord:
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
        x, y = (float(v) for v in record.needed('centre_m'))
        z, edge, ohm = (float(record.needed(key)) for key in ('z_m', 'edge_m', 'sheet_ohm'))
        return Term(self, {}, np.array([z, edge, x, y, np.log(ohm)]))


STATIC_METAL = StaticMetal()
EFFECTS = STATIC_METAL, ConductivePlate()


GAIN, ASIDE_M, UP_M = 3e-3, 0.2e-3, 0.4e-3
"""How well an emitter's field is known where metal is and nothing was measured: as if the emitter
were so much stronger, or so far away. The far side of the board says least about its height."""
LIGHT_STEP_M = 0.5e-3
"""Shift (m) of an emitter in the differences that tell what its place does to metal."""


@dataclass(frozen=True, eq=False)
class Couplings:
    """Combines couplings into fixed modes, each with a complex amplitude."""

    shapes: Shapes
    centre: Array  # (3,), m
    modes: Array  # (shapes.size, m), of the size that each is expected to have

    @property
    def count(self) -> int:
        """Return the number of parameters: real, then imaginary parts."""
        return 2 * int(self.modes.shape[1])

    def unit(self, view: View) -> NDArray[np.inexact]:
        """Return the flux of each mode, (F, S, K, m)."""
        shapes = self.shapes
        ears = shapes.received(self.centre, view.centres, view.axes, view.sensors.length)
        drive = shapes.driven(view.illumination.field(self.centre + shapes.offsets))
        return shapes.mode_flux(ears, drive, self.modes, view.omega)

    def columns(self, view: View) -> ComplexArray:
        """Return the flux that a unit of each parameter adds."""
        return both_phases(self.unit(view))

    def sources(self, theta: Array, illumination: Dipoles, omega: Array) -> Dipoles:
        """Return the dipoles that all modes make together."""
        couplings = self.modes @ complex_of(theta)
        return self.shapes.sources(self.centre, couplings, illumination, omega)


@dataclass(frozen=True, eq=False)
class IlluminationChange:
    """Changes each emitter's strength and place (x, y, z) as they act on metal."""

    metal: Sequence[Term]  # At rest; what answers to the emitters
    emitters: int

    @property
    def count(self) -> int:
        """Return four parameters, a strength and a place, for every emitter."""
        return 4 * self.emitters

    def _answers(self, illumination: Dipoles, omega: Array) -> list[Dipoles]:
        """What the metal adds when all emitters are a standard deviation off in one way."""
        places, out = illumination.positions, []
        for way, size in zip(np.eye(4), (GAIN, ASIDE_M, ASIDE_M, UP_M), strict=True):
            if way[0]:
                light = replace(illumination, moments=GAIN * illumination.moments)
            else:
                moments = illumination.moments * (size / LIGHT_STEP_M)
                light = replace(
                    illumination, positions=places + LIGHT_STEP_M * way[1:], moments=moments
                ).joined(replace(illumination, moments=-moments))
            answer = Dipoles.none(self.emitters)
            for term in self.metal:
                added = term.effect.sources(term, light, light, omega)
                answer = answer if added is None else answer.joined(added)
            out.append(answer)
        return out

    def columns(self, view: View) -> ComplexArray:
        """Return the flux that a unit of each parameter adds."""
        out = view.columns(self.count)
        every = np.arange(self.emitters)
        for way, answer in enumerate(self._answers(view.illumination, view.omega)):
            flux = view.along(answer.flux(*view.flat))
            out[:, :, every, way * self.emitters + every] = flux
        return out

    def sources(self, theta: Array, illumination: Dipoles, omega: Array) -> Dipoles:
        """Return the dipoles of all errors of the light together."""
        shares = theta.reshape(4, self.emitters)
        out = Dipoles.none(self.emitters)
        for share, answer in zip(shares, self._answers(illumination, omega), strict=True):
            out = out.joined(replace(answer, moments=answer.moments * share))
        return out


RemainderPart = Couplings | IlluminationChange
"""A linear part of a metal's response, with ``count`` parameters of unit prior size."""


@dataclass(frozen=True, kw_only=True)
class RemainderTerm(Term):
    """Holds a leftover of one metal; theta is the leftover's parameters."""

    parent: tuple[str, str]  # `Term.name_and_site` of the metal
    leftover: RemainderPart


class MetalRemainder(Effect[RemainderTerm]):
    """Describes the residual of metal at rest by `Couplings` or an `IlluminationChange`."""

    name = 'metal_remainder'
    summary = 'the residual that a simple metal body leaves'
    remedy = Remedy.FIELD
    family = Family.REMAINDER

    def of(self, parent: Term, leftover: RemainderPart) -> RemainderTerm:
        """Return a leftover of a metal that is at rest, with parameters of zero."""
        return RemainderTerm(
            self, {'of': parent.effect.name}, np.zeros(leftover.count),
            parent=parent.name_and_site, leftover=leftover,
        )  # fmt: skip

    def belongs(self, term: RemainderTerm, other: Term) -> bool:
        return term.parent == other.name_and_site

    def columns(self, term: RemainderTerm, view: View) -> ComplexArray | None:
        return term.leftover.columns(view)

    def sources(
        self, term: RemainderTerm, base: Dipoles, light: Dipoles, omega: Array
    ) -> Dipoles | None:
        if not np.any(term.theta):
            return None
        return term.leftover.sources(term.theta, light, omega)

    def record(self, term: RemainderTerm, covariance: Array) -> EffectRecord:
        """Record the size only; the parent's record names the metal."""
        rms = float(np.sqrt(np.mean(term.theta**2)))
        return EffectRecord(self.name, {'of': term.site['of'], 'rms': rms})


REMAINDER = MetalRemainder()
