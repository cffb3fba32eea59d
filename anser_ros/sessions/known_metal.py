"""Lets the field model follow known metal through a recorded session, by its tools."""

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from anser_ros.errors import BagError, ModelFileError
from anser_ros.integrity.ageing import FrameModel
from anser_ros.known_metal.follower import KnownMetalFollower
from anser_ros.known_metal.known import KnownMetal
from anser_ros.pose_states import OK
from anser_ros.refit.excitation import excitation_for
from anser_ros.sessions.follower import FrameModels, RefitSummary
from anser_ros.sessions.frames import FrameReadings, SessionFrame
from anser_ros.sessions.known_metal_file import load_known_metal
from anser_ros.sessions.prepared import PreparedSession
from anser_ros.sessions.session import tracking_noise
from anser_ros.sessions.tool_readings import tool_readings
from anser_ros.sessions.tracker_settings import settings_for
from anser_ros.sessions.volume import stated_volume
from anser_ros.tracking.estimate import NO_GATE, PoseEstimate, TrackerSettings
from anser_ros.tracking.tracker import Tracker

FOLLOWED, SEARCHED = 'followed', 'not_found'
"""States in the summary."""


def models_of(path: str | os.PathLike[str]) -> Callable[[PreparedSession], FrameModels]:
    """Return what follows the metal of a file through a session; raises as `load_known_metal`."""
    return partial(KnownMetalModels, known=load_known_metal(path))


class KnownMetalModels(FrameModels):
    """Gives each frame of a session the field with known metal where its tools say that it is.

    Attributes
    ----------
    summary : RefitSummary
        In how many frames the metal was followed.

    Raises
    ------
    BagError
        When the session has no tool fluxes.
    ModelFileError
        When the metal was learnt at other frequencies than the emitters'.
    """

    def __init__(self, prepared: PreparedSession, known: KnownMetal) -> None:
        session = prepared.session
        if not session.tools:
            raise BagError(f'{session.path}: known metal is followed by tools, there are none')
        mean_hz = float(np.exp(np.log(prepared.model.frequencies_hz).mean()))
        if not 0.5 < mean_hz / known.lattice.frequency_hz < 2.0:
            raise ModelFileError(
                f'{known.name} was learnt at {known.lattice.frequency_hz:.0f} Hz, the emitters '
                f'have {mean_hz:.0f} Hz'
            )
        excitation, _ = excitation_for(
            prepared.model, prepared.nominal.field, stated_volume(session.setup)
        )
        self._correction = prepared.correction
        sensors = self._correction.sensors()
        self._follower = KnownMetalFollower(
            known, prepared.model, excitation, sensors, session.setup.refit.tools,
            prepared.volume, tracking_noise(session.setup),
        )  # fmt: skip
        # Where a pose is withheld, a tracker that withholds none shows where the tool is, nearly.
        settings = settings_for(session.setup, TrackerSettings(gate=NO_GATE))
        self._rough = Tracker(
            prepared.model, prepared.sensors, replace(settings, volume=prepared.volume)
        )
        self._stamp_ns = 0
        self.summary = RefitSummary()

    def at(self, frame: SessionFrame) -> FrameModel:
        """Return what a frame is tracked with."""
        self._stamp_ns = frame.stamp_ns
        model, withheld = self._follower.at(frame.stamp_ns)
        self.summary.states[FOLLOWED if self._follower.is_followed else SEARCHED] += 1
        if model is not self._rough.model:
            self._rough = self._rough.with_model(model)
        return FrameModel(model, withheld)

    def witnessed(self, tools: FrameReadings, found: Sequence[PoseEstimate]) -> None:
        """Take in what a frame's tools read, at poses near theirs."""
        rough = self._rough.update(self._stamp_ns, tools.channels, tools.flux, tools.flags)
        poses = {
            one.name: (one.position, one.rotation)
            for one in (*rough, *(one for one in found if one.state == OK))
            if one.state == OK and one.rotation is not None
        }
        at = [one.position for one in rough if np.isfinite(one.position).all()]
        self._follower.take(
            self._stamp_ns,
            tool_readings(self._correction, tools.channels, tools.flux, tools.flags, poses),
            np.array(at) if at else None,
        )
