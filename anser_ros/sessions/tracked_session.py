"""Tracks the poses of a recorded session as the live nodes would."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from anser_ros.errors import BagError
from anser_ros.field.model import FieldModel
from anser_ros.integrity.ageing import UNCHANGED_MODEL
from anser_ros.sessions.follower import FrameModels, ModelFollower, RefitSummary
from anser_ros.sessions.frames import frames_of
from anser_ros.sessions.prepared import PreparedSession
from anser_ros.sessions.tracker_settings import settings_for
from anser_ros.tracking.estimate import PoseEstimate, TrackerSettings
from anser_ros.tracking.source_track import Sources
from anser_ros.tracking.tracker import Tracker

Progress = Callable[[float], None]
SOURCES = 'sources'
"""Kind of tracked things: the source as a body sees it, place and axis in the body's frame, where
the field is the same all around an axis."""


@dataclass(frozen=True)
class TrackedSession:
    """Holds the estimates of every sensor and body by its name, one per frame by its stamp.

    The seconds are the mean wall time that a frame took, the refit included; ``further`` is what
    else was tracked, by kind and name: `SOURCES`.
    """

    estimates: dict[str, tuple[PoseEstimate, ...]]
    seconds_per_frame: float
    refit: RefitSummary | None = None
    further: dict[str, dict[str, tuple[PoseEstimate, ...]]] = field(default_factory=dict)


def in_phase_model(model: FieldModel) -> FieldModel:
    """Return the model without its quadrature part, as the article's own method uses it."""
    modes = None if model.modes is None else model.modes.real.astype(complex)
    return replace(model, moments=model.moments.real.astype(complex), modes=modes)


def track(
    prepared: PreparedSession,
    settings: TrackerSettings | None = None,
    follower: FrameModels | None = None,
    in_phase: bool = False,
    progress: Progress | None = None,
) -> TrackedSession:
    """Track every tool sensor and body of a session at every frame.

    The optical pose is never used: neither as a start value nor to refuse a pose. The noise is
    that of the session's setup. With ``in_phase``, for an `in_phase_model`, only the fluxes'
    in-phase parts are used.

    Raises
    ------
    BagError
        When the session has no tool fluxes.
    """
    if not prepared.session.tools:
        raise BagError(
            f'{prepared.session.path}: the session has no tool fluxes to track, on a topic that '
            f'ends with /tool/flux'
        )
    seen = Sources()
    tracker = _tracker(
        prepared, settings or TrackerSettings(), seen, follows=isinstance(follower, ModelFollower)
    )
    estimates: dict[str, list[PoseEstimate]] = {}
    sources: dict[str, list[PoseEstimate]] = {}
    frames = list(frames_of(prepared.session))
    start = time.perf_counter()
    for count, frame in enumerate(frames, start=1):
        standing = UNCHANGED_MODEL if follower is None else follower.at(frame)
        if standing.model is not None and standing.model is not tracker.model:
            tracker = tracker.with_model(standing.model)
        if frame.tools is not None:
            tools = frame.tools.in_phase() if in_phase else frame.tools
            found = tracker.update(
                frame.stamp_ns, tools.channels, tools.flux, tools.flags, standing.withheld
            )
            if follower is not None:
                follower.witnessed(tools, found)
            for estimate in found:
                estimates.setdefault(estimate.name, []).append(estimate)
            for body, source in seen.found.items():
                sources.setdefault(body, []).append(source)
        if progress is not None:
            progress(count / len(frames))
    seconds = (time.perf_counter() - start) / max(len(frames), 1)
    by_name = {name: tuple(given) for name, given in estimates.items()}
    summary = None if follower is None else follower.summary
    further = {SOURCES: {name: tuple(given) for name, given in sources.items()}}
    return TrackedSession(by_name, seconds, summary, further if sources else {})


def _tracker(
    prepared: PreparedSession, settings: TrackerSettings, seen: Sources, *, follows: bool
) -> Tracker:
    """A tracker that knows the session's noise, and a drift's course if nothing else does."""
    return Tracker(
        prepared.model,
        prepared.sensors,
        replace(
            settings_for(prepared.session.setup, settings),
            recorded_drift=prepared.recorded_drift and not follows,
            volume=settings.volume or prepared.volume,
        ),
        [seen],
    )
