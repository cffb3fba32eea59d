"""The whole loop: residual, effect, correction, and the error before and after on unseen data."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.confirm import MANY, Confirmation, doubtful
from anser_ros.diagnosis.corrected_model import corrected_model
from anser_ros.diagnosis.fit import Fit, misfit
from anser_ros.diagnosis.fluctuating import respread
from anser_ros.diagnosis.outlying import clean_start, outlying_share, without_outliers
from anser_ros.diagnosis.prepare import test_blocks, train_blocks
from anser_ros.diagnosis.problem import Part, Problem, State, evaluate
from anser_ros.diagnosis.refine import FINE, METALS, belongs_to, settled
from anser_ros.diagnosis.search import (
    Progress,
    Search,
    SearchSettings,
    search_effects,
)
from anser_ros.diagnosis.structure import (
    StructureTest,
    noise_scale,
    noise_t,
    structure_tests,
)
from anser_ros.diagnosis.whiteness import whiteness
from anser_ros.diagnosis.wiring import wiring_faults
from anser_ros.effects.effect import Effect, Term
from anser_ros.effects.fluctuation import Fluctuation
from anser_ros.effects.metal_remainder import REMAINDER
from anser_ros.effects.registry import all_effects
from anser_ros.field.model import EffectRecord, FieldModel

Array = NDArray[np.float64]

SEARCH_FRAMES, FINAL_FRAMES, WIRING_FRAMES = 270, 400, 150
"""Frames a tool that the search, the last fit and the look for wiring faults work on."""
NOISIER = 1.15
"""Factor from which noise counts as grown."""
FEWEST_OUTLIERS = 0.004
BESIDE_OUTLIERS = 0.3
"""Unexplained power over the floor's beside which frames that stand out are still outliers: a
model that is wrong by a fraction of the noise makes none."""


@dataclass(frozen=True)
class Finding:
    """One effect that was named.

    Attributes
    ----------
    record : EffectRecord
        Parameters, uncertainty and evidence.
    term : Term or None
        None where nothing is in force (noise, outliers).
    flux_rms_without_t : float
        Held-out residual with all effects but this one, T.
    """

    record: EffectRecord
    term: Term | None
    flux_rms_without_t: float


@dataclass(frozen=True)
class Diagnosis:
    """What was found.

    Attributes
    ----------
    findings : tuple of Finding
    flux_rms_before_t, flux_rms_after_t, flux_rms_floor_t : float
        Held-out residuals with the pose jitter taken out, T a phasor component.
    raw_rms_before_t, raw_rms_after_t : float
        The same with the jitter in.
    unexplained : float
        Share of the power above the floor that remains.
    depends_on : tuple of str
    tests_before, tests_after : tuple of StructureTest
    model : FieldModel
        With the effects.
    search : Search
    refused : tuple of Term
        Effects that explained something but were not confirmed.
    before, after : State
        The held-out part.
    """

    findings: tuple[Finding, ...]
    flux_rms_before_t: float
    flux_rms_after_t: float
    flux_rms_floor_t: float
    raw_rms_before_t: float
    raw_rms_after_t: float
    unexplained: float
    depends_on: tuple[str, ...]
    tests_before: tuple[StructureTest, ...]
    tests_after: tuple[StructureTest, ...]
    model: FieldModel
    search: Search
    refused: tuple[tuple[Term, Confirmation], ...]
    before: State
    after: State
    terms: tuple[Term, ...] = field(default_factory=tuple)


@dataclass(frozen=True)
class Screened:
    """A problem as the search starts with it.

    Attributes
    ----------
    known : tuple of Term
        Faults of the wiring, which are plain before any search.
    whole : Problem
        All frames, without the channels that hear nothing.
    start : Problem
        The same without values that stand out already now.
    """

    known: tuple[Term, ...]
    whole: Problem
    start: Problem

    def training(self, frames: int) -> Problem:
        """About so many frames a tool of the blocks that effects are chosen and fitted on."""
        return _thinned(self.start.in_blocks(train_blocks()), frames)


@dataclass(frozen=True)
class Confirmed:
    """The effects that are the same in all parts of the data.

    Attributes
    ----------
    fit : Fit
        All of them together.
    cleaned : Problem
        All frames, without values that stand out with these effects in force.
    refused : tuple of (Term, Confirmation)
        Effects that explained something but were not confirmed.
    """

    fit: Fit
    cleaned: Problem
    refused: tuple[tuple[Term, Confirmation], ...]


def diagnose(
    problem: Problem,
    model: FieldModel,
    settings: SearchSettings | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Find what a model lacks: screen, search, confirm and conclude.

    Parameters
    ----------
    problem : Problem
        Of the whole session (`anser_ros.diagnosis.prepare.build_problem`).
    model : FieldModel
        What the problem was built with.
    settings : SearchSettings, optional
    progress : callable, optional
        Told in words what goes on.
    """
    how, say = settings or SearchSettings(), progress or (lambda text: None)
    screened = screen(problem)
    search = search_screened(screened, how, say)
    say('joint fit')
    confirmed = confirm(screened, search, how)
    return conclude(screened, search, confirmed, model)


