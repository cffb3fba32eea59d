"""Says how far a model may be trusted: by its age since references last gave it, and by the
readings that it explained.

Metal continues to move when no references report it. So the uncertainty of a model that followed
them grows from frame to frame, by the change of the field while the metal was still observed;
beyond a bound it no longer describes the field. And a model that leaves most readings of the last
seconds unexplained is doubtful, though single poses pass by chance.
"""

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from anser_ros.field.model import FieldModel
from anser_ros.integrity.pose_checks import STREAM_GAP_S
from anser_ros.physics.sensor import along_each_axis
from anser_ros.physics.volume import TrackedVolume
from anser_ros.pose_states import REFERENCES_LOST, Withheld
from anser_ros.stamps import NANO

SPEED_S = 0.3
"""Time, s, over which the last speed of metal is taken: long against the refit's noise, short as
the effect of metal that comes near grows with the sixth power of its distance."""
AGE_STEPS = 10
"""Steps that a model ages in, from fresh to given up; for each, trackers lay it out again."""
FASTER = 2.0
"""How many times as fast as before metal may move on: its effect grows faster than its way."""
SAMPLES = 3, 3
"""Points across and up the volume at which the size of a change is taken: enough for a mean."""
ELSEWHERE = 0.5
"""Part of the field's expected change that may have any other shape than the last one, since metal
may turn aside."""


@dataclass(frozen=True)
class FrameModel:
    """Holds the model that a frame may be tracked with, and why no pose may be given, if so.

    The model is None if the references never gave one: the active model stays unchanged.
    """

    model: FieldModel | None
    withheld: Withheld | None = None


UNCHANGED_MODEL = FrameModel(None)
"""For a model that does not follow references."""


class ModelAge:
    """Keeps the last models that the references gave, and ages the newest until the next.

    From an age of ``longest_s`` on no pose is given. The size of a change of the field is taken in
    the ``volume``.
    """

    def __init__(self, longest_s: float, volume: TrackedVolume) -> None:
        self._longest_ns = round(longest_s / NANO)
        self._points, self._axes = along_each_axis(volume.samples(*SAMPLES))
        self._answers: deque[tuple[int, FieldModel]] = deque()
        self._aged: tuple[int, FieldModel] | None = None

    @property
    def newest_ns(self) -> int:
        """Return the stamp of the newest answer, ns; 0 before there was one."""
        return self._answers[-1][0] if self._answers else 0

    def forget(self) -> None:
        """Drop all answers: the active model is no answer of the references."""
        self._answers.clear()
        self._aged = None

    def answered(self, stamp_ns: int, model: FieldModel) -> None:
        """Take the model that the references of a frame gave; a jump back in time restarts it."""
        answers = self._answers
        if answers and stamp_ns < answers[-1][0]:
            answers.clear()
        elif answers and stamp_ns == answers[-1][0]:
            answers.pop()  # the same answer again, once its uncertainty has come
        while len(answers) > 1 and (stamp_ns - answers[1][0]) * NANO >= SPEED_S:
            answers.popleft()
        answers.append((stamp_ns, model))
        self._aged = None

    def at(self, stamp_ns: int, why: str = '') -> FrameModel:
        """Return what a frame may be tracked with; ``why`` states why the references gave no
        answer.
        """
        if not self._answers:
            return FrameModel(None, Withheld(REFERENCES_LOST, why)) if why else UNCHANGED_MODEL
        last_ns, model = self._answers[-1]
        age_ns = stamp_ns - last_ns
        if age_ns > self._longest_ns:
            words = why or 'no reference fluxes'
            longest_s = self._longest_ns * NANO
            reason = f'{words} for {age_ns * NANO:.2f} s, {longest_s:g} s at most'
            return FrameModel(model, Withheld(REFERENCES_LOST, reason))
        if age_ns <= 0:
            return FrameModel(model)
        step = math.ceil(AGE_STEPS * age_ns / self._longest_ns)
        if self._aged is None or self._aged[0] != step:
            self._aged = step, self._older(step * self._longest_ns / AGE_STEPS)
        return FrameModel(self._aged[1])

    def _older(self, age_ns: float) -> FieldModel:
        """Return the newest model with the error that it has after so long."""
        (first_ns, before), (last_ns, model) = self._answers[0], self._answers[-1]
        if before is model:
            return model
        share = FASTER * age_ns / (last_ns - first_ns)
        if np.array_equal(model.positions, before.positions) and np.array_equal(
            model.directions, before.directions
        ):
            change = model.moments - before.moments
        else:
            grown = model.with_dipoles(
                before.positions, before.directions, np.zeros_like(before.moments)
            )
            change = np.concatenate([model.moments, -before.moments])
            model = grown
        mode = (share * change)[None]
        modes = mode if model.modes is None else np.concatenate([model.modes, mode])
        moved = replace(model, moments=mode[0]).flux(self._points, self._axes)
        rest = ELSEWHERE * float(np.sqrt(0.5 * (np.abs(moved) ** 2).mean()))
        return replace(model, modes=modes, flux_error_t=math.hypot(model.flux_error_t, rest))


