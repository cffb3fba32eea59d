"""Runs the whole loop: residual, effect, correction, the error before and after on unseen data.

First what describes the findings: fitted effects, outliers, noise, and the model with all of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from anser_ros.arrays import Integers
from anser_ros.diagnosis import decisions, screening
from anser_ros.diagnosis.choice import Confirmation, doubtful, refit_spreads
from anser_ros.diagnosis.fit import FINE, Fit, Fitter, settled
from anser_ros.diagnosis.problem import (
    Problem,
    State,
    evaluate,
    expected_rms,
    rms,
    test_blocks,
    train_blocks,
)
from anser_ros.diagnosis.search import FluxSelection, Progress, Search, SearchSettings
from anser_ros.diagnosis.wiring import wiring_faults
from anser_ros.effects.correction import Fields, changed_illumination
from anser_ros.effects.effect import Family, Remedy, Term
from anser_ros.effects.seen import EXCESS_NOISE, known_share, outliers_of
from anser_ros.field.model import Dipoles, EffectRecord, FieldModel

SCHEMA = 'anser_diagnosis/1'
"""Name of the document's layout (`docs/interfaces.md`), which stands in it."""


@dataclass(frozen=True)
class Finding:
    """Describes one effect that was named."""

    record: EffectRecord  # parameters, uncertainty and evidence
    term: Term | None  # None where nothing is fitted (noise, outliers)
    flux_rms_without_t: float  # held-out residual with all effects but this one, T


def fitted_finding(fit: Fit, index: int, unseen: Problem, search: Search) -> Finding:
    """Return the finding of one term of the last fit; ``unseen`` took no part in it."""
    term = fit.terms[index]
    rest = [t for t in fit.terms if t is not term and not t.belongs_to(term)]
    without = rms(evaluate(unseen, rest))
    record = term.effect.record(term, fit.covariance_of(index))
    tried = (candidate for found in search.rounds for candidate in found)
    gains = [c.gain for c in tried if c.fitted_gain is not None and c.term.label == term.label]
    evidence = {
        'summary': term.effect.summary,
        'remedy': term.effect.remedy.value,
        'parameters_spent': int(term.theta.size),
        'held_out_gain': float(gains[0]) if gains else None,
        'rivals': [c.term.label for c in search.rivals.get(term.label, [])],
    }
    return Finding(replace(record, evidence={**record.evidence, **evidence}), term, without)


def plain_finding(term: Term, without: float) -> Finding:
    """Return a finding that is seen without a fit, and that nothing is done about."""
    record = term.effect.record(term, np.zeros((0, 0)))
    evidence = {'summary': term.effect.summary, 'remedy': term.effect.remedy.value}
    return Finding(replace(record, evidence=evidence), None, without)


def outlier_findings(
    whole: Problem, cleaned: Problem, after: State, excess: float, known: Sequence[EffectRecord]
) -> list[Finding]:
    """Return outliers or a loose contact, where frames stand out and nothing else makes them.

    ``whole`` and ``cleaned``: with and without the frames that stand out; ``after``: the held-out
    part with all effects; ``excess``: power that is not explained, over what is known; ``known``:
    the model's effects. Frames that stood out in its own scan are what the tracker always does.
    """
    share, channels = screening.outlying_share(whole, cleaned)
    # A fluctuation is taken for normal: frames far out along it are its own tails.
    own_tails = any(term.effect.family is Family.FLUCTUATION for term in after.terms)
    alone = excess < decisions.MOST_EXCESS_OF_OUTLIERS and not own_tails
    frames = sum(tool.time.size for tool in whole.tools)
    always = known_share(known)
    usual = always + decisions.KNOWN_SIGMAS * float(np.sqrt(always / max(frames, 1)))
    if share <= decisions.FEWEST_OUTLIERS + usual or not (channels or alone):
        return []
    sigma = float(np.sqrt(share / max(frames, 1)))
    return [plain_finding(outliers_of(share, sigma, channels), rms(after))]


