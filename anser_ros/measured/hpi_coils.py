"""Analyses four coils on a head before 306 SQUID channels: tones, wrong channels, places.

The data (github mne-tools/mne-python, BSD-3) are read where they lie.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import FitError
from anser_ros.measured import ReportRow
from anser_ros.measured.hpi_array_errors import (
    START,
    STEPS,
    UNITS,
    SharedError,
    choose_chip_errors,
    weigh,
)
from anser_ros.measured.hpi_channels import ChannelFindings, examine
from anser_ros.measured.hpi_demodulation import Tones, demodulate, find_tones
from anser_ros.measured.hpi_fit import (
    CoilData,
    CoilFit,
    LeadSearch,
    first_place,
    grow_chain,
    plain_fit,
    student_loss,
)
from anser_ros.measured.hpi_places import (
    arms_left_out,
    best_arm,
    distance_mm,
    order_of,
    outward,
)
from anser_ros.measured.squid_array import ChipErrors, SquidArray

Array = NDArray[np.float64]

NAME = 'hpi_coils'

TARGET_MM, TARGET_CORRELATION = 1.2, 0.9999
"""Figures that the analysis should reach: distance (mm) from the digitised places, and
correlation."""
MOST_LEADS, FOLDS = 5, 6
"""Largest number of dipoles of a lead, and folds of channels by which the number is chosen."""
LEAST_CHANGE = 0.02
"""Least fall of the held-out loss (log density a channel) that a dipole of a lead must bring."""


@dataclass(frozen=True)
class HpiData:
    """Holds the data of the file, in SI units."""

    array: SquidArray
    stored: Array
    epoch: Array
    rate_hz: float
    vendor_m: Array
    digitised_m: Array


@dataclass(frozen=True)
class HpiHeldOut:
    """Holds channels left out, predicted from the others.

    Attributes
    ----------
    plain : ndarray, shape (K, S)
        By the plain single dipole.
    chain : ndarray, shape (K, D, S)
        With 0, 1, ... dipoles of the lead.
    loss : ndarray, shape (K, D, folds)
        Mean Student loss of the residuals over their expected spread: a channel left out beside a
        lead that only it sees cannot be foreseen, and must not decide alone.
    spread : ndarray, shape (K, S)
        Expected spread of each channel, the yardstick of all predictions.
    """

    plain: Array
    chain: Array
    loss: Array
    spread: Array


@dataclass(frozen=True)
class HpiAnalysis:
    """Holds everything of this data set."""

    data: HpiData
    tones: Tones
    findings: ChannelFindings
    coils: tuple[CoilData, ...]
    held_out: HpiHeldOut
    n_leads: tuple[int, ...]
    chip_errors: ChipErrors
    plain_m: Array
    surveyed: tuple[CoilFit, ...]
    shared: tuple[SharedError, ...]
    final: tuple[CoilFit, ...]
    accepted: str


def load(folder: Path) -> HpiData:
    """Read the data of the file ``hpi_coils.npz``.

    Raises
    ------
    FitError
        When the file is missing or lacks an array.
    """
    path = folder / 'hpi_coils.npz'
    if not path.is_file():
        raise FitError(f'no such file: {path}')
    with np.load(path) as stored:
        try:
            part = {key: stored[key] for key in stored.files}
            names = tuple(str(name) for name in part['ch_names'])
            labels = np.array([name[:-1] for name in names])
            chips = np.array([np.flatnonzero(labels == label) for label in np.unique(labels)])
            array = SquidArray(
                names,
                part['is_mag'],
                part['int_pos'],
                part['int_normal'],
                part['int_weight'],
                chips.astype(np.int64),
            )
            return HpiData(
                array,
                part['slopes'],
                part['epoch_adc'].astype(float),
                float(part['epoch_sfreq']),
                part['neuromag_fit_dev'],
                part['polhemus_head'],
            )
        except (KeyError, ValueError) as error:
            raise FitError(f'{path.name} is not the expected set of arrays: {error}') from error


def fold_of(array: SquidArray) -> NDArray[np.int64]:
    """Fold of each channel: one of a chip's three, on every second chip."""
    fold = np.empty(len(array.names), dtype=np.int64)
    chip, place = np.indices(array.chips.shape)
    fold[array.chips] = place + 3 * ((chip + place) % 2)
    return fold


def predict_left_out(data: CoilData, fit: CoilFit) -> Array:
    """Return channels that took no part: the sources' field, and what their chip's others tell."""
    left = np.where(data.used, data.signals - fit.predicted, 0.0)
    return fit.predicted + fit.white.explained(left)


