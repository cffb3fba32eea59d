"""What is wrong with channels: gains, delays, crosstalk, pickup, amplifiers that saturate.

An amplifier that saturates sees the sum of all tones, v(t), and gives fs tanh(v / fs), or its
first two terms v - v^3 / (3 fs^2). The cube reduces tone k by ``(S / 2 - |V_k|^2 / 4) / fs^2``,
where S is the sum of the squared amplitudes of all tones, of independent phases: the other tones
count twice. What it sees is either the flux, as behind an integrator, or the voltage that it
induces, in which a tone counts in proportion to its frequency.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations

import numpy as np

from anser_ros.arrays import Array, ComplexArray, Integers, complex_of, pairs_of
from anser_ros.effects.base import Apparatus, View
from anser_ros.effects.effect import Effect, Remedy, Site, Term, sigmas
from anser_ros.errors import ModelFileError
from anser_ros.field.model import EffectRecord

PHASE_ALONE = 0.3
"""A gain whose modulus is off by less than this share of its phase is a phase: drivers and cables
turn currents by milliradians and leave their size. Larger hides a gain beside a phase."""


class ComplexGain(Effect[Term]):
    """Theta is the real and imaginary part of (gain - 1) of what the site names."""

    plausible = {'gain': (0.2, 3.0), 'phase_deg': (-60.0, 60.0)}
    remedy = Remedy.FLUX
    typical = 0.3  # gains are within some ten percent of one

    def rivals(self, term: Term, other: Term) -> bool:
        """Rival phases of emitters where the modulus is hardly another one.

        If all phases are off, what is left of them last is also a phase of the channels.
        """
        gain = 1 + complex(*term.theta)
        phase = abs(float(np.angle(gain)))
        return bool(other.effect.gregarious) and abs(abs(gain) - 1) < PHASE_ALONE * phase

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Record modulus and argument of the gain, each with its deviation along its own way."""
        gain = 1 + complex(*term.theta)
        along = np.array([gain.real, gain.imag]) / abs(gain)
        across = np.array([-along[1], along[0]]) / abs(gain)
        sigma_gain, sigma_rad = (np.sqrt(way @ covariance @ way) for way in (along, across))
        figures = {'gain': abs(gain), 'phase_deg': float(np.degrees(np.angle(gain)))}
        deviations = {'gain': float(sigma_gain), 'phase_deg': float(np.degrees(sigma_rad))}
        return EffectRecord(self.name, {**term.recorded_site, **figures}, deviations)

    def term(self, record: EffectRecord) -> Term:
        """Return the term of a gain and a phase; a record without a phase has none."""
        phase = np.radians(float(record.parameters.get('phase_deg', 0.0)))
        gain = float(record.needed('gain')) * np.exp(1j * phase)
        return Term(self, self.site_of(record), np.array([gain.real - 1, gain.imag]))


class GainOfChannels(ComplexGain):
    """Is a complex gain of the channels that a term's site names."""

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        rows = np.isin(view.sensors.channel, term.channels)
        if not rows.any():
            return None
        out = view.columns(2)
        own = view.linear[:, rows] / (1 + complex(*term.theta))
        out[:, rows] = np.stack([own, 1j * own], axis=-1)
        return out

    def channel_matrix(self, term: Term, channels: Integers) -> ComplexArray:
        own = np.isin(channels, term.channels)
        return np.diag(np.where(own, 1 + complex(*term.theta), 1.0))


class SensorGain(GainOfChannels):
    """Is the complex gain of one channel."""

    name = 'sensor_gain'
    summary = "one sensor's gain is off"
    units = {'channel': '1', 'gain': '1', 'phase_deg': 'deg'}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        return [Term(self, {'channel': c}, np.zeros(2)) for c in apparatus.channels]


class ToolGain(GainOfChannels):
    """Is the complex gain of all of a tool's channels."""

    name = 'tool_gain'
    summary = "the gain that all of a tool's sensors share is off"
    units = {'channels': '1', 'gain': '1', 'phase_deg': 'deg'}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        tools = [tuple(table.channel.tolist()) for table in apparatus.tools if len(table) > 1]
        return [Term(self, {'channels': channels}, np.zeros(2)) for channels in tools]