def noise_findings(whole: Problem, after: State, noisy: Mapping[int, float]) -> list[Finding]:
    """Return excess noise, of all channels or of those that have it (`noisy_channels`)."""
    factor = screening.noise_t(after) / whole.spread.noise_t
    if factor <= decisions.LEAST_NOISE_GROWTH:
        return []
    count: float = after.count
    if noisy:
        size = float(np.sqrt(np.mean([*noisy.values()])))
        factor = size * whole.spread.flux_t / whole.spread.noise_t
        count *= len(noisy) / len(whole.apparatus.tool_channels)
    sigma = factor / np.sqrt(2 * max(count, 1))
    return [plain_finding(EXCESS_NOISE.seen(factor, sigma, tuple(noisy)), rms(after))]


def corrected_model(
    model: FieldModel, terms: Sequence[Term], records: Sequence[EffectRecord], fields: Fields
) -> FieldModel:
    """Bake field effects into the dipoles and list all effects.

    Metal that moves is not included: the live refit finds its place from the references.
    """
    dipoles = model.dipoles
    light = changed_illumination(terms, fields.illumination)
    for term in terms:
        if term.effect.remedy is Remedy.FIELD and not term.effect.moving:
            added = term.effect.sources(term, fields.model, light, fields.omega)
            if added is not None:
                dipoles = dipoles.joined(added)
    if dipoles.positions.shape[0] == model.positions.shape[0]:
        return replace(model, effects=(*model.effects, *records))
    merged, rows = _merged(dipoles)
    modes = model.modes
    if modes is not None:
        wide = np.zeros((modes.shape[0], merged.positions.shape[0], modes.shape[2]), dtype=complex)
        for mode, own in zip(wide, modes, strict=True):
            np.add.at(mode, rows[: model.positions.shape[0]], own)
        modes = wide
    # References were read in the field without these.
    return replace(
        model, positions=merged.positions, directions=merged.directions, moments=merged.moments,
        modes=modes, effects=(*model.effects, *records), references=None,
    )  # fmt: skip


def _merged(dipoles: Dipoles) -> tuple[Dipoles, Integers]:
    """Dipoles of the same place and direction added up, and the row that each went to."""
    key = np.round(np.concatenate([dipoles.positions * 1e9, dipoles.directions * 1e9], axis=1))
    _, first, rows = np.unique(key, axis=0, return_index=True, return_inverse=True)
    rows = rows.ravel()
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(order.size)
    rows, first = rank[rows], first[order]
    moments = np.zeros((first.size, dipoles.moments.shape[1]), dtype=complex)
    np.add.at(moments, rows, dipoles.moments)
    return Dipoles(dipoles.positions[first], dipoles.directions[first], moments), rows


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
    tests_before: tuple[screening.StructureTest, ...]
    tests_after: tuple[screening.StructureTest, ...]
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

    def training(self, frames: int, terms: Sequence[Term] = ()) -> Problem:
        """Return about so many frames per tool of the blocks to choose and fit effects on.

        Values that stand out beside some effects take no part.
        """
        sound = screening.without_outliers(self.whole, terms)
        return sound.in_blocks(train_blocks()).thinned(frames)


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

    ``problem``: of the whole session (`anser_ros.diagnosis.problem.build_problem`); ``model``:
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
    """Name the faults of the wiring, and leave out dead channels."""
    known = wiring_faults(problem.thinned(WIRING_FRAMES))
    return Screened(tuple(known), _without_dead(problem, known))


def search_screened(
    screened: Screened, how: SearchSettings, progress: Progress | None = None
) -> Search:
    """Search for effects on a part of the training blocks' frames."""
    beside = partial(screened.training, SEARCH_FRAMES)
    selection = FluxSelection(beside, train_blocks(), how, screened.known, progress)
    selection.search.fit = selection.grown(selection.search.fit)
    return selection.search


