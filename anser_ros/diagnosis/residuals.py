"""Measures how large the residuals of the tools are."""

from dataclasses import replace

import numpy as np

from anser_ros.diagnosis.problem import Part, State, evaluate


def tool_parts(state: State) -> list[Part]:
    """Return the parts of a state that are tools, not references."""
    return [part for part in state.parts if not part.view.is_reference]


def tools_misfit(state: State) -> float:
    """Return the mean square of the tools' whitened residuals."""
    squares = sum(float(np.sum(part.white**2)) for part in tool_parts(state))
    return squares / max(sum(part.count for part in tool_parts(state)), 1)


def rms(state: State) -> float:
    """Return the residual of the tools with the jitter taken out, T a phasor component.

    All readings count alike, also where the model's scan has gaps.
    """
    problem = state.problem
    if any(gaps_t.any() for gaps_t in problem.gaps_t):
        alike = replace(problem, gaps_t=tuple(np.zeros_like(g) for g in problem.gaps_t))
        state = evaluate(alike, state.terms)
    return float(np.sqrt(tools_misfit(state))) * problem.spread.flux_t


def expected_rms(state: State) -> float:
    """Return what that residual should be: noise, and what the model may be wrong by."""
    problem = state.problem
    pairs = zip(problem.gaps_t, problem.good, strict=True)
    gaps_t = np.concatenate([gaps_t[good] for gaps_t, good in pairs])
    power = float(np.mean(gaps_t**2)) if gaps_t.size else 0.0
    return float(np.hypot(problem.spread.flux_t, np.sqrt(power)))