class CommonGain(Effect[Term]):
    """Theta is (gain - 1) of all channels, those of the references too."""

    name = 'common_gain'
    summary = 'the gain of all channels has changed alike'
    units = {'gain': '1'}
    plausible = {'gain': (0.5, 2.0)}
    remedy = Remedy.FLUX
    typical = 0.1  # gains of a whole system stay within some percent

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        return [Term(self, {}, np.zeros(1))]

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        return np.asarray(view.linear[..., None] / (1 + term.theta[0]))

    def channel_matrix(self, term: Term, channels: Integers) -> ComplexArray:
        return np.asarray((1 + term.theta[0]) * np.eye(channels.size, dtype=complex))

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        gain, sigma = 1 + float(term.theta[0]), float(sigmas(covariance)[0])
        return EffectRecord(self.name, {'gain': gain}, {'gain': sigma})

    def term(self, record: EffectRecord) -> Term:
        return Term(self, {}, np.array([float(record.needed('gain')) - 1]))


DELAY_UNIT = 1e-6
"""theta counts microseconds."""


class PhaseDelay(Effect[Term]):
    """Theta is the delay d, us: a phasor at w becomes exp(-j w d) times itself."""

    name = 'phase_delay'
    summary = 'a common acquisition delay turns all phasors'
    units = {'delay_s': 's'}
    plausible = {'delay_s': (-5e-5, 5e-5)}
    remedy = Remedy.FLUX
    typical = 5.0  # delays are some microseconds
    recorded = {'delay_s': (1, DELAY_UNIT)}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        return [Term(self, {}, np.zeros(1))]

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return minus j omega times the flux, for a microsecond of delay."""
        return np.asarray((-1j * DELAY_UNIT * view.omega * view.linear)[..., None])

    def emitter_matrix(self, term: Term, time: Array, omega: Array) -> ComplexArray:
        return np.diag(np.exp(-1j * omega * term.theta[0] * DELAY_UNIT))[None]


MOST_PAIRS = 300
"""Pairs of channels that are tried at most, those of the lowest numbers: all of 25 channels."""


class ChannelCrosstalk(Effect[Term]):
    """Theta is the off-diagonal entries of M, row by row; readings are M times the true ones."""

    name = 'channel_crosstalk'
    summary = 'channels leak into each other'
    units = {'channels': '1', 'matrix': '1'}
    plausible = {'matrix': (-0.5, 0.5)}
    remedy = Remedy.FLUX
    typical = 0.1  # leaks amount to some percent

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        groups = [g for g in apparatus.clusters() if len(g) <= 4]
        inside = {pair for g in groups if len(g) > 2 for pair in combinations(sorted(g), 2)}
        pairs = [p for p in combinations(sorted(apparatus.tool_channels), 2) if p not in inside]
        groups += [p for p in pairs if p not in groups][:MOST_PAIRS]
        return [Term(self, {'channels': g}, np.zeros(len(g) * (len(g) - 1))) for g in groups]

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return the other channels' fluxes, which leak into each channel."""
        rows = [view.row(c) for c in term.site['channels']]
        if all(row is None for row in rows):
            return None
        size = len(rows)
        known = [i for i, row in enumerate(rows) if row is not None]
        here = np.array([row for row in rows if row is not None])
        matrix = self._matrix(term)[np.ix_(known, known)]
        own = np.linalg.solve(matrix, view.linear[:, here])
        out = view.columns(term.theta.size)
        for column, (i, j) in enumerate(permutations(range(size), 2)):
            if i in known and j in known:
                out[:, rows[i], :, column] = own[:, known.index(j)]
        return out

    def _matrix(self, term: Term) -> Array:
        size = len(term.site['channels'])
        matrix = np.eye(size)
        for value, place in zip(term.theta, permutations(range(size), 2), strict=True):
            matrix[place] = value
        return matrix

    def channel_matrix(self, term: Term, channels: Integers) -> ComplexArray:
        """Mix the cluster's channels; one that is not there leaks nothing."""
        matrix, block = np.eye(channels.size, dtype=complex), self._matrix(term)
        place = {int(c): row for row, c in enumerate(channels)}
        for i, to in enumerate(term.site['channels']):
            for j, source in enumerate(term.site['channels']):
                if to in place and source in place:
                    matrix[place[to], place[source]] = block[i, j]
        return matrix

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        matrix = self._matrix(term)
        sigma = self._matrix(term.with_theta(sigmas(covariance))) - np.eye(len(matrix))
        parameters = {**term.recorded_site, 'matrix': matrix.tolist()}
        return EffectRecord(self.name, parameters, {'matrix': sigma.tolist()})

    def possible(self, record: EffectRecord) -> bool:
        leaks = np.asarray(record.parameters['matrix'], dtype=np.float64)
        leaks = leaks - np.eye(len(leaks))
        return super().possible(replace(record, parameters={'matrix': leaks}))

    def term(self, record: EffectRecord) -> Term:
        """Read the leaks from a record's matrix, whose diagonal is scaled to one."""
        site = self.site_of(record)
        count = len(site['channels'])
        matrix = np.asarray(record.needed('matrix'), dtype=np.float64)
        if matrix.shape != (count, count):
            raise ModelFileError(
                f'model: channel_crosstalk of {count} channels has a matrix {matrix.shape}'
            )
        matrix = matrix / np.diag(matrix)[:, None]
        return Term(self, site, matrix[~np.eye(count, dtype=bool)])


