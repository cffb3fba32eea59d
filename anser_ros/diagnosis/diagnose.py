"""Runs the whole loop: residual, effect, correction, the error before and after on unseen data."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis import decisions
from anser_ros.diagnosis.choice import refit_spreads
from anser_ros.diagnosis.confirm import Confirmation, doubtful
from anser_ros.diagnosis.findings import (
    Finding,
    corrected_model,
    fitted_finding,
    noise_findings,
    outlier_findings,
)
from anser_ros.diagnosis.fit import FINE, Fit, Fitter, settled
from anser_ros.diagnosis.prepare import test_blocks, train_blocks
from anser_ros.diagnosis.problem import Problem, State, evaluate, expected_rms, rms
from anser_ros.diagnosis.screening import (
    clean_start,
    outlying_share,
    wiring_faults,
    without_outliers,
)
from anser_ros.diagnosis.search import Progress, Search, SearchSettings, search_effects
from anser_ros.diagnosis.structure import (
    StructureTest,
    noise_scale,
    noise_t,
    structure_tests,
    whiteness,
)
from anser_ros.effects.effect import Family, Term
from anser_ros.field.model import FieldModel

Array = NDArray[np.float64]

SEARCH_FRAMES, FINAL_FRAMES, WIRING_FRAMES = 270, 400, 150
"""Frames of each tool, about, for the search, the last fit and the look for wiring faults."""


@dataclass(frozen=True)
class Diagnosis:
    """Holds what was found, with its evidence."""

    findings: tuple[Finding, ...]
    # Held-out residuals with the pose jitter taken out, T a phasor component.
    flux_rms_before_t: float
    flux_rms_after_t: float
    flux_rms_floor_t: float
    unexplained: float  # share of the power above the floor that remains
    depends_on: tuple[str, ...]
    tests_before: tuple[StructureTest, ...]
    tests_after: tuple[StructureTest, ...]
    model: FieldModel  # with the effects
    search: Search
    refused: tuple[tuple[Term, Confirmation], ...]  # explained something, but not confirmed
    before: State  # the held-out part
    after: State
    terms: tuple[Term, ...]  # all that was fitted last, also what is no finding


@dataclass(frozen=True)
class Screened:
    """Holds a problem as the search starts with it."""

    known: tuple[Term, ...]  # faults of the wiring, which are plain before any search
    whole: Problem  # all frames, without the channels without a signal
    start: Problem  # the same without values that stand out already now

    def training(self, frames: int) -> Problem:
        """Return about so many frames per tool of the blocks to choose and fit effects on."""
        return self.start.in_blocks(train_blocks()).thinned(frames)


@dataclass(frozen=True)
class Confirmed:
    """Holds the effects that are the same in all parts of the data."""

    fit: Fit  # all of them together
    cleaned: Problem  # all frames, without values that stand out with these effects
    refused: tuple[tuple[Term, Confirmation], ...]  # explained something, but not confirmed


def diagnose(
    problem: Problem,
    model: FieldModel,
    settings: SearchSettings | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Find what a model lacks: screen, search, confirm and conclude.

    ``problem``: of the whole session (`anser_ros.diagnosis.prepare.build_problem`); ``model``:
    what the problem was built with; ``progress``: called with words on what goes on.
    """
    how = settings or SearchSettings()
    screened = screen(problem)
    search = search_screened(screened, how, progress)
    if progress:
        progress('joint fit')
    confirmed = confirm(screened, search, how)
    return conclude(screened, search, confirmed, model)


def screen(problem: Problem) -> Screened:
    """Name the faults of the wiring, and leave out dead channels and values that stand out."""
    known = wiring_faults(problem.thinned(WIRING_FRAMES))
    whole = _without_dead(problem, known)
    return Screened(tuple(known), whole, whole if known else clean_start(whole))


def search_screened(
    screened: Screened, how: SearchSettings, progress: Progress | None = None
) -> Search:
    """Search for effects on a part of the training blocks' frames."""
    training = screened.training(SEARCH_FRAMES)
    return search_effects(training, train_blocks(), screened.known, how, progress)


