"""Says how far a model may be trusted by its age since references last gave it.

Metal continues to move when no references report it. So the uncertainty of a model that followed
them grows from frame to frame, by the change of the field while the metal was still observed;
beyond a bound it no longer describes the field.
"""

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from anser_ros.arrays import Array, ComplexArray
from anser_ros.field.model import FieldModel
from anser_ros.physics.dipole import flux_basis
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
        # Positions and directions of dipoles, and the flux that each makes in the volume.
        self._fluxes: tuple[Array, Array, Array] | None = None

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

    def at(self, stamp_ns: int, withheld: Withheld | None = None) -> FrameModel:
        """Return what a frame may be tracked with.

        ``withheld`` is for what the refit wants no pose to be given. With `REFERENCES_LOST` the
        newest model still ages, and gives poses as long as it may.
        """
        is_lost = withheld is not None and withheld.state == REFERENCES_LOST
        standing = self._aged_at(stamp_ns, withheld.reason if withheld and is_lost else '')
        return standing if withheld is None or is_lost else FrameModel(standing.model, withheld)

    def _aged_at(self, stamp_ns: int, why: str) -> FrameModel:
        """The newest model with its age; ``why`` states why the references gave no answer."""
        if not self._answers:
            return FrameModel(None, Withheld(REFERENCES_LOST, why) if why else None)
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
        places = model.positions, model.directions
        if _are_same(places, (before.positions, before.directions)):
            change = model.moments - before.moments
        else:
            grown = model.with_dipoles(
                before.positions, before.directions, np.zeros_like(before.moments)
            )
            change = np.concatenate([model.moments, -before.moments])
            model = grown
        mode = (share * change)[None]
        modes = mode if model.modes is None else np.concatenate([model.modes, mode])
        moved = self._flux_of(model, mode[0])
        rest = ELSEWHERE * float(np.sqrt(0.5 * (np.abs(moved) ** 2).mean()))
        return replace(model, modes=modes, flux_error_t=math.hypot(model.flux_error_t, rest))

    def _flux_of(self, model: FieldModel, moments: ComplexArray) -> ComplexArray:
        """Return what moments (N, K), A m^2, of a model's dipoles make in the volume, T."""
        known, places = self._fluxes, (model.positions, model.directions)
        if known is None or not _are_same(known[:2], places):
            basis = flux_basis(self._points, self._axes, None, *places)
            self._fluxes = known = *places, basis
        return (known[2] @ moments.view(np.float64)).view(np.complex128)


def _are_same(first: tuple[Array, Array], second: tuple[Array, Array]) -> bool:
    """Whether dipoles lie alike; mostly they are the very same arrays."""
    return all(a is b or np.array_equal(a, b) for a, b in zip(first, second, strict=True))
