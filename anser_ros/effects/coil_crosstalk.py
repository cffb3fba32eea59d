"""One emitter's tone leaks into another's."""

from collections.abc import Sequence
from itertools import combinations, permutations

import numpy as np

from anser_ros.effects.effect import (
    Array,
    ComplexArray,
    Effect,
    Remedy,
    Term,
    needed,
    sigmas,
    unit_matrix,
    whole_numbers,
)
from anser_ros.effects.view import Apparatus, View
from anser_ros.field.model import EffectRecord


class CoilCrosstalk(Effect[Term]):
    """Theta is the real and imaginary share of a one-way leak, or one real share both ways.

    Readings at the second coil's frequency contain a share of the first one's field.
    """

    name = 'coil_crosstalk'
    summary = "one emitter's tone leaks into another's"
    units = {
        'coils': '1',
        'eps': '1',
        'eps_quadrature': '1',
        'mutual': '1',
    }
    plausible = {'eps': (-0.5, 0.5)}
    remedy = Remedy.FLUX

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Try every ordered pair, and every pair both ways."""
        coils = range(apparatus.emitters)
        one_way = [Term(self, {'coils': p}, np.zeros(2)) for p in permutations(coils, 2)]
        both = [
            Term(self, {'coils': p, 'mutual': True}, np.zeros(1)) for p in combinations(coils, 2)
        ]
        return one_way + both

    def prior(self, term: Term) -> Array:
        """Return a prior spread of 0.1: leaks amount to some percent."""
        return np.full(term.theta.size, 0.1)

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return the source emitter's flux, placed in the other emitter's tone."""
        source, target = term.site['coils']
        own = np.einsum(
            'ab,fsb->fsa', np.linalg.inv(self._matrix(term, view.omega.size)), view.linear
        )
        out = view.columns(term.theta.size)
        out[:, :, target, 0] = own[:, :, source]
        if term.site.get('mutual'):
            out[:, :, source, 0] = own[:, :, target]
        else:
            out[:, :, target, 1] = 1j * own[:, :, source]
        return out

    def _matrix(self, term: Term, emitters: int) -> ComplexArray:
        source, target = term.site['coils']
        matrix = unit_matrix(emitters)
        if term.site.get('mutual'):
            matrix[target, source] = matrix[source, target] = term.theta[0]
        else:
            matrix[target, source] = complex(*term.theta)
        return matrix

    def emitter_matrix(self, term: Term, time: Array, omega: Array) -> ComplexArray:
        """Return the unit matrix with one entry more, or two."""
        return self._matrix(term, omega.size)[None]

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Record the source, the target and the share that leaks, with its uncertainty."""
        sigma = sigmas(covariance)
        parameters = {'coils': list(term.site['coils']), 'eps': float(term.theta[0])}
        uncertainty = {'eps': float(sigma[0])}
        if term.site.get('mutual'):
            parameters['mutual'] = True
        else:
            parameters['eps_quadrature'] = float(term.theta[1])
            uncertainty['eps_quadrature'] = float(sigma[1])
        return EffectRecord(self.name, parameters, uncertainty)

    def term(self, record: EffectRecord) -> Term:
        """Read the source, the target and the share that leaks from a record."""
        coils = whole_numbers(record, 'coils')
        eps = float(needed(record, 'eps'))
        if record.parameters.get('mutual'):
            return Term(self, {'coils': coils, 'mutual': True}, np.array([eps]))
        across = float(record.parameters.get('eps_quadrature', 0.0))
        return Term(self, {'coils': coils}, np.array([eps, across]))


EFFECTS = (CoilCrosstalk(),)
