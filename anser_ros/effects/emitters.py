"""An emitter is elsewhere, or larger or flatter, than the model has it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from anser_ros.effects.effect import Array, ComplexArray, Effect, Remedy, Term, needed
from anser_ros.effects.view import Apparatus, View
from anser_ros.field.dipoles import Dipoles, size_parameters, spread_along, symmetry_axis
from anser_ros.field.model import EffectRecord

GRADIENT_ERROR = 0.07
"""Relative error of what an emitter's shift changes at a reference close to it. Smaller lets
references outvote the tools with gradients that the model only guesses."""


class CoilMoved(Effect[Term]):
    """Theta is the shift of one emitter, m, frame fg."""

    name = 'coil_moved'
    summary = 'an emitter is not where the model has it'
    units = {'coil': '1', 'shift_m': 'm'}
    plausible = {'shift_m': (-0.03, 0.03)}
    remedy = Remedy.FIELD
    typical = 3e-3  # emitters shift by some millimetres
    gradient_error = GRADIENT_ERROR
    recorded = {'shift_m': (3, 1.0)}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return a candidate for every emitter."""
        return [Term(self, {'coil': k}, np.zeros(3)) for k in range(apparatus.emitters)]

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Move the sensor the other way, which does the same as moving the source."""
        coil = term.site['coil']
        out = view.columns(3)
        out[:, :, coil] = -np.moveaxis(view.d_position[..., coil], 2, -1)
        return out

    def sources(
        self, term: Term, base: Dipoles, illumination: Dipoles, omega: Array
    ) -> Dipoles | None:
        """Return the emitter at its new place, less the one at the old."""
        return self._shifted(term, base)

    def light(self, term: Term, illumination: Dipoles) -> Dipoles:
        """Shift the emitter in the field that metal sees, too."""
        return illumination.joined(self._shifted(term, illumination))

    @staticmethod
    def _shifted(term: Term, base: Dipoles) -> Dipoles:
        only = np.zeros_like(base.moments)
        only[:, term.site['coil']] = base.moments[:, term.site['coil']]
        used = np.flatnonzero(np.abs(only).any(axis=1))
        place, direction, moment = base.positions[used], base.directions[used], only[used]
        return Dipoles(place + term.theta, direction, moment).joined(
            Dipoles(place, direction, -moment)
        )


UNIT = 1e-4
"""theta counts second moments in units of (10 mm)^2."""


@dataclass(frozen=True, kw_only=True)
class EmitterSizeTerm(Term):
    """Holds an emitter that is the same all around an axis."""

    axis: Array  # (3,), unit vector, frame fg
    modelled_m2: float  # Second moment of the model's own dipoles of this emitter, m^2

    @property
    def second_moment_m2(self) -> float:
        """Return the second moment of the whole emitter, m^2."""
        return self.modelled_m2 + UNIT * float(self.theta[0])


class EmitterSize(Effect[EmitterSizeTerm]):
    """Theta is what the second moment of an emitter has beside its model's, in (10 mm)^2.

    An emitter that is the same all around an axis has, after its dipole, the field of an octupole
    about its centre: that of dipoles spread along the axis, whose mean square distance from the
    centre, weighted by their moments, is its second moment s^2. The field is linear in it: s^2 / 2
    times the second derivative of the emitter's own field along the axis. A uniformly magnetised
    cylinder of length L and radius a has L^2 / 12 - a^2 / 4, a flat coil less than nothing.

    Metal sees the emitter as the model has it: what its size changes there is a small part of what
    metal changes at the sensors.
    """

    name = 'emitter_size'
    summary = 'an emitter is longer or flatter than its model'
    units = {
        'coil': '1', 'second_moment_m2': 'm^2', 'length_m': 'm', 'diameter_m': 'm',
    }  # fmt: skip
    plausible = {'length_m': (0.0, 1.0), 'diameter_m': (0.0, 1.0)}
    remedy = Remedy.FIELD
    typical = 100.0  # of magnets and coils of some decimetres

    def candidates(self, apparatus: Apparatus) -> Sequence[EmitterSizeTerm]:
        """Return a candidate for each emitter whose dipoles lie on one axis and point along it.

        Those of a drawn emitter do not, so that one whose size is known is no candidate.
        """
        light, found = apparatus.illumination, []
        for k in range(apparatus.emitters):
            axis = symmetry_axis(light.positions, light.directions, light.moments[:, k : k + 1])
            if axis is not None:
                found.append(
                    EmitterSizeTerm(
                        self, {'coil': k}, np.zeros(1), axis=axis.direction,
                        modelled_m2=axis.second_moment_m2,
                    )
                )  # fmt: skip
        return found

    def columns(self, term: EmitterSizeTerm, view: View) -> ComplexArray:
        """Return the flux that a unit of second moment adds."""
        unit = spread_along(view.illumination, term.site['coil'], term.axis, UNIT)
        return view.along(unit.flux(*view.flat))[..., None]

    def sources(
        self, term: EmitterSizeTerm, base: Dipoles, illumination: Dipoles, omega: Array
    ) -> Dipoles | None:
        """Return dipoles on the axis that have the second moment and no moment together."""
        return spread_along(base, term.site['coil'], term.axis, UNIT * float(term.theta[0]))

    def record(self, term: EmitterSizeTerm, covariance: Array) -> EffectRecord:
        """Record the second moment, m^2, and a thin magnet or a flat disc that has it."""
        sigma_m2 = UNIT * float(np.sqrt(covariance[0, 0]))
        figures, sigmas = size_parameters(term.second_moment_m2, sigma_m2)
        return EffectRecord(
            self.name,
            {
                'coil': term.site['coil'],
                **figures,
                'model_second_moment_m2': term.modelled_m2,
                'axis': term.axis.tolist(),
            },
            sigmas,
        )

    def term(self, record: EffectRecord) -> EmitterSizeTerm:
        """Read an emitter's second moment, and that of its model, from a record."""
        modelled = float(needed(record, 'model_second_moment_m2'))
        theta = (float(needed(record, 'second_moment_m2')) - modelled) / UNIT
        return EmitterSizeTerm(
            self, self.site_of(record), np.array([theta]),
            axis=np.asarray(needed(record, 'axis'), dtype=np.float64), modelled_m2=modelled,
        )  # fmt: skip


EFFECTS = CoilMoved(), EmitterSize()
