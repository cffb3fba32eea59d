"""Reports model and refit in ``/diagnostics``: their figures, and a line for every reference."""

import numpy as np

from anser_ros.field.model import FieldModel
from anser_ros.nodes.field_model_parts.refit_in_force import ActiveRefit
from anser_ros.nodes.runtime.node import Level, Status
from anser_ros.refit.result import WITHHELD, RefitResult

TROUBLED = tuple(WITHHELD)
"""States of the refit that an operator is warned of."""
PREPARING = (
    'a baseline is there, the refit is being prepared: until it is in force there are no poses '
    '(state references_lost), as metal may come meanwhile'
)
ACTIVE = 'the refit is in force: the model follows the references'


def no_baseline(namespace: str) -> str:
    """Return words for the console if references are there, but nothing to compare them with."""
    return (
        'no baseline of the references, so the model does not follow them, and metal will make '
        f'poses vanish (state residual): with no metal near, call {namespace}/field_model/'
        'set_baseline, or give a clean recording as baseline_file'
    )


def model_values(model: FieldModel, name: str) -> dict[str, object]:
    """Return the figures of the active model; ``name`` stands where its source is not known."""
    return {
        'source': model.provenance.get('source', name),
        'dipoles': len(model.positions),
        'emitters': len(model.emitters),
        'flux_error_t': float(model.flux_error_t),
        'modes': 0 if model.modes is None else len(model.modes),
    }


def refit_values(result: RefitResult | None) -> dict[str, object]:
    """Return the figures of a frame's refit by their names in `/diagnostics`."""
    if result is None:
        return {}
    return {
        'refit_state': result.state,
        'refit_reason': result.reason,
        'reference_noise_t': result.noise_t,
        'change_log_odds': result.log_odds,
        'references_left_out': ', '.join(result.left_out),
        'most_likely': max(result.weights, key=result.weights.__getitem__, default=''),
        'largest_drift': float(np.abs(result.drift).max(initial=0.0)),
    }


def refit_words(result: RefitResult | None, refused: str = '', making: str = '') -> str:
    """Return what the refit did in this frame, and why where something was in its way.

    ``refused`` is why a baseline that was requested since then is not active, ``making`` the
    progress of the refit to another one.
    """
    words = f'; a new baseline was refused: {refused}' if refused else ''
    words += f'; the next {making}' if making else ''
    if result is None:
        return f'baseline set{words}'
    return (result.state if not result.reason else f'{result.state}: {result.reason}') + words


def rest_words(is_held: bool, is_wanted: bool, no_baseline: str, making: str = '') -> str:
    """Return why the model does not follow the references."""
    if is_held:
        return 'held as it is: freeze was called'
    if not is_wanted:
        return 'constant'
    if making:
        return f'constant, {making}'
    return f'constant, no baseline: {no_baseline}' if no_baseline else 'constant, no baseline yet'


def activity(
    refit: ActiveRefit, is_held: bool, is_wanted: bool, refused: str, values: dict[str, object]
) -> str:
    """Return what the refit does, and add its figures to the values."""
    result, making = refit.result, refit.words
    if refit.current is None or is_held or not is_wanted:
        return rest_words(is_held, is_wanted, refused, making)
    values |= refit_values(result)
    return refit_words(result, refused, making)


def reference_statuses(result: RefitResult | None) -> list[Status]:
    """Return a line for every reference sensor that the refit looked at."""
    if result is None:
        return []
    return [
        Status(
            health.name,
            Level.OK if health.state == 'ok' else Level.WARN,
            health.state,
            {'residual_t': health.residual_t, 'distance': health.distance},
        )
        for health in result.references
    ]