def screen(problem: Problem) -> Screened:
    """Name the faults of the wiring, and leave out dead channels and values that stand out."""
    known = wiring_faults(_thinned(problem, WIRING_FRAMES))
    whole = _without_dead(problem, known)
    return Screened(tuple(known), whole, whole if known else clean_start(whole))


def search_screened(
    screened: Screened, how: SearchSettings, progress: Progress | None = None
) -> Search:
    """Search for effects on a part of the training blocks' frames."""
    say = progress or (lambda text: None)
    training = screened.training(SEARCH_FRAMES)
    return search_effects(training, train_blocks(), list(screened.known), how, say)


def confirm(screened: Screened, search: Search, how: SearchSettings) -> Confirmed:
    """Fit what the search found on more frames, and keep what is the same in all parts."""
    blocks, whole = train_blocks(), screened.whole
    fit, refused = _settled(screened.training(FINAL_FRAMES), search, blocks, how)
    cleaned = without_outliers(whole, evaluate(whole, fit.terms))
    if outlying_share(screened.start, cleaned)[0] > FEWEST_OUTLIERS:
        thinned = _thinned(cleaned.in_blocks(blocks), FINAL_FRAMES)
        fit = settled(thinned, fit.terms, blocks, how.folds, how.iterations, FINE)
    return Confirmed(fit, cleaned, refused)


def _without_dead(problem: Problem, known: Sequence[Term]) -> Problem:
    """The problem without the channels that hear nothing."""
    dead = [
        c for term in known if term.effect.name == 'dead_channel' for c in term.site['channels']
    ]
    good = tuple(
        mask & ~np.isin(tool.sensors.channel, dead)
        for tool, mask in zip(problem.tools, problem.good, strict=True)
    )
    references = problem.references
    if references is not None:
        heard = ~np.isin(references.readings.sensors.channel, dead)
        valid = references.readings.valid & heard
        references = replace(references, readings=replace(references.readings, valid=valid))
    return replace(problem, good=good, references=references)


def _thinned(problem: Problem, frames: int) -> Problem:
    """About so many frames a tool."""
    most = max((tool.time.size for tool in problem.tools), default=0)
    step = max(1, round(most / frames))
    keep = [np.arange(0, tool.time.size, step) for tool in problem.tools]
    return problem.frames(keep, np.arange(problem.reference_blocks.size))


def _settled(
    problem: Problem, search: Search, blocks: NDArray[np.int64], how: SearchSettings
) -> tuple[Fit, tuple[tuple[Term, Confirmation], ...]]:
    """The joint fit of the effects that are the same in all parts of the data."""
    fit, refused = search.fit, []
    while True:
        bad = doubtful(fit.state.problem, fit, noise_scale(fit.state) ** 2)
        if not bad:
            break
        # Metal that is doubtful costs much to fit again and is hardly ever more than a stand-in.
        metal = [pair for pair in bad if pair[1].effect.name in METALS]
        crowd = [pair for pair in bad if pair[0].alike >= MANY]
        dropped = metal or crowd or bad[:1]
        refused += [(term, check) for check, term in dropped]
        gone = [term for _, term in dropped]
        rest = [t for t in fit.terms if not any(t is term or belongs_to(t, term) for term in gone)]
        rest = list(respread(fit.state.problem, rest))
        fit = settled(fit.state.problem, rest, blocks, how.folds, how.iterations)
    return settled(
        problem, respread(problem, fit.terms), blocks, how.folds, how.iterations, FINE
    ), tuple(refused)


def _tools(state: State) -> list[Part]:
    return [part for part in state.parts if not part.view.is_reference]


def rms(state: State) -> float:
    """Residual of the tools with the jitter taken out, T a phasor component."""
    squares = sum(float(np.sum(part.white**2)) for part in _tools(state))
    count = sum(part.count for part in _tools(state))
    return float(np.sqrt(squares / max(count, 1))) * state.problem.spread.flux_t


def raw_rms(state: State) -> float:
    """Residual of the tools as it is, T a phasor component."""
    squares, count = 0.0, 0
    for part in _tools(state):
        good = part.whitener.weight > 0
        squares += float(np.sum(part.residual[good] ** 2))
        count += int(good.sum())
    return float(np.sqrt(squares / max(count, 1)))


