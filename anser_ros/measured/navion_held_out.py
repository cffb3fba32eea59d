"""Leave one height out: choose effects on the others, predict the one, say what each was worth.

Nothing is learnt at the height that is predicted: magnets, metal, effects, sensor errors and their
widths all come from the other heights of that fold, the choice of effects included (log evidence).
A plate's own pose and bend can't come from elsewhere; they are left nominal. `with_own_pose` is
the other protocol: pose and bend from one half of the held-out plate's sensors, scored on the
other half.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.measured.navion_fit import EFFECTS, PlateFit, fit_plates
from anser_ros.measured.navion_plate import Plate, PlateData, predict_plane
from anser_ros.measured.navion_sources import locate_magnets, magnet_cloud, scan_for_metal
from anser_ros.measured.navion_system import Widths

Array = NDArray[np.float64]

PAYS = 20.0
"""Log evidence that an effect must add: overwhelming odds, and far above rounding."""

MAX_METAL = 4
"""Largest number of metal objects that are tried; each further one costs a scan."""
_NO_METAL = np.zeros((0, 3))
"""Positions of metal objects for a fit without any."""


@dataclass(frozen=True)
class Trial:
    """Records one candidate of one round in one fold.

    Attributes
    ----------
    round : int
        How many effects the model had before.
    candidate : str
    gain : float
        Log evidence that it adds on the fold's own heights.
    held_out_t : float
        Component RMSE at the held-out height with it, T.
    """

    round: int
    candidate: str
    gain: float
    held_out_t: float


@dataclass(frozen=True)
class Fold:
    """Holds what one fold chose, and the model without and with it.

    Attributes
    ----------
    held : int
        Index of the height that took no part.
    plain, fit : PlateFit
        Magnet dipoles only; with the effects that pay.
    trials : tuple of Trial
    dropped : dict
        Name of an effect to the held-out component RMSE (T) of the final model without it.
    """

    held: int
    plain: PlateFit
    fit: PlateFit
    trials: tuple[Trial, ...]
    dropped: dict[str, float]


def others(data: PlateData, held: int) -> PlateData:
    """Return the heights that a fold learns from."""
    return data.select([p for p in range(len(data.height_m)) if p != held])


def prediction_error(data: PlateData, held: int, fit: PlateFit) -> Array:
    """Return the predicted minus measured coil fields (K, S, 3), T, of a height that took
    no part.
    """
    height = float(data.height_m[held])
    predicted = predict_plane(data.grid_m, height, fit.sources, fit.errors, None)
    return np.asarray(predicted - data.field_t[held])


def rms(values: Array) -> float:
    """Return the root mean square of values."""
    return float(np.sqrt(np.mean(np.square(values))))


def run_fold(data: PlateData, held: int, tell: Callable[[str], None] = lambda _: None) -> Fold:
    """Choose on the other heights, predict the one."""
    known = others(data, held)
    choice = choose_effects(known, lambda fit: rms(prediction_error(data, held, fit)))
    height = float(data.height_m[held])
    tell(
        f'height {height:+.4f} m: {", ".join(sorted(choice.fit.effects))}, '
        f'metal: {metal_text(choice.fit)}'
    )
    dropped = _drop_each(data, held, choice.cloud, choice.fit)
    return Fold(held, choice.plain, choice.fit, choice.trials, dropped)


@dataclass(frozen=True)
class Choice:
    """Holds what was chosen: the magnets' dipoles, fits without and with effects, all trials."""

    cloud: Array
    plain: PlateFit
    fit: PlateFit
    trials: tuple[Trial, ...]


def choose_effects(
    known: PlateData, score: Callable[[PlateFit], float], max_metal: int = MAX_METAL
) -> Choice:
    """Add effects one at a time while each pays, then metal objects.

    Parameters
    ----------
    known : PlateData
        The heights to learn from; their log evidence alone chooses.
    score : callable
        Component RMSE (T) of a fit somewhere else; recorded with every trial, never used.
    max_metal : int
        Metal objects at most.
    """
    cloud = magnet_cloud(locate_magnets(known))
    plain = fit_plates(known, cloud, _NO_METAL, frozenset())
    best, trials = plain, []
    while best.effects != frozenset(EFFECTS):
        tried = []
        for name in (effect for effect in EFFECTS if effect not in best.effects):
            fit = fit_plates(known, cloud, _NO_METAL, best.effects | {name})
            tried.append((fit.log_evidence - best.log_evidence, fit))
            trials.append(Trial(len(best.effects), name, tried[-1][0], score(fit)))
        gain, fit = max(tried, key=lambda pair: pair[0])
        if gain < PAYS:
            break
        best = fit
    for _ in range(max_metal):
        fit = add_metal(known, cloud, best)
        gain = fit.log_evidence - best.log_evidence
        count = len(best.effects) + best.sources.n_metal
        trials.append(Trial(count, 'static_metal', gain, score(fit)))
        if gain < PAYS:
            break
        best = fit
    return Choice(cloud, plain, best, tuple(trials))


