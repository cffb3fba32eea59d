"""Models metal that rested near while a field was learnt, and moves: what its moving changes.

The fitted field contains the metal at rest, and so do the references' steady readings. The
residual is the field of the metal at its present place, less that of the same metal at its place
of rest, so the motion determines its field at rest.
"""

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.metal_path import MetalPath
from anser_ros.effects.moving_metal import MovingMetal, MovingTerm
from anser_ros.effects.view import View

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, kw_only=True)
class DepartedTerm(MovingTerm):
    """Holds moving metal relative to where it is at ``rest_s``, s since the session's start."""

    rest_s: float

    @property
    def alone(self) -> MovingTerm:
        """Return the moving metal itself, not relative to where it rests."""
        return MovingTerm(**{f.name: getattr(self, f.name) for f in fields(MovingTerm)})

    def resting(self, view: View) -> View:
        """Return the view as if all of it were recorded while the metal rests."""
        return replace(view, time=np.full(view.time.shape, self.rest_s))

    def flux(self, view: View, shift: Array) -> ComplexArray:
        """Return the flux (F, S, K) of the whole body, moved by a shift (m), less that at rest."""
        return self.alone.flux(view, shift) - self.alone.flux(self.resting(view), shift)

    def unit(self, view: View) -> NDArray[np.inexact]:
        """Return the flux of each mode of unit amplitude, (F, S, K, m)."""
        return np.asarray(self.alone.unit(view) - self.alone.unit(self.resting(view)))

    def rest_flux(self, view: View) -> ComplexArray:
        """Return what the metal at rest adds to a view, (F, S, K), T."""
        return self.alone.flux(self.resting(view), np.zeros(3))

    def rest_columns(self, view: View) -> ComplexArray:
        """Return the derivative by the parameters of the flux of metal at rest, (F, S, K, q)."""
        columns = MovingMetal().columns(self.alone.free(), self.resting(view))
        return np.zeros((*view.flux.shape, 0), complex) if columns is None else columns


@dataclass(frozen=True)
class DepartedMetal(MovingMetal):
    """Takes metal on a free path from its rest and back; a model has none of it to correct."""

    rest_s: float  # When it rests, s since the session's start

    def starting(
        self, path: MetalPath, course: Array, duration: float, alpha: Array
    ) -> DepartedTerm:
        """Return a simple body on a path; arguments as of `MovingMetal.starting`."""
        plain = super().starting(path, course, duration, alpha)
        parts = {f.name: getattr(plain, f.name) for f in fields(MovingTerm)}
        return DepartedTerm(**parts, rest_s=self.rest_s)

    def columns(self, term: MovingTerm, view: View) -> ComplexArray | None:
        """Return the derivatives where the metal is, less those where it rests."""
        assert isinstance(term, DepartedTerm)
        there = super().columns(term.alone, view)
        rest = super().columns(term.alone, term.resting(view))
        return None if there is None or rest is None else there - rest
