"""Imports four coils on a head before 306 SQUID channels, and has their recipe.

The helmet is a body of 306 channels, two thirds of them gradiometers, which rests; the coils are
emitters of unknown place. The one epoch of raw samples is demodulated in two halves, a frame each.
Nothing says which way round a channel is, or where a coil is: the coils as digitised, as the
vendor's own software fits them, and the signs of the stored amplitudes are only compared with.

The data (github mne-tools/mne-python, BSD-3) are read where they lie.
"""

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.apps.lab.measured import recipe
from anser_ros.arrays import Array, Booleans, ComplexArray
from anser_ros.errors import FitError
from anser_ros.wire.setup import Coil, Emitter, SensorSpec, Setup

NAME, BODY = 'hpi_coils', 'helmet'
TONES_HZ = (70.0, 72.0, 74.0, 76.0)
"""Drive frequencies of the coils, Hz."""
DRIFT_ORDER = 2
"""Degree of the polynomial that follows a channel's drift within a frame."""
FRAMES = 2
"""Frames of the epoch: half a second each, in which the tones are just apart."""
HEIGHT_M = 0.2
"""Height of the helmet's origin in fg, m, so that all channels are above z = 0."""
VOLUME = ((-0.1, -0.1, 0.1), (0.1, 0.1, 0.3))
"""Where the helmet may be, m."""
STATED = {'flux_noise_t': 1e-14, 'optical_position_m': 1e-6, 'optical_rotation_rad': 1e-6}
"""Noise of an amplitude; the helmet defines the frame, so that its pose has no error."""
TARGET_MM = 1.84
"""What the coils' distance from the digitised places should not exceed."""
SPECIAL_MM, SPECIAL_INVERTED = 1.84, 45.0
"""What code that was written for these data alone reached (docs/results/README.md)."""


@dataclass(frozen=True)
class Epoch:
    """Holds the file in SI units: S channels, Q points each, T samples, 4 coils."""

    names: tuple[str, ...]  # length S
    is_magnetometer: Booleans  # (S,)
    # (S, Q, 3), (S, Q, 3), (S, Q)
    points_m: Array
    normals: Array
    weights: Array
    samples: Array  # (S, T)
    rate_hz: float
    stored: Array  # (4, S), amplitudes as stored with the data, signs included
    # (4, 3), places as digitised by hand, and as the vendor's software fits them
    digitised_m: Array
    vendor_m: Array

    @property
    def base_m(self) -> Array:
        """Return the distance of the coils of each gradiometer, m; 1 of a magnetometer."""
        half = np.abs(self.weights).sum(axis=1) / 2.0
        return np.where(self.is_magnetometer, 1.0, 1.0 / half)


def load(folder: Path) -> Epoch:
    """Read the file ``hpi_coils.npz``; raises `FitError` when it, or an array, is missing."""
    path = recipe.existing(folder / 'hpi_coils.npz')
    with np.load(path) as part:
        try:
            return Epoch(
                tuple(str(name).replace('MEG ', 'c') for name in part['ch_names']),
                part['is_mag'], part['int_pos'], part['int_normal'], part['int_weight'],
                part['epoch_adc'].astype(float), float(part['epoch_sfreq']), part['slopes'],
                part['polhemus_head'], part['neuromag_fit_dev'],
            )  # fmt: skip
        except (KeyError, ValueError) as error:
            raise FitError(f'{path.name} is not the expected set of arrays: {error}') from error


def demodulated(samples: Array, rate_hz: float, reference: Booleans) -> Array:
    """Return phasors (S, 4), complex, of a stretch of samples, in their unit.

    Tones and drift are fitted together; a tone's phase is that of the reference channels, since
    the current of the coil was not recorded. Tones 2 Hz apart need half a second: a window of
    `signals.demodulation`, for tools that move, is 50 ms long at most.
    """
    age = (np.arange(samples.shape[1]) - (samples.shape[1] - 1) / 2.0) / rate_hz
    angle = 2.0 * np.pi * np.outer(age, TONES_HZ)
    drift = np.vander(age / age.max(), DRIFT_ORDER + 1)
    design = np.concatenate([np.cos(angle), -np.sin(angle), drift], axis=1)
    found = np.linalg.lstsq(design, samples.T, rcond=None)[0]
    count = len(TONES_HZ)
    phasor = found[:count] + 1j * found[count : 2 * count]
    phase = 0.5 * np.angle(np.sum(phasor[:, reference] ** 2, axis=1))
    return np.asarray((phasor * np.exp(-1j * phase)[:, None]).T)


def fluxes(epoch: Epoch) -> ComplexArray:
    """Return fluxes (FRAMES, S, 4), T; those of a gradiometer are differences of its coils'."""
    kinds = epoch.is_magnetometer, ~epoch.is_magnetometer
    frames = np.stack(
        [
            demodulated(part, epoch.rate_hz, kinds[0])
            for part in np.array_split(epoch.samples, FRAMES, axis=1)
        ]
    )
    # The unit of a count is not stored; sizes of the stored amplitudes tell it, kind by kind.
    size = np.sqrt((np.abs(frames.mean(axis=0)) ** 2).sum(axis=1))
    unit = np.sqrt((epoch.stored**2).sum(axis=0)) / size
    for kind in kinds:
        unit[kind] = np.median(unit[kind])
    return np.asarray(frames * (unit * epoch.base_m)[:, None])


