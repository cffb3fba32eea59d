"""An emitter's strength changes with time in no simple way: steps, swings, a loose contact."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np

from anser_ros.effects.effect import (
    Array,
    ComplexArray,
    Effect,
    Remedy,
    Scene,
    Term,
    View,
    needed,
    sigmas,
    unit_matrix,
)
from anser_ros.effects.hats import hats, knots_of
from anser_ros.fitting.model import EffectRecord


class CoilFluctuation(Effect):
    """theta: relative change of the emitter's strength at the knots, straight lines between."""

    name = 'coil_fluctuation'
    summary = "an emitter's strength changes with time, not as a warming coil's does"
    units: ClassVar[Mapping[str, str]] = {'coil': '1', 'time_s': 's', 'change': '1'}
    plausible: ClassVar[Mapping[str, tuple[float, float]]] = {'change': (-0.5, 0.5)}
    remedy = Remedy.FLUX

    def candidates(self, scene: Scene) -> Sequence[Term]:
        """Every emitter."""
        knots = knots_of(scene.duration)
        return [
            Term(self, {'coil': k, '_knots': knots}, np.zeros(knots.size))
            for k in range(scene.emitters)
        ]

    def prior(self, term: Term) -> Array:
        """Some percent."""
        return np.full(term.theta.size, 0.1)

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """The emitter's flux times the hat functions."""
        coil, shape = term.site['coil'], hats(term.site['_knots'], view.time)
        own = view.linear[:, :, coil] / (1 + shape @ term.theta)[:, None]
        out = view.columns(term.theta.size)
        out[:, :, coil] = own[..., None] * shape[:, None, :]
        return out

    def emitter_matrix(self, term: Term, time: Array, omega: Array) -> ComplexArray:
        """Diagonal, by time."""
        matrix = np.repeat(unit_matrix(omega.size)[None], time.size, axis=0)
        coil = term.site['coil']
        matrix[:, coil, coil] = 1 + hats(term.site['_knots'], time) @ term.theta
        return matrix

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """The curve."""
        return EffectRecord(
            self.name,
            {
                'coil': term.site['coil'],
                'time_s': np.asarray(term.site['_knots']).tolist(),
                'change': term.theta.tolist(),
            },
            {'change': sigmas(covariance).tolist()},
        )

    def term(self, record: EffectRecord) -> Term:
        """From the curve."""
        knots = np.asarray(needed(record, 'time_s'), dtype=np.float64)
        change = np.asarray(needed(record, 'change'), dtype=np.float64)
        return Term(self, {'coil': int(needed(record, 'coil')), '_knots': knots}, change)


EFFECTS = (CoilFluctuation(),)
