"""Describes one effect that was named, with what speaks for it."""

from dataclasses import dataclass, replace

import numpy as np

from anser_ros.diagnosis.fit import Fit
from anser_ros.diagnosis.problem import Problem, evaluate
from anser_ros.diagnosis.residuals import rms
from anser_ros.diagnosis.search import Search
from anser_ros.effects.term import Term
from anser_ros.field.model import EffectRecord


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


def plain_finding(term: Term, without: float) -> Finding:
    """Return a finding that is seen without a fit, and that nothing is done about."""
    record = term.effect.record(term, np.zeros((0, 0)))
    evidence = {'summary': term.effect.summary, 'remedy': term.effect.remedy.value}
    return Finding(replace(record, evidence=evidence), None, without)