PICKUP_UNIT = 1e-9
"""theta counts nanotesla."""


class Pickup(Effect[Term]):
    """Theta is the real, then the imaginary parts of one channel's phasors, nT."""

    name = 'pickup'
    summary = 'a constant phasor is added to a channel'
    units = {'channel': '1', 'phasor_t': 'T (re, im of every emitter)', 'rms_t': 'T'}
    plausible = {'rms_t': (0.0, 1e-6)}
    remedy = Remedy.FLUX
    typical = 30.0  # phasors are some tens of nanotesla

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        return self._at(apparatus.tool_channels, apparatus)

    def _at(self, channels: Sequence[int], apparatus: Apparatus) -> list[Term]:
        return [Term(self, {'channel': c}, np.zeros(2 * apparatus.emitters)) for c in channels]

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return a constant column for either part of every emitter's phasor."""
        row = view.row(term.site['channel'])
        if row is None:
            return None
        emitters = view.omega.size
        out, every = view.columns(2 * emitters), np.arange(emitters)
        out[:, row, every, every] = PICKUP_UNIT
        out[:, row, every, emitters + every] = 1j * PICKUP_UNIT
        return out

    def offset(self, term: Term, channels: Integers, emitters: int) -> ComplexArray:
        out = np.zeros((channels.size, emitters), dtype=complex)
        out[channels == term.site['channel']] = complex_of(term.theta * PICKUP_UNIT)
        return out

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        phasor = complex_of(term.theta * PICKUP_UNIT)
        sigma = sigmas(covariance).reshape(2, -1) * PICKUP_UNIT
        rms = float(np.sqrt(np.mean(np.abs(phasor) ** 2)))
        return EffectRecord(
            self.name,
            {**term.recorded_site, 'phasor_t': pairs_of(phasor), 'rms_t': rms},
            {'phasor_t': sigma.T.tolist(), 'rms_t': float(np.sqrt(np.mean(sigma**2)))},
        )

    def term(self, record: EffectRecord) -> Term:
        parts = np.asarray(record.needed('phasor_t'), dtype=np.float64)
        return Term(self, self.site_of(record), parts.T.ravel() / PICKUP_UNIT)


ONE_EMITTER = 0.9
"""Share of a reference's changed power from which it is one emitter's: what moves a reference, or
disturbs it, shows in others too."""


class ReferenceChanged(Pickup):
    """Acts as `Pickup` on a reference sensor, which rests: any lasting change is a constant."""

    name = 'reference_changed'
    summary = (
        "a reference sensor's reading changed permanently: it was moved or turned, or picks up "
        'interference'
    )

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        ours = apparatus.tool_channels
        return self._at([c for c in apparatus.channels if c not in ours], apparatus)

    def belongs(self, term: Term, other: Term) -> bool:
        """Belong to an emitter that moved, if hardly another one's readings have changed."""
        power = np.abs(complex_of(term.theta)) ** 2
        own = power[other.site['coil']] if other.effect.gradient_error else 0.0
        return bool(own > ONE_EMITTER * power.sum())


SATURATION_UNIT = 1e12
"""theta counts 1/fs^2 in units of 1/uT^2."""
POINTS, GENERATOR = 1021, 331
"""Size and generator of the lattice of phases (Korobov)."""
SHAPES = ('cubic', 'tanh')
FLUX, VOLTAGE = 'flux', 'voltage'
"""What the amplifier may see."""


def third_order(flux: ComplexArray) -> ComplexArray:
    """Return what one unit of 1/fs^2 adds to fluxes (..., K), to third order."""
    squared = np.abs(flux) ** 2
    total = squared.sum(axis=-1, keepdims=True)
    return np.asarray(-(0.5 * total - 0.25 * squared) * flux)