def add_metal(data: PlateData, cloud: Array, fit: PlateFit) -> PlateFit:
    """Add the one more metal object that raises the evidence most.

    Looked for twice, with and without trust in single readings: near metal shows in few sensors,
    which a robust fit distrusts; far metal drowns when a few wild readings are believed.
    """
    found = []
    metal_m = metal_places(fit)
    for robust in (True, False):
        start = fit if robust else fit_plates(data, cloud, metal_m, fit.effects, robust=False)
        place, _ = scan_for_metal(data, start, Widths().metal_am2)
        found.append(fit_plates(data, cloud, np.vstack([metal_m, place]), fit.effects))
    return max(found, key=lambda candidate: candidate.log_evidence)


def metal_places(fit: PlateFit) -> Array:
    """Return places (J, 3), m, of a fit's metal objects."""
    sources = fit.sources
    return sources.position_m[len(sources.position_m) - sources.n_metal :]


def metal_text(fit: PlateFit) -> str:
    """Return the objects' places in mm, for a person."""
    return '; '.join('({:.0f}, {:.0f}, {:.0f}) mm'.format(*(1e3 * p)) for p in metal_places(fit))


def _drop_each(data: PlateData, held: int, cloud: Array, best: PlateFit) -> dict[str, float]:
    known = others(data, held)
    dropped = {}
    for name in sorted(best.effects):
        fit = fit_plates(known, cloud, metal_places(best), best.effects - {name})
        dropped[name] = rms(prediction_error(data, held, fit))
    if best.sources.n_metal:
        fit = fit_plates(known, cloud, _NO_METAL, best.effects)
        dropped['static_metal'] = rms(prediction_error(data, held, fit))
    return dropped


def with_own_pose(data: PlateData, held: int, fit: PlateFit) -> tuple[Array, Array]:
    """Return errors when the plate's pose and bend come from the other half of its own sensors.

    The sensors are split like a chess board's fields.

    Returns
    -------
    error_t : ndarray, shape (K, S, 3)
        Predicted minus measured; each sensor predicted from the half that it isn't in.
    states : ndarray, shape (2, n_state)
        State learnt from the even and from the odd half.
    """
    even = chess_even(data.grid_m)
    error = np.empty_like(data.field_t[held])
    states = []
    for half in (even, ~even):
        state = fit_state(data, held, fit, half)
        predicted = predict_plane(
            data.grid_m, float(data.height_m[held]), fit.sources, fit.errors, state
        )
        error[:, ~half] = (predicted - data.field_t[held])[:, ~half]
        states.append(state)
    return error, np.array(states)


def chess_even(grid_m: Array) -> NDArray[np.bool_]:
    """Return which sensors (S,) of a square grid stand on the chess board's even fields."""
    pitch = np.min(np.diff(np.unique(np.round(grid_m[:, 0], 6))))
    steps = np.round((grid_m - grid_m.min(axis=0)) / pitch).astype(int)
    return np.asarray(steps[:, :2].sum(axis=1) % 2 == 0)


def fit_state(data: PlateData, held: int, fit: PlateFit, sensors: NDArray[np.bool_]) -> Array:
    """Return pose and bend of one plate from some of its sensors, everything else given."""
    plate, widths = Plate(data.grid_m), Widths()
    height = float(data.height_m[held])
    state = np.zeros(plate.n_state)
    sigma = np.repeat([widths.shift_m, widths.tilt_rad, widths.bend_m], [3, 3, plate.n_state - 6])
    weight = np.ones(int(sensors.sum()))
    for _ in range(8):
        position, rotation = plate.place(height, state, fit.errors.shift_m)
        shift, turn = plate.motion(height, state, position)
        field = fit.sources.field(position).transpose(2, 0, 1)
        change = np.einsum('slmk,sqm->ksql', fit.sources.gradient(position), shift)
        change = change - np.cross(turn[None], field[:, :, None])
        sensing = np.einsum('sij,slj->sil', fit.errors.matrix, rotation)
        columns = np.einsum('sil,ksql->skiq', sensing, change)[sensors]
        model = np.einsum('sil,ksl->ski', sensing, field)
        residual = (data.field_t[held].transpose(1, 0, 2) - model)[sensors]
        square = (residual**2).sum(axis=(1, 2)) / widths.noise_t**2
        weight = (widths.freedom + 9.0) / (widths.freedom + square)
        flat = columns.reshape(len(weight), -1, plate.n_state)
        normal = np.einsum('s,sra,srb->ab', weight, flat, flat) / widths.noise_t**2
        pull = np.einsum('s,sra,sr->a', weight, flat, residual.reshape(len(weight), -1))
        precision = np.diag(sigma**-2.0)
        pull = pull / widths.noise_t**2 - precision @ state
        state = state + np.linalg.solve(normal + precision, pull)
    return state
