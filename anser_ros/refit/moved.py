"""Asks whether the frame of the references, a part of it, or an emitter, has moved, or a gain
that all have in common, beside metal or without.

What slides as one is no metal, but clouds of metal explain a slide quite well, and a model that
follows them is wrong by as much. So "this has moved, and metal may be there too" is a hypothesis
beside each of a bank's: to its covariance come the columns of what such a motion makes of the
baseline. Its evidence is against the same baseline however slow the slide is. So it is for the
gain of all references, or of all emitters, which references cannot tell from each other: it is
learnt, and the readings are looked at without it.
The rules are those of `refit.posterior`: ``1/2 b^T (1 + M)^-1 b - 1/2 log |1 + M|`` is what the
columns X, whose factors have a variance of one, add to the log likelihood of readings y with the
precision P, where ``M = X^T P X`` and ``b = X^T P y``.
"""

from collections.abc import Sequence

import numpy as np

from anser_ros.arrays import Array, Integers
from anser_ros.integrity.board_place import FAR_M, FAR_SIGMAS, PRIOR_M, PRIOR_RAD
from anser_ros.integrity.clean_references import DrawnReadings
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit.clouds import FieldFunction
from anser_ros.refit.parts import MovedParts
from anser_ros.refit.posterior import Bank, FrameEvidence, log_sum, make_room
from anser_ros.stamps import NANO

LOOK_S = 0.16
"""Time, s, from one look to the next: a frame that slides by 5 mm/s slides 0.8 mm meanwhile."""
MOVED_ODDS = 20.0
"""Log odds from which on a motion is believed: metal of independent recordings reaches -12 where
an X-ray head touches the board, and simulated slides of 0.05 mm are at 100 to 200."""
COMMON_GAIN, LEAST_GAIN = 0.05, 1e-4
"""Standard deviation of a gain that all references, or all emitters, have in common, as when one
amplifier or supply warms up; and the least that counts: it moves no pose by more than 10 um."""
PART_ODDS = 100.0
"""Log odds from which on a part of the references is believed to have moved: as those of a coil
that is at fault (`health.FAULT_ODDS`), for the part is chosen among all, and metal that clouds
describe badly reaches 70."""
IMPROBABLE = 40.0
"""Log odds against a strength, beside the best one, from which on it is left out: 1 in 10^17."""
MOST_KEPT = 64
"""Hypotheses at a noise level whose matrices are kept."""


