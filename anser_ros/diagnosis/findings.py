"""Describes what was named: fitted effects, outliers, noise, and the model with all of them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis import decisions
from anser_ros.diagnosis.fit import Fit
from anser_ros.diagnosis.problem import Problem, State, evaluate, rms, tool_parts
from anser_ros.diagnosis.screening import outlying_share
from anser_ros.diagnosis.search import Search
from anser_ros.diagnosis.structure import noise_t
from anser_ros.effects.effect import Family, Remedy, Term
from anser_ros.effects.prediction import Fields, changed_illumination
from anser_ros.effects.seen import EXCESS_NOISE, known_share, outliers_of
from anser_ros.field.dipoles import Dipoles
from anser_ros.field.model import EffectRecord, FieldModel

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


Array = NDArray[np.float64]


def outlier_findings(
    whole: Problem,
    cleaned: Problem,
    after: State,
    excess: float,
    known: Sequence[EffectRecord] = (),
) -> list[Finding]:
    """Return outliers or a loose contact, where frames stand out and nothing else makes them.

    ``whole`` and ``cleaned``: with and without the frames that stand out; ``after``: the held-out
    part with all effects; ``excess``: power that is not explained, over the floor's; ``known``:
    the model's effects. Frames that stood out in its own scan are what the tracker always does.
    """
    share, channels = outlying_share(whole, cleaned)
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


def noise_findings(whole: Problem, after: State) -> list[Finding]:
    """Return excess noise, of all channels or of those that have it."""
    factor = noise_t(after) / whole.spread.noise_t
    if factor <= decisions.LEAST_NOISE_GROWTH:
        return []
    squares: dict[int, Array] = {}
    for part in tool_parts(after):
        square = part.white**2 * (part.whitener.weight > 0)
        cells = square.reshape(-1, 2, *part.view.flux.shape[1:])
        for row, channel in enumerate(part.view.sensors.channel.tolist()):
            squares[channel] = cells[:, :, row]
    noisy = [c for c, values in squares.items() if values.mean() > decisions.LEAST_NOISE_GROWTH**2]
    if len(noisy) == len(squares):  # where no others have none, it is that of all
        noisy = []
    count: float = after.count
    if noisy:
        size = np.sqrt(np.mean(np.concatenate([squares[c].ravel() for c in noisy])))
        factor = float(size) * whole.spread.flux_t / whole.spread.noise_t
        count *= len(noisy) / len(whole.apparatus.tool_channels)
    sigma = factor / np.sqrt(2 * max(count, 1))
    return [plain_finding(EXCESS_NOISE.seen(factor, sigma, tuple(noisy)), rms(after))]


def corrected_model(
    model: FieldModel, terms: Sequence[Term], records: Sequence[EffectRecord], fields: Fields
) -> FieldModel:
    """Bake field effects into the dipoles and list all effects.

    Metal that moves is not included: the live refit finds its place from the references.
    """
    dipoles = Dipoles(model.positions, model.directions, model.moments)
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
    return replace(
        model,
        positions=merged.positions,
        directions=merged.directions,
        moments=merged.moments,
        modes=modes,
        effects=(*model.effects, *records),
        references=None,  # they were read in the field without these
    )


def _merged(dipoles: Dipoles) -> tuple[Dipoles, NDArray[np.int64]]:
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