def confirm(screened: Screened, search: Search, how: SearchSettings) -> Confirmed:
    """Fit what the search found on more frames, and keep what is the same in all parts."""
    blocks, whole = train_blocks(), screened.whole
    last = how.fitter(screened.training(FINAL_FRAMES), blocks)
    fit, refused = _settled(how.fitter(search.fit.state.problem, blocks), last, search)
    cleaned = without_outliers(whole, evaluate(whole, fit.terms))
    if outlying_share(screened.start, cleaned)[0] > decisions.FEWEST_OUTLIERS:
        thinned = cleaned.in_blocks(blocks).thinned(FINAL_FRAMES)
        fit = settled(how.fitter(thinned, blocks), fit.terms, FINE)
    return Confirmed(fit, cleaned, refused)


def _without_dead(problem: Problem, known: Sequence[Term]) -> Problem:
    """The problem without the channels without a signal."""
    dead = [channel for term in known for channel in term.effect.silenced(term)]
    pairs = zip(problem.tools, problem.good, strict=True)
    good = tuple(mask & ~np.isin(tool.sensors.channel, dead) for tool, mask in pairs)
    references = problem.references
    if references is not None:
        readings = references.readings
        valid = readings.valid & ~np.isin(readings.sensors.channel, dead)
        references = replace(references, readings=replace(readings, valid=valid))
    return replace(problem, good=good, references=references)


def _settled(
    fitter: Fitter, last: Fitter, search: Search
) -> tuple[Fit, tuple[tuple[Term, Confirmation], ...]]:
    """The joint fit, by ``last``, of the effects that are the same in all parts of the data."""
    fit, refused = search.fit, []
    while bad := doubtful(fitter.problem, fit, noise_scale(fit.state) ** 2):
        # Metal that is doubtful costs much to fit again and is hardly ever more than a stand-in.
        metal = [pair for pair in bad if pair[1].effect.family.is_metal]
        crowd = [pair for pair in bad if pair[0].alike >= decisions.MANY]
        dropped = metal or crowd or bad[:1]
        refused += [(term, check) for check, term in dropped]
        gone = [term for _, term in dropped]
        rest = [t for t in fit.terms if not any(t is term or t.belongs_to(term) for term in gone)]
        fit = settled(fitter, refit_spreads(fitter.problem, rest))
    return settled(last, refit_spreads(last.problem, fit.terms), FINE), tuple(refused)


def conclude(
    screened: Screened, search: Search, confirmed: Confirmed, model: FieldModel
) -> Diagnosis:
    """Judge on the held-out blocks what the effects explain and what they leave."""
    whole, cleaned, fit = screened.whole, confirmed.cleaned, confirmed.fit
    unseen = cleaned.in_blocks(test_blocks())
    before, after = evaluate(unseen, ()), evaluate(unseen, fit.terms)
    white = whiteness(after)
    expected = expected_rms(after)
    # Residuals that are no noise must not make the floor that they are measured by.
    grown = noise_t(after) > decisions.LEAST_NOISE_GROWTH * cleaned.spread.noise_t
    scale = min(noise_scale(after), 1.0) if grown and not white.holds else noise_scale(after)
    floor = min(scale * expected, rms(after))
    tests = tuple(structure_tests(after))
    excess = max(rms(after) ** 2 - floor**2, 0.0)
    named = [test.variable for test in tests if test.significant]
    significant = excess > (decisions.STRUCTURED if named else decisions.UNSTRUCTURED) * floor**2
    possible = max(rms(before) ** 2 - floor**2, excess)
    findings = [
        fitted_finding(fit, i, unseen, search)
        for i, term in enumerate(fit.terms)
        if term.effect.family is not Family.REMAINDER
    ]
    findings += outlier_findings(whole, cleaned, after, excess / floor**2, model.effects)
    if not significant:
        findings += noise_findings(whole, after)
    records = [finding.record for finding in findings]
    depends: tuple[str, ...] = ()
    if excess > decisions.DEPENDENT * floor**2:
        depends = tuple(dict.fromkeys([*(white.depends_on if grown else ()), *named]))
    return Diagnosis(
        findings=tuple(findings),
        flux_rms_before_t=rms(before),
        flux_rms_after_t=rms(after),
        flux_rms_floor_t=floor,
        unexplained=excess / possible if significant and possible > 0 else 0.0,
        depends_on=depends,
        tests_before=tuple(structure_tests(before)),
        tests_after=tests,
        model=corrected_model(model, fit.terms, records, cleaned.fields),
        search=search,
        refused=confirmed.refused,
        before=before,
        after=after,
        terms=fit.terms,
    )
