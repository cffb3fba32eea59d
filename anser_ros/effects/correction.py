"""Undoes a model's effects on what is measured: live in the tracker and node, and offline.

The forward chain is ``flux = compress(C T (field) + offset)`` with C mixing channels and T mixing
emitters; it is undone from the outside in. Effects on the field are in the model's dipoles
already, and what can't be corrected is passed over.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import Remedy, Term, unit_matrix
from anser_ros.effects.registry import effect_named
from anser_ros.field.model import EffectRecord
from anser_ros.physics.pose_track import PoseTrack
from anser_ros.physics.sensor import SensorTable

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

DECOMPRESSION_STEPS = 12
DRIFTS = ('coil_drift', 'coil_fluctuation')
"""Effects whose course over time another session doesn't repeat; the references can tell it."""


@dataclass(frozen=True)
class Correction:
    """The corrections that a model's effect records ask for.

    Attributes
    ----------
    terms : tuple of Term
    surveyed : SensorTable
        Sensors as the setup has them.
    omega : ndarray, shape (K,)
    """

    terms: tuple[Term, ...]
    surveyed: SensorTable
    omega: Array

    @staticmethod
    def of(
        records: Sequence[EffectRecord], sensors: SensorTable, frequencies: Sequence[float]
    ) -> 'Correction':
        """Corrections of a model's records; raises `ModelFileError` on a record that is none."""
        corrected = []
        for record in records:
            effect = effect_named(record.name)
            if effect.remedy in (Remedy.FLUX, Remedy.SENSORS, Remedy.OPTICAL):
                corrected.append(effect.term(record))
        omega = 2 * np.pi * np.asarray(frequencies, dtype=np.float64)
        return Correction(tuple(corrected), sensors, omega)

    def _with(self, remedy: Remedy) -> list[Term]:
        return [term for term in self.terms if term.effect.remedy is remedy]

    @property
    def changes_flux(self) -> bool:
        """Whether `flux` does anything."""
        return bool(self._with(Remedy.FLUX))

    @property
    def drifting(self) -> tuple[str, ...]:
        """Effects that only references, or a recorded course, can correct."""
        return tuple(term.label for term in self.terms if term.effect.name in DRIFTS)

    def sensors(self, table: SensorTable | None = None) -> SensorTable:
        """The sensors (by default those given at the start) as they truly are."""
        out = self.surveyed if table is None else table
        for term in self._with(Remedy.SENSORS):
            out = term.effect.table(term, out)
        return out

    def optical(self, track: PoseTrack) -> PoseTrack:
        """An optical track on the fluxes' clock and in fg."""
        # As in the forward chain: the order in which the effects are listed.
        for term in self._with(Remedy.OPTICAL):
            track = term.effect.optical(term, track)
        return track

    def strengths(self, reference_flux: ComplexArray, baseline: ComplexArray) -> ComplexArray:
        """Strength of each emitter now over that of the baseline, as the references see it.

        Parameters
        ----------
        reference_flux, baseline : ndarray, shape (R, K), complex
            Readings of the same reference sensors, T; rows with NaN are left out.
        """
        good = np.isfinite(reference_flux).all(axis=1) & np.isfinite(baseline).all(axis=1)
        now, then = reference_flux[good], baseline[good]
        power = np.sum(np.abs(then) ** 2, axis=0)
        ratio = np.sum(then.conj() * now, axis=0) / np.where(power > 0, power, 1.0)
        return np.asarray(np.where(power > 0, ratio, 1.0))

    def flux(
        self,
        time: float,
        channels: NDArray[np.generic],
        flux: ComplexArray,
        strengths: ComplexArray | None = None,
        *,
        recorded: bool = False,
    ) -> ComplexArray:
        """A frame's fluxes as sound sensors and emitters would have given them.

        Parameters
        ----------
        time : float
            s since the start of the session that the model was diagnosed on; only effects that
            change with time use it, and only where they are ``recorded``.
        channels : ndarray, shape (S,)
        flux : ndarray, shape (S, K), complex
            T. A row with NaN stays NaN.
        strengths : ndarray, shape (K,), complex, optional
            What the references say about the emitters now (`strengths`), for those that drift.
        recorded : bool
            Whether the course that a drift took in the diagnosed session holds, because this is
            that session. Without it and without ``strengths`` a drift is left as it is.

        Returns
        -------
        ndarray, shape (S, K), complex
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
        for term in terms:
            gain = term.effect.channel_gain(term, number, np.array([time]))
            values = values if gain is None else values / gain[0][:, None]
        for term in reversed(terms):
            matrix = self._emitters(term, time, strengths, recorded)
            if matrix is not None:
                values = np.asarray(np.linalg.solve(matrix, values.T).T, dtype=complex)
        out[good] = values
        return out

    def _emitters(
        self, term: Term, time: float, strengths: ComplexArray | None, recorded: bool
    ) -> ComplexArray | None:
        if term.effect.name in DRIFTS:
            if strengths is not None:
                coil = int(term.site['coil'])
                live = unit_matrix(self.omega.size)
                live[coil, coil] = strengths[coil]
                return live
            if not recorded:
                return None
        matrix = term.effect.emitter_matrix(term, np.array([time]), self.omega)
        return None if matrix is None else np.asarray(matrix[0])

    @staticmethod
    def _decompressed(
        terms: list[Term], channels: NDArray[np.int64], measured: ComplexArray
    ) -> ComplexArray:
        """Fixed point of ``x = measured - (compress(x) - x)``: the loss is a small part of x.

        Where it would be more than half of x the channel is beyond what can be undone, and what is
        put back is held at that.
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


__all__ = ['Correction']