def confirm(screened: Screened, search: Search, how: SearchSettings) -> Confirmed:
    """Fit what the search found on more frames, and keep what is the same in all parts."""
    blocks = train_blocks()
    found, refused = _settled(Fitter(search.fit.state.problem, blocks, how.iterations), search)
    last = Fitter(screened.training(FINAL_FRAMES, found.terms), blocks, how.iterations)
    fit = settled(last, refit_spreads(last.problem, found.terms), FINE)
    return Confirmed(fit, screening.without_outliers(screened.whole, fit.terms), refused)


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


def _settled(fitter: Fitter, search: Search) -> tuple[Fit, tuple[tuple[Term, Confirmation], ...]]:
    """The joint fit of the effects that are the same in all parts of the data."""
    fit, refused = search.fit, []
    while bad := doubtful(fitter.problem, fit):
        # Metal that is doubtful costs much to fit again and is hardly ever more than a stand-in.
        metal = [pair for pair in bad if pair[1].effect.family.is_metal]
        crowd = [pair for pair in bad if pair[0].alike >= decisions.MANY]
        dropped = metal or crowd or bad[:1]
        refused += [(term, check) for check, term in dropped]
        gone = [term for _, term in dropped]
        rest = [t for t in fit.terms if not any(t is term or t.belongs_to(term) for term in gone)]
        # No curve, no constant: what it went before has a chance, once.
        rest += [p for t in gone if (p := search.passed.pop(t.label, None)) is not None]
        fit = settled(fitter, refit_spreads(fitter.problem, rest))
    return fit, tuple(refused)


def conclude(
    screened: Screened, search: Search, confirmed: Confirmed, model: FieldModel
) -> Diagnosis:
    """Judge on the held-out blocks what the effects explain and what they leave."""
    whole, cleaned, fit = screened.whole, confirmed.cleaned, confirmed.fit
    unseen = cleaned.in_blocks(test_blocks())
    before, after = evaluate(unseen, ()), evaluate(unseen, fit.terms)
    noisy = screening.noisy_channels(after)
    depending = screening.not_white(after, [*noisy])
    expected = expected_rms(after)
    # Residuals that are no noise must not make the floor that they are measured by.
    grown = screening.noise_t(after) > decisions.LEAST_NOISE_GROWTH * cleaned.spread.noise_t
    scale = screening.noise_scale(after)
    scale = min(scale, 1.0) if grown and depending else scale
    floor = min(scale * expected, rms(after))
    tests = tuple(screening.structure_tests(after))
    excess = max(rms(after) ** 2 - floor**2, 0.0)
    named = [test.variable for test in tests if test.significant]
    # Noise of some channels alone differs from channel to channel, too.
    alone = screening.GROUPED if noisy and not depending else ()
    least = decisions.STRUCTURED if {*named}.difference(alone) else decisions.UNSTRUCTURED
    significant = excess > least * floor**2
    possible = max(rms(before) ** 2 - floor**2, excess)
    findings = [
        fitted_finding(fit, i, unseen, search)
        for i, term in enumerate(fit.terms)
        if term.effect.family is not Family.REMAINDER
    ]
    own = rms(after) ** 2 / max(floor, expected) ** 2 - 1.0
    findings += outlier_findings(whole, cleaned, after, own, model.effects)
    if not significant:
        findings += noise_findings(whole, after, noisy)
    records = [finding.record for finding in findings]
    depends: tuple[str, ...] = ()
    if excess > decisions.DEPENDENT * floor**2:
        depends = tuple(dict.fromkeys([*(depending if grown else ()), *named]))
    return Diagnosis(
        findings=tuple(findings), flux_rms_before_t=rms(before), flux_rms_after_t=rms(after),
        flux_rms_floor_t=floor, depends_on=depends,
        unexplained=excess / possible if significant and possible > 0 else 0.0,
        tests_before=tuple(screening.structure_tests(before)), tests_after=tests,
        model=corrected_model(model, fit.terms, records, cleaned.fields), search=search,
        refused=confirmed.refused, before=before, after=after, terms=fit.terms,
    )  # fmt: skip