def setup_of(epoch: Epoch) -> Setup:
    """Return a setup of four emitters, all about the middle, and a channel for each sensor."""
    specs = []
    for row, name in enumerate(epoch.names):
        used = epoch.weights[row] != 0.0
        points, weight = epoch.points_m[row][used], epoch.weights[row][used] * epoch.base_m[row]
        centre = points.mean(axis=0)
        axis = epoch.normals[row][used][0] / np.linalg.norm(epoch.normals[row][used][0])
        windings = tuple(
            (*recipe.vector(point - centre), float(w))
            for point, w in zip(points, weight, strict=True)
        )
        spec = SensorSpec(
            row, f'{BODY}/{name}', BODY, recipe.vector(centre), recipe.vector(axis), 0.0, windings
        )
        specs.append(spec)
    middle = recipe.vector(np.array([0.0, 0.0, HEIGHT_M]))
    coils = tuple(Coil(f'hpi{k}', middle, 0.0, tone) for k, tone in enumerate(TONES_HZ))
    rate = FRAMES * epoch.rate_hz / epoch.samples.shape[1]
    return Setup('fg', rate, Emitter('head_coil', {}, coils), tuple(specs), VOLUME, STATED)


def write_sessions(folder: Path, into: Path) -> list[Path]:
    """Write the epoch as a session; return its file. Raises `BagError` when it exists."""
    epoch, path = load(folder), into / f'{NAME}.mcap'
    pose = np.tile([0.0, 0.0, HEIGHT_M], (FRAMES, 1)), np.tile([0.0, 0.0, 0.0, 1.0], (FRAMES, 1))
    recipe.write_frames(path, setup_of(epoch), fluxes(epoch), {BODY: pose})
    return [path]


def distance_mm(found: Array, digitised: Array) -> float:
    """Return the rms distance, mm, of places (4, 3), in any order, after the best rigid move."""

    def apart(order: tuple[int, ...]) -> float:
        moved, wanted = found[list(order)], digitised - digitised.mean(axis=0)
        moved = moved - moved.mean(axis=0)
        return float(Rotation.align_vectors(wanted, moved)[1])

    least = min(apart(order) for order in itertools.permutations(range(len(found))))
    return float(1e3 * least / len(found) ** 0.5)


def inverted(epoch: Epoch) -> Booleans:
    """Return which channels (S,) have the other sign than their stored amplitudes, by all tones.

    Tones are matched with stored coils by the sizes of their amplitudes.
    """
    found = fluxes(epoch).mean(axis=0).real.T
    chosen = epoch.is_magnetometer
    alike = np.array(
        [[np.corrcoef(np.abs(a[chosen]), np.abs(b[chosen]))[0, 1] for b in found]
         for a in epoch.stored]
    )  # fmt: skip
    own = found[np.argmax(alike, axis=1)]
    own = own * np.sign(np.sum((own * epoch.stored)[:, chosen], axis=1))[:, None]
    return np.asarray(np.sum(own * epoch.stored, axis=0) < 0.0)


def rows(folder: Path, bags: list[Path], out: Path) -> list[recipe.ReportRow]:
    """Return how the coils lie, and how many inverted channels are named."""
    epoch = load(folder)
    places, named, errors = [], [], []
    for kind in ('plain', 'full'):
        document = recipe.ran(out / kind, 'calibration.json')
        found = np.array([source['position_m'] for source in document['sources']])
        places.append(distance_mm(found, epoch.digitised_m))
        errors.append(1e12 * recipe.figure(document, 'heldout_flux_rmse_t'))
        effects = [e for e in document['effects'] if e['name'] == 'sensor_polarity']
        channels = {c for effect in effects for c in effect['parameters']['channels']}
        named.append(np.isin(np.arange(len(epoch.names)), list(channels)))
    truth, vendor = inverted(epoch), distance_mm(epoch.vendor_m, epoch.digitised_m)
    met = places[1] <= TARGET_MM
    distance = 'coils to digitised places, rms after rigid alignment'
    chosen = 'the signals alone'
    return [
        *(
            recipe.ReportRow(
                NAME, f'{distance} (before: {words})', before, places[1], 'mm', chosen,
                TARGET_MM, met, SPECIAL_MM,
            )
            for words, before in (("vendor's fit", vendor), ('sensors as stated', places[0]))
        ),
        recipe.ReportRow(
            NAME, f'of {truth.sum()} inverted channels, named', float((truth & named[0]).sum()),
            float((truth & named[1]).sum()), '', chosen, float(truth.sum()),
            bool((named[1] | ~truth).all()), SPECIAL_INVERTED,
        ),
        recipe.ReportRow(
            NAME, 'a fifth of the channels predicted by the others, RMSE', errors[0], errors[1],
            'pT', 'field and signs on the others',
        ),
        recipe.ReportRow(
            NAME, 'channels falsely named inverted', float((named[0] & ~truth).sum()),
            float((named[1] & ~truth).sum()), '', chosen, 0.0, bool((truth | ~named[1]).all()),
        ),
    ]  # fmt: skip


RECIPE = recipe.Recipe(NAME, write_sessions, recipe.calibrations, rows)