def conclude(
    screened: Screened, search: Search, confirmed: Confirmed, model: FieldModel
) -> Diagnosis:
    """Judge on the held-out blocks what the effects explain and what they leave."""
    whole, cleaned, fit = screened.whole, confirmed.cleaned, confirmed.fit
    unseen = cleaned.in_blocks(test_blocks())
    before, after = evaluate(unseen, ()), evaluate(unseen, fit.terms)
    white = whiteness(after)
    expected = cleaned.spread.flux_t
    # Residuals that are no noise must not make the floor that they are measured by.
    grown = noise_t(after) > NOISIER * cleaned.spread.noise_t
    scale = min(noise_scale(after), 1.0) if grown and not white.holds else noise_scale(after)
    floor = min(scale * expected, rms(after))
    tests = tuple(structure_tests(after))
    excess = max(rms(after) ** 2 - floor**2, 0.0)
    structured = any(test.significant for test in tests)
    significant = excess > (0.03 if structured else 0.1) * floor**2
    possible = max(rms(before) ** 2 - floor**2, excess)
    findings = [
        _finding(fit, i, term, unseen, search)
        for i, term in enumerate(fit.terms)
        if term.effect is not REMAINDER
    ]
    few = excess < BESIDE_OUTLIERS * floor**2
    findings += _noise_findings(whole, cleaned, after, significant, few)
    records = [finding.record for finding in findings]
    depends: tuple[str, ...] = ()
    if excess > 0.05 * floor**2:
        named = [t.variable for t in tests if t.significant]
        depends = tuple(dict.fromkeys([*(white.depends_on if grown else ()), *named]))
    return Diagnosis(
        findings=tuple(findings),
        flux_rms_before_t=rms(before),
        flux_rms_after_t=rms(after),
        flux_rms_floor_t=floor,
        raw_rms_before_t=raw_rms(before),
        raw_rms_after_t=raw_rms(after),
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


def _finding(fit: Fit, index: int, term: Term, unseen: Problem, search: Search) -> Finding:
    rest = [t for t in fit.terms if t is not term and not belongs_to(t, term)]
    without = rms(evaluate(unseen, rest))
    record = term.effect.record(term, fit.covariance_of(index))
    gain = next(
        (
            c.gain
            for found in search.rounds
            for c in found
            if c.fitted_gain is not None and c.term.label == term.label
        ),
        None,
    )
    evidence = {
        'summary': term.effect.summary,
        'remedy': term.effect.remedy.value,
        'parameters_spent': int(term.theta.size),
        'held_out_gain': None if gain is None else float(gain),
        'rivals': [c.term.label for c in search.rivals.get(term.label, [])],
    }
    return Finding(replace(record, evidence={**record.evidence, **evidence}), term, without)


def _noise_findings(
    whole: Problem, cleaned: Problem, after: State, significant: bool, few: bool
) -> list[Finding]:
    found = []
    site: dict[str, object]
    share, channels = outlying_share(whole, cleaned)
    effects: dict[str, Effect] = all_effects()
    frames = sum(tool.time.size for tool in whole.tools)
    # A fluctuation is taken for normal: frames far out along it are its own tails.
    own_tails = any(isinstance(term.effect, Fluctuation) for term in after.terms)
    if share > FEWEST_OUTLIERS and (channels or (few and not own_tails)):
        site = {'fraction': share, 'sigma': float(np.sqrt(share / max(frames, 1)))}
        if channels:
            site['channels'] = tuple(channels)
        name = 'loose_contact' if channels else 'outliers'
        found.append(_plain(effects[name], site, rms(after)))
    factor = noise_t(after) / whole.spread.noise_t
    if factor > NOISIER and not significant:
        noisy = _noisy_channels(after)
        if noisy:
            factor = _factor_of(after, noisy)
        count = (
            after.count * (len(noisy) or 1) / (len(whole.apparatus.tool_channels) if noisy else 1)
        )
        site = {'factor': factor, 'sigma': factor / np.sqrt(2 * max(count, 1))}
        if noisy:
            site['channels'] = noisy
        found.append(_plain(effects['excess_noise'], site, rms(after)))
    return found


def _plain(effect: Effect, site: dict[str, object], without: float) -> Finding:
    record = effect.record(Term(effect, site), np.zeros((0, 0)))
    evidence = {'summary': effect.summary, 'remedy': effect.remedy.value}
    return Finding(replace(record, evidence=evidence), None, without)


def _factor_of(state: State, channels: tuple[int, ...]) -> float:
    """Noise of some channels over what it should be."""
    squares, count = 0.0, 0
    for part in _tools(state):
        own = np.isin(part.view.sensors.channel, channels)
        size = (part.white * (part.whitener.weight > 0)).reshape(
            -1, 2, own.size, state.problem.fields.omega.size
        )[:, :, own]
        squares += float(np.sum(size**2))
        count += size.size
    spread = state.problem.spread
    return float(np.sqrt(squares / max(count, 1))) * spread.flux_t / spread.noise_t


def _noisy_channels(state: State) -> tuple[int, ...]:
    """Channels with grown noise, where others have none."""
    emitters = state.problem.fields.omega.size
    noisy, sound = [], 0
    for part in _tools(state):
        squares = part.white**2 * (part.whitener.weight > 0)
        sensors = len(part.view.sensors)
        size = squares.reshape(-1, 2, sensors, emitters).mean(axis=(0, 1, 3))
        for channel, value in zip(part.view.sensors.channel.tolist(), size, strict=True):
            if value > NOISIER**2:
                noisy.append(int(channel))
            else:
                sound += 1
    return tuple(noisy) if sound else ()


__all__ = ['Diagnosis', 'Finding', 'diagnose', 'misfit', 'raw_rms', 'rms']