def compressed(flux: ComplexArray, per_full_scale_squared: float, shape: str) -> ComplexArray:
    """Return amplitudes (..., K) behind the amplifier, averaged over the phases of the tones.

    The third order is exact; what lies above it is an average over a fixed lattice of phases.
    """
    third = flux + per_full_scale_squared * third_order(flux)
    if shape == 'cubic' or per_full_scale_squared <= 0.0:
        return np.asarray(third)
    full_scale = 1 / np.sqrt(per_full_scale_squared)
    steps = np.array([pow(GENERATOR, k, POINTS) for k in range(flux.shape[-1])])
    phase = 2 * np.pi * ((np.arange(POINTS)[:, None] * steps) % POINTS) / POINTS
    turn = np.exp(1j * phase)
    x = ((flux / full_scale) @ turn.T).real
    rest = full_scale * (np.tanh(x) - x + x**3 / 3)
    return np.asarray(third + (rest @ turn.conj()) * (2 / POINTS))


@dataclass(frozen=True, kw_only=True)
class SaturationTerm(Term):
    """Holds the saturation of one channel."""

    weights: Array  # (K,), what each emitter's tone counts in what the amplifier sees


class Saturation(Effect[SaturationTerm]):
    """Theta is one over the squared full scale, in 1/uT^2."""

    name = 'saturation'
    summary = 'a channel compresses large signals'
    units = {
        'channel': '1', 'full_scale_t': 'T', 'shape': 'name of the curve',
        'sees': 'flux or voltage', 'tone_weights': '1',
    }  # fmt: skip
    plausible = {'full_scale_t': (1e-8, 1e-3)}
    remedy = Remedy.FLUX
    typical = 3.0  # full scales down to the size of the signals
    inexact = 0.2  # the true curve is none of those that are tried (`docs/log.md`)

    def candidates(self, apparatus: Apparatus) -> Sequence[SaturationTerm]:
        """Try every channel of a tool; references don't see signals of different size."""
        weights = {FLUX: np.ones(apparatus.emitters)}
        voltage = apparatus.omega / apparatus.omega.mean()
        if not np.allclose(voltage, 1.0):
            weights[VOLTAGE] = voltage
        return [
            SaturationTerm(
                self, {'channel': c, 'shape': shape, 'sees': sees}, np.zeros(1), weights=w
            )
            for c in apparatus.tool_channels
            for shape in SHAPES
            for sees, w in weights.items()
        ]

    def covers(self, term: SaturationTerm, candidate: Term) -> bool:
        """Return whether the term is on the candidate's channel, which has one curve only."""
        return candidate.effect is self and candidate.channels == term.channels

    def columns(self, term: SaturationTerm, view: View) -> ComplexArray | None:
        """Return the third-order loss, or differences along the whole curve."""
        row = view.row(term.site['channel'])
        if row is None:
            return None
        weights = term.weights
        out, own = view.columns(1), view.linear[:, row] * weights
        if term.theta[0] <= 0:
            slope = SATURATION_UNIT * third_order(own)
        else:
            step, shape = 0.01 * term.theta[0], term.site['shape']
            more, less = (
                compressed(own, SATURATION_UNIT * (term.theta[0] + way), shape)
                for way in (step, -step)
            )
            slope = (more - less) / (2 * step)
        out[:, row, :, 0] = slope / weights
        return out

    def compress(
        self, term: SaturationTerm, channels: Integers, flux: ComplexArray
    ) -> ComplexArray:
        out, weights = flux.copy(), term.weights
        for row in np.flatnonzero(channels == term.site['channel']):
            seen = flux[:, row] * weights
            passed = compressed(seen, SATURATION_UNIT * float(term.theta[0]), term.site['shape'])
            out[:, row] = passed / weights
        return out

    def record(self, term: SaturationTerm, covariance: Array) -> EffectRecord:
        value = max(float(term.theta[0]), 1e-9)
        full_scale = 1 / np.sqrt(SATURATION_UNIT * value)
        relative = 0.5 * float(np.sqrt(covariance[0, 0])) / value
        parameters = {
            **term.recorded_site,
            'full_scale_t': float(full_scale),
            'tone_weights': term.weights.tolist(),
        }
        return EffectRecord(self.name, parameters, {'full_scale_t': float(full_scale * relative)})

    def term(self, record: EffectRecord) -> SaturationTerm:
        full_scale = float(record.needed('full_scale_t'))
        site: Site = {
            **self.site_of(record),
            'shape': str(record.parameters.get('shape', SHAPES[0])),
            'sees': str(record.parameters.get('sees', FLUX)),
        }
        weights = np.asarray(record.parameters.get('tone_weights', 1.0), dtype=np.float64)
        theta = np.array([1 / (SATURATION_UNIT * full_scale**2)])
        return SaturationTerm(self, site, theta, weights=weights)


EFFECTS = (
    SensorGain(), ToolGain(), CommonGain(), PhaseDelay(), ChannelCrosstalk(), Pickup(),
    ReferenceChanged(), Saturation(),
)  # fmt: skip
