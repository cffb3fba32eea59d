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
from anser_ros.tracking.tracker import PoseEstimate, Tracker, TrackerSettings

Progress = Callable[[float], None]


@dataclass(frozen=True)
class TrackedSession:
    """Holds what tracking a session gave.

    Attributes
    ----------
    estimates : dict of str to tuple of PoseEstimate
        Of every sensor and body by its name, one per frame, in the order of the stamps.
    seconds_per_frame : float
        Mean wall time that a frame took, the refit included.
    refit : RefitSummary or None
        What the refit did; None where the model did not follow the references.
    sources : dict of str to tuple of PoseEstimate
        Of every body by its name, where the field is the same all around an axis: place and axis
        of the source in the body's frame.
    """

    estimates: dict[str, tuple[PoseEstimate, ...]]
    seconds_per_frame: float
    refit: RefitSummary | None = None
    sources: dict[str, tuple[PoseEstimate, ...]] = field(default_factory=dict)


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

    The optical pose is never used: neither as a start value nor to refuse a pose.

    Parameters
    ----------
    prepared : PreparedSession
        The session and its model.
    settings : TrackerSettings, optional
        The noise is that of the session's setup.
    follower : FrameModels, optional
        Changes the model on the way.
    in_phase : bool
        Whether only the fluxes' in-phase parts are used, for an `in_phase_model`.
    progress : callable, optional
        Called with the finished share, 0 to 1.

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
    tracker = _tracker(
        prepared, settings or TrackerSettings(), follows=isinstance(follower, ModelFollower)
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
            seen = frame.tools.in_phase() if in_phase else frame.tools
            found = tracker.update(
                frame.stamp_ns, seen.channels, seen.flux, seen.flags, standing.withheld
            )
            if follower is not None:
                follower.witnessed(seen, found)
            for estimate in found:
                estimates.setdefault(estimate.name, []).append(estimate)
            for body, source in tracker.sources.items():
                sources.setdefault(body, []).append(source)
        if progress is not None:
            progress(count / len(frames))
    seconds = (time.perf_counter() - start) / max(len(frames), 1)
    by_name = {name: tuple(given) for name, given in estimates.items()}
    summary = None if follower is None else follower.summary
    seen_from = {name: tuple(given) for name, given in sources.items()}
    return TrackedSession(by_name, seconds, summary, seen_from)


def _tracker(prepared: PreparedSession, settings: TrackerSettings, *, follows: bool) -> Tracker:
    """A tracker told of the session's noise, and of a drift's course where nothing else
    determines it."""
    return Tracker(
        prepared.model,
        prepared.sensors,
        replace(
            settings_for(prepared.session.setup, settings),
            recorded_drift=prepared.recorded_drift and not follows,
            volume=settings.volume or prepared.volume,
        ),
    )
