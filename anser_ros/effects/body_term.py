"""Defines the terms that the search refines: metal whose body is a sum of modes, and what
fluctuates.

A simple body has few modes; a real one has more, which are chosen from the data (`with_body`).
Metal whose response changes with time also has a course, which may be refined as well (`freer`).
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.term import Term
from anser_ros.effects.view import View
from anser_ros.metal.body import BODIES, COMPACT, ball_modes
from anser_ros.metal.scattering import Shapes

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LARGEST = 10.0
"""Prior standard deviation of the amplitudes of a simple body's modes, in units of 1e-4 m^3
(`anser_ros.metal.scattering.UNIT`). A perfectly conducting ball of 25 mm radius has -1, one of
54 mm -10: the prior holds nothing back that fits beside a tracked volume, and only keeps modes
that the data do not determine from growing without bound."""


@dataclass(frozen=True)
class Richness:
    """States how finely metal is shaped."""

    modes: int  # Most modes of a body
    knots: tuple[int, ...]  # Numbers of knots that a free course may have, tried in this order
    left: float  # Misfit over the noise's from which a freer course is tried


@dataclass(frozen=True, kw_only=True)
class BodyTerm(Term):
    """Holds metal of modes: theta is its course, then real and imaginary parts of their
    amplitudes.
    """

    kind: str  # Of body (`anser_ros.metal.body.BODIES`)
    modes: Array  # (c, m), each a combination of the c couplings of the body's shapes
    # (m,), prior standard deviation of each mode's amplitude, in phase and in quadrature
    spread: Array
    # How finely the body was shaped; None for a simple body as it starts
    richness: Richness | None = None

    @property
    def shapes(self) -> Shapes:
        """Return the shapes of the field that the body couples."""
        return BODIES[self.kind]()

    @property
    def placed(self) -> int:
        """Return how many parameters the course has, which come before the amplitudes."""
        return int(self.theta.size) - 2 * int(self.modes.shape[1])

    @property
    def knots(self) -> int:
        """Return knots of a free course; 0 where the course has few parameters of its own kind."""
        return 0

    @property
    def course(self) -> Array:
        """Return the parameters that say where the body is."""
        return self.theta[: self.placed]

    @property
    def couplings(self) -> ComplexArray:
        """Return the complex couplings of the whole body, shape (c,)."""
        parts = self.theta[self.placed :].reshape(2, -1)
        return np.asarray(self.modes @ (parts[0] + 1j * parts[1]))

    def unit(self, view: View) -> NDArray[np.inexact]:
        """Return the flux of each mode of unit amplitude in a view, (F, S, K, m), T."""
        raise NotImplementedError

    def with_body(self, kind: str, modes: Array, spread: Array) -> Self:
        """Return the same course with another body, whose amplitudes are still zero."""
        theta = np.concatenate([self.course, np.zeros(2 * modes.shape[1])])
        return replace(self, kind=kind, modes=modes, spread=spread, theta=theta)

    def shaped(self, kind: str, modes: Array, richness: Richness) -> Self:
        """Return the same course, a body of modes of unit prior size; a compact one has a ball's
        too.
        """
        spread = np.ones(modes.shape[1])
        if kind == COMPACT:
            ball = ball_modes()
            modes = np.concatenate([ball, modes], axis=1)
            spread = np.concatenate([np.full(ball.shape[1], LARGEST), spread])
        return replace(self.with_body(kind, modes, spread), richness=richness)

    def freer(self, knots: int) -> Self | None:
        """Return the same body on a freer course near this one; None where no freer one exists."""
        return None

    def restarted(self) -> Self | None:
        """Return the body as it is, where its course started from; None where that isn't known."""
        return None


@dataclass(frozen=True, kw_only=True)
class FluctuationTerm(Term):
    """Holds something constant that fluctuates; theta is empty."""

    # The constant effect at the same site; None for a term from a record
    constant: Term | None = None
    # Standard deviation of each of its parameters from frame to frame; None before it is found
    spread: Array | None = None
    frames: int = 1  # Frames that the spread was found on

    def columns(self, view: View) -> ComplexArray | None:
        """Return columns (F, S, K, q) of unit size along which a frame may move."""
        return None if self.constant is None else self.constant.effect.columns(self.constant, view)

    @property
    def expected(self) -> Array:
        """Return each parameter's standard deviation by the constant effect, shape (q,)."""
        return np.zeros(0) if self.constant is None else self.constant.effect.prior(self.constant)
