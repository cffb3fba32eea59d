"""Undoes a model's effects on what is measured: live in the tracker and node, and offline.

The forward chain is ``flux = compress(C T (field) + offset)`` with C mixing channels and T mixing
emitters; it is undone from the outside in. Effects on the field are in the model's dipoles
already, and effects that cannot be corrected are skipped.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import Effect, Remedy, Term
from anser_ros.effects.prediction import true_track
from anser_ros.effects.registry import effect_named
from anser_ros.errors import ModelFileError
from anser_ros.field.model import EffectRecord
from anser_ros.physics.pose_track import PoseTrack
from anser_ros.physics.sensor import SensorTable

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

DECOMPRESSION_STEPS = 12
"""Most steps of the fixed point that undoes a compression. Each leaves of the error about the
share that the compression takes of a change of the signal; the bound keeps a hopeless one from
looping."""

LIVE = (Remedy.FLUX, Remedy.SENSORS)
"""Remedies of effects that a tracker undoes; those of the field are in the model's dipoles."""


def drifts(record: EffectRecord) -> bool:
    """Return whether no session repeats a course; raises `ModelFileError` on an unknown effect."""
    return effect_named(record.name).drifts


def needs_correction(record: EffectRecord) -> bool:
    """Return whether the dipoles lack an effect; raises `ModelFileError` on an unknown one."""
    return effect_named(record.name).remedy in LIVE


def _term(effect: Effect[Any], record: EffectRecord) -> Term:
    """The term of a record from a file, where anything may stand as a parameter."""
    try:
        with np.errstate(invalid='raise', divide='raise'):
            term: Term = effect.term(record)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise ModelFileError(
            f'effect {record.name}: its parameters are malformed ({type(error).__name__}: {error})'
        ) from error
    if not np.isfinite(np.asarray(term.theta, dtype=np.float64)).all():
        raise ModelFileError(f'effect {record.name}: its parameters are not finite')
    return term


@dataclass(frozen=True)
class Correction:
    """Makes the corrections that a model's effect records ask for."""

    terms: tuple[Term, ...]
    surveyed: SensorTable  # Sensors as the setup has them
    omega: Array  # (K,)

    @staticmethod
    def of(
        records: Sequence[EffectRecord], sensors: SensorTable, frequencies: Sequence[float]
    ) -> 'Correction':
        """Make the corrections of a model's records; raises `ModelFileError` on an unknown one."""
        named = [(effect_named(record.name), record) for record in records]
        undone = [pair for pair in named if pair[0].remedy in (*LIVE, Remedy.OPTICAL)]
        omega = 2 * np.pi * np.asarray(frequencies, dtype=np.float64)
        return Correction(tuple(_term(*pair) for pair in undone), sensors, omega)

    def _with(self, remedy: Remedy) -> list[Term]:
        return [term for term in self.terms if term.effect.remedy is remedy]

    @property
    def changes_flux(self) -> bool:
        """Return whether any term makes `flux` change the measured flux."""
        return bool(self._with(Remedy.FLUX))

    @property
    def drifting(self) -> tuple[str, ...]:
        """Return the effects that only references, or a recorded course, can correct."""
        return tuple(term.label for term in self.terms if term.effect.drifts)

    @property
    def corrected(self) -> tuple[str, ...]:
        """Return name and site of every effect that is undone, except those that drift."""
        return tuple(term.label for term in self.terms if not term.effect.drifts)

    def sensors(self, table: SensorTable | None = None) -> SensorTable:
        """Return the sensors (by default those given at the start) as they truly are."""
        out = self.surveyed if table is None else table
        for term in self._with(Remedy.SENSORS):
            out = term.effect.table(term, out)
        return out

    def gain_changes(self) -> Array | None:
        """Return changes of gains since the model was made that sensors may share, shape (G, S).

        Relative, one standard deviation each; None if no effect contains any.
        """
        every = (term.effect.gain_changes(term, self.surveyed) for term in self.terms)
        known = [changes for changes in every if changes is not None]
        return np.concatenate(known) if known else None

    def optical(self, track: PoseTrack) -> PoseTrack:
        """Return an optical track on the fluxes' clock and in fg."""
        return true_track(track, self._with(Remedy.OPTICAL))

    def flux(
        self, time: float, channels: NDArray[np.generic], flux: ComplexArray, *,
        recorded: bool = False,
    ) -> ComplexArray:  # fmt: skip
        """Return a frame's fluxes (S, K), T, as ideal sensors and emitters would have given them.

        ``time``: s since the start of the diagnosed session, for effects that change with time;
        ``flux`` (S, K), T: a row with NaN stays NaN; ``recorded``: whether this is the diagnosed
        session, so that the course of a drift holds. Otherwise a drift is left as it is: live, the
        refit follows the strengths of the emitters with the references.
        """
        terms = self._with(Remedy.FLUX)
        if not terms:
            return flux
        out = np.array(flux, dtype=complex)
        good = np.isfinite(out).all(axis=1)
        if not good.any():
            return out
        number = np.asarray(channels, dtype=np.int64)[good]
        values: ComplexArray = self._decompressed(terms, number, out[good])
        for term in terms:
            added = term.effect.offset(term, number, self.omega.size)
            values = values if added is None else values - added
        for term in reversed(terms):
            mixing = term.effect.channel_matrix(term, number)
            if mixing is not None:
                values = np.asarray(np.linalg.solve(mixing, values), dtype=complex)
        for term in reversed(terms):
            if term.effect.drifts and not recorded:
                continue
            matrix = term.effect.emitter_matrix(term, np.array([time]), self.omega)
            if matrix is not None:
                values = np.asarray(np.linalg.solve(matrix[0], values.T).T, dtype=complex)
        out[good] = values
        return out

    @staticmethod
    def _decompressed(
        terms: list[Term], channels: NDArray[np.int64], measured: ComplexArray
    ) -> ComplexArray:
        """Fixed point of ``x = measured - (compress(x) - x)``: the loss is a small part of x.

        A correction of more than half of x cannot be trusted, and is limited to that.
        """
        x = measured
        for _ in range(DECOMPRESSION_STEPS):
            behind = x[None]
            for term in terms:
                behind = term.effect.compress(term, channels, behind)
            loss = behind[0] - x
            most = 0.5 * np.abs(measured)
            share = most / np.maximum(np.abs(loss), np.maximum(most, 1e-300))
            step = measured - loss * share
            if np.allclose(step, x, rtol=1e-9, atol=0.0):
                return np.asarray(step)
            x = step
        return np.asarray(x)
