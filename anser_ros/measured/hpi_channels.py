"""Finds which SQUID channels are wrong, and how: signs, noise, and what the stored numbers are."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import FitError
from anser_ros.measured.hpi_demodulation import Tones
from anser_ros.measured.squid_array import SquidArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

NOISY = 5.0
"""Times the median noise of its kind beyond which a channel is called noisy."""


@dataclass(frozen=True)
class ChannelFindings:
    """Holds the epoch beside the stored amplitudes.

    Attributes
    ----------
    signals : ndarray, shape (K, S)
        In-phase amplitudes in the stored unit and sign, coils in the stored order.
    noise : ndarray, shape (S,)
        Standard deviation of an amplitude.
    inverted, noisy : ndarray of bool, shape (S,)
        Samples of the other sign than the stored amplitudes; noise far beyond that of its kind.
    sign_by_chance : ndarray of bool, shape (K, S)
        The stored sign is not that of the in-phase part.
    tone_of : ndarray of int, shape (K,)
        Tone of each stored coil.
    correlation_raw, correlation, correlation_in_phase : ndarray, shape (K, 2)
        |r| with the stored amplitudes, magnetometers and gradiometers: as sampled; modulus against
        modulus; in-phase part with the channels' signs, noisy channels excluded.
    scale : ndarray, shape (2,)
        Stored unit over the samples' unit of each kind.
    noise_ratio : ndarray, shape (S,)
        Noise over the median of its kind.
    """

    signals: Array
    noise: Array
    inverted: Mask
    noisy: Mask
    sign_by_chance: Mask
    tone_of: NDArray[np.int64]
    correlation_raw: Array
    correlation: Array
    correlation_in_phase: Array
    scale: Array
    noise_ratio: Array

    def text(self, array: SquidArray) -> list[str]:
        """Return the lines of the report."""
        names = np.array(array.names)
        inverted = names[self.inverted]
        endings = sorted({name[-1] for name in inverted})
        noisy = [
            f'{name} ({ratio:.0f} times)'
            for name, ratio in zip(names[self.noisy], self.noise_ratio[self.noisy], strict=True)
        ]
        return [
            f'  {len(inverted)} channels are sampled with inverted sign, all named ...'
            f'{" or ".join(endings)}: {", ".join(n.replace("MEG ", "") for n in inverted)}',
            f'  noise far above that of its kind: {", ".join(noisy) or "none"}',
            f'  stored amplitudes are moduli with a sign: |r| of the moduli '
            f'{self.correlation.min():.8f}; {int(self.sign_by_chance.sum())} of '
            f'{self.signals.size} signs are not those of the in-phase part (amplitudes in the '
            'noise)',
        ]


def _correlation(one: Array, other: Array) -> float:
    return abs(float(np.corrcoef(one, other)[0, 1]))


def examine(array: SquidArray, tones: Tones, stored: Array) -> ChannelFindings:
    """Compare the demodulated epoch with stored amplitudes (K, S).

    Raises
    ------
    FitError
        When the number of tones is not that of the stored coils.
    """
    phasors = tones.phasors
    if len(phasors) != len(stored):
        raise FitError(f'{len(phasors)} tones in the epoch, {len(stored)} stored coils')
    kinds = (array.is_magnetometer, ~array.is_magnetometer)
    match = np.array(
        [
            [_correlation(np.abs(phasor[kinds[0]]), np.abs(row[kinds[0]])) for phasor in phasors]
            for row in stored
        ]
    )
    tone_of = np.argmax(match, axis=1)
    if len(set(tone_of.tolist())) != len(stored):
        raise FitError('two stored coils resemble the same tone of the epoch')
    own = phasors[tone_of]
    # A tone's common sign is free; the magnetometers fix it.
    flip = np.sign(np.sum(own.real[:, kinds[0]] * stored[:, kinds[0]], axis=1))
    own = own * flip[:, None]
    agreement = np.sum(own.real * stored, axis=0)
    inverted = agreement < 0.0
    scale = np.array(
        [
            np.median(np.sum(np.abs(own * stored), 0)[k] / np.sum(np.abs(own) ** 2, 0)[k])
            for k in kinds
        ]
    )
    factor = np.where(kinds[0], scale[0], scale[1]) * np.where(inverted, -1.0, 1.0)
    signals, noise = own.real * factor, tones.noise * np.abs(factor)
    ratio = np.empty(len(noise))
    for kind in kinds:
        ratio[kind] = noise[kind] / np.median(noise[kind])
    quiet = ratio < NOISY
    rows = range(len(stored))
    return ChannelFindings(
        signals,
        noise,
        inverted,
        ~quiet,
        np.sign(signals) != np.sign(stored),
        tone_of,
        np.array([[_correlation(own[r].real[k], stored[r][k]) for k in kinds] for r in rows]),
        np.array(
            [[_correlation(np.abs(own[r][k]), np.abs(stored[r][k])) for k in kinds] for r in rows]
        ),
        np.array(
            [
                [_correlation(signals[r][k & quiet], stored[r][k & quiet]) for k in kinds]
                for r in rows
            ]
        ),
        scale,
        ratio,
    )