def hold_out(
    array: SquidArray, coils: tuple[CoilData, ...], starts: Array, leads: LeadSearch
) -> HpiHeldOut:
    """Predict each sixth of the channels from the others, for each number of dipoles."""
    fold, count = fold_of(array), len(array.names)
    plain = np.zeros((len(coils), count))
    chain = np.zeros((len(coils), MOST_LEADS + 1, count))
    loss = np.zeros((len(coils), MOST_LEADS + 1, FOLDS))
    spread = np.zeros((len(coils), count))
    for k, data in enumerate(coils):
        for f in range(FOLDS):
            out = (fold == f) & data.used
            part = CoilData(data.signals, data.noise, data.used & (fold != f))
            plain[k, out] = plain_fit(array, part, first_place(array, part, starts[k][None]))[out]
            grown = grow_chain(array, part, starts[k], START, leads, MOST_LEADS)
            spread[k, out] = np.sqrt(expected_power(array, data, grown[0]))[out]
            for n, fitted in enumerate(grown):
                chain[k, n, out] = predict_left_out(part, fitted)[out]
                left = (data.signals - chain[k, n])[out] / spread[k, out]
                loss[k, n, f] = student_loss(left, 1).mean()
    return HpiHeldOut(plain, chain, loss, spread)


def expected_power(array: SquidArray, data: CoilData, fit: CoilFit) -> Array:
    """Return one yardstick for all predictions: variance (S,) by noise and chip errors."""
    spread = array.chip_columns(fit.places_m[0], fit.moments[0])
    return np.asarray(
        data.noise**2
        + START.place_m**2 * np.sum(spread[:, :3] ** 2, axis=1)
        + START.tilt_rad**2 * np.sum(spread[:, 3:] ** 2, axis=1)
        + (START.gain * fit.predicted) ** 2
    )


def choose_leads(loss: Array) -> int:
    """Return the number of dipoles, of losses (D, folds): the last that lowers the unseen loss."""
    best = 0
    for n in range(1, len(loss)):
        if np.mean(loss[n] - loss[best]) < -LEAST_CHANGE:
            best = n
    return best


def analyse(folder: Path) -> HpiAnalysis:
    """Demodulate, examine, choose the leads on channels left out, then the array's own errors."""
    data = load(folder)
    array = data.array
    tones = demodulate(
        data.epoch, data.rate_hz, find_tones(data.epoch, data.rate_hz), array.is_magnetometer
    )
    findings = examine(array, tones, data.stored)
    coils = tuple(CoilData(signal, findings.noise, ~findings.noisy) for signal in findings.signals)
    starts = array.centres_m.mean(axis=0) + 0.06 * np.array(
        [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]], dtype=float
    )
    plain = np.array([first_place(array, coil, starts) for coil in coils])
    leads = LeadSearch(array)
    held_out = hold_out(array, coils, plain, leads)
    n_leads = tuple(choose_leads(loss) for loss in held_out.loss)
    grown = [
        grow_chain(array, coil, place, START, leads, n)[-1]
        for coil, place, n in zip(coils, plain, n_leads, strict=True)
    ]
    errors, surveyed = choose_chip_errors(array, coils, grown, START)
    shared = tuple(weigh(array, coils, surveyed, errors, name) for name in STEPS)
    best = max(shared, key=lambda item: item.gain - item.price)
    accepted = best.name if best.gain > best.price else ''
    return HpiAnalysis(
        data,
        tones,
        findings,
        coils,
        held_out,
        n_leads,
        errors,
        plain,
        surveyed,
        shared,
        best.fits if accepted else surveyed,
        accepted,
    )


def relative_error(analysis: HpiAnalysis, predicted: Array, kind: NDArray[np.bool_]) -> float:
    """Return the root of the summed squared error over the summed squared signal, %, channels of a
    kind.
    """
    keep = kind & ~analysis.findings.noisy
    signals = analysis.findings.signals[:, keep]
    return 100.0 * float(np.linalg.norm(predicted[:, keep] - signals) / np.linalg.norm(signals))


def rows(analysis: HpiAnalysis) -> list[ReportRow]:
    """Return the figures before and after the analysis."""
    return [*_demodulation_rows(analysis), *_place_rows(analysis), *_channel_rows(analysis)]


def _demodulation_rows(analysis: HpiAnalysis) -> list[ReportRow]:
    found, goal = analysis.findings, TARGET_CORRELATION
    chosen = "nothing fitted to the stored amplitudes but each channel's sign and a scale a kind"
    before, after = float(found.correlation_raw.min()), float(found.correlation.min())
    figure = 'demodulated and stored amplitudes, least |r| of a coil and kind of channel'
    return [
        ReportRow(
            NAME,
            f'{figure} (before: signs as sampled; after: modulus with sign)',
            before,
            after,
            '',
            goal,
            bool(after > goal),
            chosen,
        ),
        ReportRow(
            NAME,
            f'{figure}, in-phase part, noisy channel excluded',
            before,
            float(found.correlation_in_phase.min()),
            '',
            goal,
            bool(found.correlation_in_phase.min() > goal),
            chosen,
        ),
    ]