class FrameMotion:
    """Watches the frame of some references in the in-phase ``field`` of some ``emitters``, K.

    ``noise_t`` is the unit of readings, T. ``reason`` is what counts as moved; empty for nothing.
    ``gain`` is the change of the common gain that has been learnt.
    """

    reason: str
    gain: float

    def __init__(
        self, field: FieldFunction, references: SensorTable, emitters: Sequence[str],
        noise_t: float,
    ) -> None:  # fmt: skip
        self._points, self._last_ns, self._emitters = references.position, 0, emitters
        self._parts = MovedParts()
        self._known: dict[tuple[object, ...], tuple[Array, Array, Array]] = {}
        self.forget()
        drawn = DrawnReadings.of(field, references.position, references.axis, references.length)
        whole = PRIOR_M * drawn.by_place, PRIOR_RAD * drawn.turned(np.zeros(3))
        # (2 + K, 6, S, K): an emitter that moves leaves the readings of the others as they are.
        columns = np.zeros((2 + len(emitters), 6, *drawn.flux.shape))
        columns[0], columns[-1, 0] = np.concatenate(whole), COMMON_GAIN * drawn.flux
        for k in range(len(emitters)):
            columns[1 + k, :3, :, k] = -whole[0][:, :, k]
            columns[1 + k, 3, :, k] = COMMON_GAIN * drawn.flux[:, k]  # it may be weaker as well
        self._things = len(columns)
        self._columns = columns.reshape(6 * len(columns), -1).T / noise_t  # a row for a reading

    def forget(self) -> None:
        """Believe that nothing has moved, and look with the next frame."""
        self._next_ns, self._away, self.reason, self.gain = 0.0, (0, 0.0), '', 0.0
        self._parts.forget()
        self._asks_parts = False

    def look(self, stamp_ns: int, bank: Bank, seen: FrameEvidence) -> None:
        """Take in a frame's evidence; it is looked at every `LOOK_S`."""
        if self._last_ns <= stamp_ns < self._next_ns:
            return
        self._last_ns, self._next_ns = stamp_ns, stamp_ns + LOOK_S / NANO
        self._asks_parts = not self._asks_parts  # every other time, for what it costs
        if self.reason and self._away[0] < 0 and not self._asks_parts:
            return
        odds, best = np.full(self._things, -np.inf), (-np.inf, 0, np.zeros(6), np.eye(6))
        for hypothesis in {0, seen.best}:
            columns, factor, half_log_det = self._known_of(bank, hypothesis, seen.noise)
            precision, log_det = bank.precision(seen.noise)
            curve = seen.curve[hypothesis, 0, : len(factor)]
            # A strength has no more evidence than if readings were explained wholly.
            most = 2.0 * (IMPROBABLE - float(curve.max()))
            a = int(np.count_nonzero(log_det[hypothesis, : len(factor)] < most))
            weighted = precision[hypothesis, :a] * seen.projected[hypothesis, :, 0]
            b = (weighted @ columns).reshape(a, *factor.shape[1:3])  # (A, 2 + K, 6)
            white = np.einsum('akij,akj->aki', factor[:a], b)
            gained = curve[:a, None] + 0.5 * (white**2).sum(axis=2) - half_log_det[:a]
            evidence = np.logaddexp.reduce(gained, axis=0) - log_sum(curve)
            evidence += float(seen.log_evidence[hypothesis])
            if hypothesis > 0:
                evidence[-1] = -np.inf
            odds = np.logaddexp(odds, evidence)
            what = int(evidence.argmax())
            if evidence[what] > best[0]:
                top = int(gained[:, what].argmax())
                best = float(evidence[what]), what, white[top, what], factor[top, what]
        evidence, what, white, factor = best
        motion, sigma = white @ factor, np.sqrt((factor**2).sum(axis=0))
        if self._asks_parts and seen.best > 0 and self._is_part(bank, seen, evidence):
            return
        # Far away a motion is not linear any more, and not seen beside metal: it must come back.
        if float(odds.max()) - log_sum(seen.log_evidence) > MOVED_ODDS:
            if what == len(odds) - 1:
                gain = self.gain + COMMON_GAIN * float(motion[0])
                self.gain = gain if abs(gain) > LEAST_GAIN else 0.0
                return
            self.reason = self._said(what, motion, sigma)
        elif seen.best == 0:
            self.reason, self._away = '', (0, 0.0)

    def _is_part(self, bank: Bank, seen: FrameEvidence, evidence: float) -> bool:
        """Say how far a part of the references has moved, if that is more probable than metal
        alone and than whatever else has the log ``evidence``; return whether it is.
        """
        whole = self._columns.reshape(len(self._columns), self._things, 6)[:, 0]
        part = self._parts.look(bank, seen, whole)
        if part.log_evidence <= max(PART_ODDS + log_sum(seen.log_evidence), evidence):
            return False
        self.reason = self._said(-1, part.motion, part.sigma, part.coils)
        return True

    def _said(
        self, what: int, motion: Array, sigma: Array, coils: Integers | slice = slice(None)
    ) -> str:
        """Return how far a motion (6,) takes the references, or some ``coils`` of them, or the
        emitter ``what`` from 1 on, where that is certain and too far until the next look.
        """
        kinds = 3 if what > 0 else 6  # an emitter's fourth factor is its strength
        shift, turn = PRIOR_M * motion[:3], PRIOR_RAD * motion[3:] * (what <= 0)
        points = self._points[coils]
        away = float(np.linalg.norm(shift + np.cross(turn, points), axis=1).max())
        before = self._away[1] if self._away[0] == what else 0.0
        self._away = what, away
        is_certain = (np.abs(motion) > FAR_SIGMAS * sigma)[:kinds].any()
        if not is_certain or max(away, 2.0 * away - before) < FAR_M:
            return ''
        words = ', '.join(f'{1e3 * v:+.1f}' for v in shift)
        who = f'emitter {self._emitters[what - 1]} has' if what > 0 else 'the references have'
        if what < 0:
            who = f'{len(points)} of {len(self._points)} references have'
        by = f'by up to {1e3 * away:.1f} mm ({words} along x, y, z)'
        return f'{who} moved {"on" if what > 0 else "as one against"} the board, {by}'

    def _known_of(self, bank: Bank, hypothesis: int, noise: float) -> tuple[Array, Array, Array]:
        """Return what a hypothesis and the noise decide for each thing that may move: the columns
        (n, (2 + K) 6) in its eigenvectors, and for each strength ``L^-1`` (A, 2 + K, 6, 6) of
        Cholesky's factor ``L L^T = 1 + M`` and half of ``log |1 + M|`` (A, 2 + K).
        """
        key = (bank.rows.tobytes(), bank.names[hypothesis], noise)
        if key not in self._known:
            make_room(self._known, MOST_KEPT)
            columns = bank.bases[hypothesis].T @ self._columns[bank.rows]
            # The upper triangles of all products of two columns, so that one product sums them.
            first, second = np.triu_indices(6)
            each = columns.reshape(len(columns), -1, 6)
            pairs = (each[:, :, first] * each[:, :, second]).reshape(len(columns), -1)
            precision = bank.precision(noise)[0][hypothesis]
            # Nothing has no strength: what is known of one of them is known of all.
            square = precision[: None if bank.spectra[hypothesis].any() else 1] @ pairs
            inside = np.empty((len(square), self._things, 6, 6))
            inside[:, :, first, second] = square.reshape(*inside.shape[:2], -1)
            inside[:, :, second, first] = inside[:, :, first, second]
            lower = np.linalg.cholesky(inside + np.eye(6))
            half = np.log(np.einsum('akii->aki', lower)).sum(axis=2)
            self._known[key] = columns, np.linalg.inv(lower), half
        return self._known[key]
