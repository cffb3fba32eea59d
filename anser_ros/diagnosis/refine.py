"""Fits all effects jointly, metal in as much detail as the data determine.

A simple body has few parameters; a real one has more, which a prior keeps small. The width of the
prior is the one that predicts held-out blocks best. Place and couplings are fitted together, so
the uncertainty of a place includes that of the body's shape.
"""

from collections.abc import Sequence

from anser_ros.diagnosis.decisions import COARSE_REMAINDER, SOMETHING_LEFT
from anser_ros.diagnosis.fit import Fit, Fitter
from anser_ros.diagnosis.remainder import Remainders
from anser_ros.diagnosis.shaping import Shaping
from anser_ros.effects.body_term import Richness
from anser_ros.effects.effect import Family
from anser_ros.effects.term import Term

COARSE = Richness(50, (17,), COARSE_REMAINDER)
"""How finely metal is shaped during the search: by what shapes usually leave, about half of the
modes that the data determine, and a knot in 2.5 s of a session of 40 s."""
FINE = Richness(90, (17, 25), SOMETHING_LEFT)
"""How finely metal is shaped in the last fit, which is made once."""


def settled(fitter: Fitter, terms: Sequence[Term], richness: Richness = COARSE) -> Fit:
    """Return the joint fit of some effects, metal shaped and then held where it is.

    ``terms``: start values; remainders of metal among them are made again; ``richness``: how
    finely metal is shaped.
    """
    plain = [term.free() for term in terms if term.effect.family is not Family.REMAINDER]
    bodies = [term.effect.body(term) for term in plain]
    # What moves and has its shape already is reshaped below.
    known = any(body is not None and body.richness is not None for body in bodies)
    fit = fitter.fit(plain, 1 if known else None)
    shaping, remainders = Shaping(fitter, richness), Remainders(fitter, richness)
    for index in range(len(fit.terms)):
        fit = shaping.shaped(fit, index)
    for index in range(len(fit.terms)):
        fit = remainders.added(fit, index)
    return _held(fit, fitter)


def _held(fit: Fit, fitter: Fitter) -> Fit:
    """The same fit, metal held where it is: what is tried with it is then cheap to fit."""
    if not any(term.effect.family.is_metal for term in fit.terms):
        return fit
    held = [
        term.hold(fit.covariance_of(index)) if term.effect.family.is_metal else term
        for index, term in enumerate(fit.terms)
    ]
    return fitter.fit(held, 1)