def _place_rows(analysis: HpiAnalysis) -> list[ReportRow]:
    digitised = analysis.data.digitised_m
    final = np.array([fit.places_m[0] for fit in analysis.final])
    vendor = distance_mm(analysis.data.vendor_m, digitised)
    plain = distance_mm(analysis.plain_m, digitised)
    rigid = distance_mm(final, digitised)
    moments = np.array([fit.moments[0] for fit in analysis.final])
    arms, left_out = arms_left_out(final, moments, digitised)
    with_arm = 1e3 * float(np.sqrt(np.mean(left_out**2)))
    figure = 'coils to digitised places, rms after rigid alignment'
    chosen = "leads: channels left out; array's errors: likelihood of the signals"
    return [
        ReportRow(
            NAME,
            f"{figure} (before: vendor's fit; after: lever arm along the coils' axes)",
            vendor,
            with_arm,
            'mm',
            TARGET_MM,
            bool(with_arm <= TARGET_MM),
            f'{chosen}; arm ({_span(1e3 * arms)} mm): the other three coils',
        ),
        ReportRow(
            NAME,
            f"{figure}, no digitised place used (before: vendor's fit)",
            vendor,
            rigid,
            'mm',
            TARGET_MM,
            bool(rigid <= TARGET_MM),
            chosen,
        ),
        ReportRow(
            NAME, f'{figure}, plain dipole', vendor, plain, 'mm', None, None, 'nothing chosen'
        ),
    ]


def _span(values: Array) -> str:
    return f'{values.min():.1f} to {values.max():.1f}'


def _channel_rows(analysis: HpiAnalysis) -> list[ReportRow]:
    held = analysis.held_out
    chosen_chain = np.array([held.chain[k, n] for k, n in enumerate(analysis.n_leads)])
    kinds = analysis.data.array.is_magnetometer
    chosen = 'number of dipoles of the leads: mean over the same six folds of channels'
    out = []
    for text, kind in (('magnetometers', kinds), ('gradiometers', ~kinds)):
        before = relative_error(analysis, held.plain, kind)
        after = relative_error(analysis, chosen_chain, kind)
        figure = f'held-out {text}, relative error'
        out.append(ReportRow(NAME, figure, before, after, '%', None, None, chosen))
    quiet = ~analysis.findings.noisy
    middle = [
        float(np.median(np.abs(p - analysis.findings.signals)[:, quiet] / held.spread[:, quiet]))
        for p in (held.chain[:, 0], chosen_chain)
    ]
    figure = 'held-out channels, median residual over its expected spread (before: no leads)'
    out.append(ReportRow(NAME, figure, middle[0], middle[1], '', None, None, chosen))
    return out


def tables(analysis: HpiAnalysis) -> str:
    """Return tables of wrong channels, candidates and places."""
    lines = [f'{NAME}: tones at {np.round(analysis.tones.frequencies_hz, 3)} Hz']
    lines += analysis.findings.text(analysis.data.array)
    lines.append('  dipoles of the lead (0, 1, ...): held-out loss, mean of six folds of channels')
    for k, n in enumerate(analysis.n_leads):
        losses = np.mean(analysis.held_out.loss[k], axis=1)
        text = ' '.join(f'{value:.3f}' for value in losses)
        lines.append(f'    coil {k}: {text}; chosen {n}')
    errors = analysis.chip_errors
    lines.append(
        f'  errors of single chips (largest likelihood): place {1e3 * errors.place_m:.1f} mm, '
        f'tilt {1e3 * errors.tilt_rad:.0f} mrad, gain {100 * errors.gain:.0f} %'
    )
    lines.append('  errors that all chips share, candidate: gain in log likelihood, value')
    for item in sorted(analysis.shared, key=lambda item: -item.gain):
        places = np.array([fit.places_m[0] for fit in item.fits])
        distance = distance_mm(places, analysis.data.digitised_m)
        value = f'{item.value:+.5f} +- {item.sigma:.5f} {UNITS.get(item.name, "")}'
        lines.append(
            f'    {item.name:<20} {item.gain:+7.2f} (price {item.price:.2f})  {value}; '
            f'coils then {distance:.2f} mm off'
            f'{"  <- accepted" if item.name == analysis.accepted else ""}'
        )
    places = np.array([fit.places_m[0] for fit in analysis.final])
    axes = outward(places, np.array([fit.moments[0] for fit in analysis.final]))
    order = order_of(places, analysis.data.digitised_m)
    arm = best_arm(places[order], axes[order], analysis.data.digitised_m)
    lines.append(
        f'  lever arm: digitised points lie {1e3 * arm:.2f} mm inside the magnetic centres (all '
        'four coils); the signals alone cannot tell it from an array that sits further in'
    )
    for k, fit in enumerate(analysis.final):
        lines.append(
            f'  coil {k} at {np.round(1e3 * fit.places_m[0], 2)} mm +- {1e3 * fit.sigma_m:.2f}, '
            f'{1e9 * np.linalg.norm(fit.moments[0]):.2f} nA m^2; '
            f'residual over spread {fit.power**0.5:.2f}'
        )
        for place, moment in zip(fit.places_m[1:], fit.moments[1:], strict=True):
            lines.append(
                f'    lead: {np.round(1e3 * place, 0)} mm, {1e9 * np.linalg.norm(moment):.3f} '
                'nA m^2'
            )
    return '\n'.join(lines)
