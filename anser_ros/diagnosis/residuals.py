"""Measures how large the residuals of the tools are."""

import numpy as np

from anser_ros.diagnosis.problem import Part, State


def tool_parts(state: State) -> list[Part]:
    """Return the parts of a state that are tools, not references."""
    return [part for part in state.parts if not part.view.is_reference]


def rms(state: State) -> float:
    """Return the residual of the tools with the jitter taken out, T a phasor component."""
    squares = sum(float(np.sum(part.white**2)) for part in tool_parts(state))
    count = sum(part.count for part in tool_parts(state))
    return float(np.sqrt(squares / max(count, 1))) * state.problem.spread.flux_t