RECORD_S = 2.0
"""How far back readings count, s. Smaller, and metal that passes makes the model doubtful; larger,
and a wrong model gives poses for longer."""
DOUBTFUL = 0.8
"""Share of refused readings from which on the model is doubtful; by chance every third pose passes
a model that is a little wrong."""
FEWEST_JUDGED_READINGS = 6
"""Readings that a share is made of at least: a single bad coil is not the whole chain."""
GOOD_SHARE = 0.2
"""Share (0 to 1) of refused readings up to which a frame speaks for the model: one bad coil of
five."""
RECOVERY_S = 0.5
"""For so long, s, all frames must speak for a doubtful model before it gives poses again: where it
happens to fit, it is not yet right."""


class ModelRecord:
    """Counts how many readings the model explained lately."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Forget all frames that were judged so far."""
        self._frames: deque[tuple[int, int, int, float]] = deque()
        self._refused = self._total = self._sound_since_ns = self._last_ns = 0
        self.is_doubtful = False

    @property
    def refused_share(self) -> float:
        """Return the share of the last seconds' readings that the model did not explain."""
        return self._refused / max(self._total, 1)

    def add(self, stamp_ns: int, refused: int, total: int, residual: float) -> None:
        """Take in a frame: how many of its readings the model did not explain.

        ``residual`` is the typical one of these in units of the expected one; NaN for none.
        """
        last_ns = self._last_ns
        if not last_ns or not 0 < stamp_ns - last_ns <= STREAM_GAP_S / NANO:
            self.forget()
        self._last_ns = stamp_ns
        frames = self._frames
        while frames and stamp_ns - frames[0][0] > RECORD_S / NANO:
            _, gone, counted, _ = frames.popleft()
            self._refused, self._total = self._refused - gone, self._total - counted
        frames.append((stamp_ns, refused, total, residual))
        self._refused, self._total = self._refused + refused, self._total + total
        if (total and refused > GOOD_SHARE * total) or not self._sound_since_ns:
            self._sound_since_ns = stamp_ns
        is_sound = stamp_ns - self._sound_since_ns >= RECOVERY_S / NANO
        if is_sound:
            self.is_doubtful = False
        elif self._total >= FEWEST_JUDGED_READINGS and self.refused_share > DOUBTFUL:
            self.is_doubtful = True

    @property
    def reason(self) -> str:
        """Return why the model is doubtful: the share, and how large residuals are."""
        residuals = sorted(r for _, _, _, r in self._frames if math.isfinite(r))
        typical = residuals[len(residuals) // 2] if residuals else math.nan
        return (
            f'{100 * self.refused_share:.0f} % of the readings of the last {RECORD_S:g} s '
            f'contradict the model, residual {typical:.3g} times the expected one'
        )
