"""Offers tracking as a function: a session and a model in, arrays of poses out."""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.api.given import Progress, SessionSource, session_given, shown
from anser_ros.api.model import ModelSource, field_given
from anser_ros.arrays import Array, Booleans, Integers, numbers_of
from anser_ros.pose_states import OK
from anser_ros.sessions.tracked_session import PoseSeries, to_document, track_session
from anser_ros.stamps import NANO
from anser_ros.tracking.estimate import TrackerSettings
from anser_ros.wire.text_files import path_of


@dataclass(frozen=True)
class TrackedPoses:
    """Holds poses of one coil or one rigid body over F frames.

    Attributes
    ----------
    name : str
    stamp_ns : ndarray of int, shape (F,)
    time : ndarray, shape (F,)
        s since the session's first stamp.
    state : ndarray of str, shape (F,)
        ``ok``, or why there is no pose.
    position : ndarray, shape (F, 3)
        m, frame fg. Only frames whose state is ``ok`` may be used.
    axis : ndarray, shape (F, 3)
        Sensitive axis of a coil, +z of a body, in fg.
    rotation : ndarray, shape (F, 3, 3)
        Axes of a body in fg (columns); NaN for a coil, whose roll cannot be observed.
    covariance : ndarray, shape (F, 6, 6)
        Of position (m^2) and rotation vector (rad^2), in fg.
    sigma_position_m : ndarray, shape (F,)
        Square root of the trace of the position's covariance, the model's uncertainty included.
    residual_t : ndarray, shape (F,)
        Root mean square of measured minus modelled flux, T.
    position_error_m, orientation_error_rad : ndarray, shape (F,)
        Against the optical pose; NaN without one.
    reason : tuple of str, length F
        In words why a frame has no pose; empty where it has one.
    """

    name: str
    stamp_ns: Integers
    time: Array
    state: NDArray[np.str_]
    position: Array
    axis: Array
    rotation: Array
    covariance: Array
    sigma_position_m: Array
    residual_t: Array
    position_error_m: Array
    orientation_error_rad: Array
    reason: tuple[str, ...]

    @property
    def ok(self) -> Booleans:
        """Return the mask (F,) of the frames that have a pose."""
        return np.asarray(self.state == OK)

    def __repr__(self) -> str:
        return f'TrackedPoses({self.name}: {self.ok.sum()} of {self.ok.size} frames have a pose)'

    def to_dataframe(self) -> Any:
        """Return a data frame of pandas with a row for each frame, columns named with units."""
        import pandas  # late: it takes half a second

        table = {'stamp_ns': self.stamp_ns, 'time_s': self.time, 'state': self.state}
        for kind, ending in (('position', '_m'), ('axis', '')):
            columns = getattr(self, kind).T
            table |= {f'{kind}_{a}{ending}': v for a, v in zip('xyz', columns, strict=True)}
        names = 'sigma_position_m', 'residual_t', 'position_error_m', 'orientation_error_rad'
        return pandas.DataFrame(table | {name: getattr(self, name) for name in names})


@dataclass(frozen=True)
class TrackingResult(Mapping[str, TrackedPoses]):
    """Holds the poses of all coils and bodies of a session: a mapping by their names.

    Attributes
    ----------
    sensors, bodies : mapping of str to TrackedPoses
        By the names of the setup document.
    figures : mapping
        Everything that ``evaluation.json`` holds.
    """

    sensors: Mapping[str, TrackedPoses]
    bodies: Mapping[str, TrackedPoses]
    figures: Mapping[str, Any]

    def __getitem__(self, name: str) -> TrackedPoses:
        """Poses of a body or, where no body has that name, of a sensor; raises KeyError."""
        found = self.bodies.get(name, self.sensors.get(name))
        if found is None:
            raise KeyError(f'no {name!r}; there are: {", ".join(self)}')
        return found

    def __iter__(self) -> Iterator[str]:
        return iter({**self.bodies, **self.sensors})

    def __len__(self) -> int:
        return len({**self.bodies, **self.sensors})

    def __repr__(self) -> str:
        return f'TrackingResult({", ".join(map(repr, (self[name] for name in self)))})'

    def to_dict(self) -> dict[str, Any]:
        """Return the errors against the optical poses, as in ``evaluation.json``."""
        return dict(self.figures)

    def to_dataframe(self) -> Any:
        """Return the data frames of all bodies and sensors as one, with a column ``name``."""
        import pandas

        tables = {name: self[name].to_dataframe() for name in self}
        return pandas.concat(tables, names=['name']).reset_index('name').reset_index(drop=True)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all arrays to an ``.npz`` file, each under ``NAME:ATTRIBUTE``."""
        arrays = {
            f'{name}:{key}': value
            for group in (self.sensors, self.bodies)
            for name, poses in group.items()
            for key, value in vars(poses).items()
            if isinstance(value, np.ndarray)
        }
        with path_of(path, 'a file to write').open('wb') as stream:
            np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]


def track(
    session: SessionSource,
    model: ModelSource,
    *,
    refit: bool = False,
    baseline: SessionSource | None = None,
    gate: float | None = None,
    progress: Progress = None,
) -> TrackingResult:
    """Track every coil and every rigid body of a session, exactly as the live nodes do.

    Parameters
    ----------
    session : Session or path
    model : Model or path
        ``nominal`` is the board as the session's setup draws it.
    refit : bool
        Whether the model follows the session's reference sensors, frame by frame.
    baseline : Session or path, optional
        Distortion-free recording of the same board; a refit needs one.
    gate : float, optional
        Largest residual of a pose in units of the expected one; the tracker's default when not
        given. Infinity refuses no pose for what the model lacks: to measure errors, never for use.
    progress : bool or callable, optional
        True shows a bar; a function is called with the finished share from 0 to 1.

    Raises
    ------
    BagError
        When the session has no tool fluxes, or a refit lacks references or a baseline.
    ParameterError
        When a baseline is given without a refit.
    ModelFileError
        When the model's emitters are not the session's.

    Examples
    --------
    >>> from anser_ros import Model, load_session, track
    >>> session = load_session('bags/moving.mcap')
    >>> result = track(session, Model.load('config/demo_model.yaml'))
    >>> tool = result['tool_a']
    >>> tool.position.shape, bool(tool.ok.all()), bool(tool.sigma_position_m.max() < 1e-3)
    ((200, 3), True, True)
    >>> result.to_dict()['bodies']['tool_a']['position_rmse_m'] < 0.2e-3
    True
    """
    stated = {} if gate is None else {'gate': float(numbers_of(gate, 'gate'))}
    settings = TrackerSettings(**stated)  # type: ignore[arg-type]
    recorded = session_given(session)
    field = field_given(model, recorded.setup)
    clean = None if baseline is None else session_given(baseline)
    with shown(progress, 'track') as tell:
        found = track_session(recorded, field, settings, clean, refit, progress=tell)
    tables: dict[str, dict[str, TrackedPoses]] = {}
    for group, series in (('sensors', found.sensors), ('bodies', found.bodies)):
        tables[group] = {name: _poses(one, recorded.start_ns) for name, one in series.items()}
    return TrackingResult(tables['sensors'], tables['bodies'], to_document(found))


def _poses(series: PoseSeries, start_ns: int) -> TrackedPoses:
    given = series.estimates
    stamps = np.array([pose.stamp_ns for pose in given], dtype=np.int64)
    unknown = np.full((3, 3), np.nan)
    turns = [unknown if pose.rotation is None else pose.rotation for pose in given]
    return TrackedPoses(
        name=series.name,
        stamp_ns=stamps,
        time=np.asarray((stamps - start_ns) * NANO),
        state=np.array([pose.state for pose in given], dtype=np.str_),
        position=np.array([pose.position for pose in given]).reshape(-1, 3),
        axis=np.array([pose.axis for pose in given]).reshape(-1, 3),
        rotation=np.array(turns).reshape(-1, 3, 3),
        covariance=np.array([pose.covariance for pose in given]).reshape(-1, 6, 6),
        sigma_position_m=np.array([pose.sigma_position_m for pose in given]),
        residual_t=np.array([pose.residual_t for pose in given]),
        position_error_m=series.position_error,
        orientation_error_rad=series.orientation_error,
        reason=tuple(pose.reason for pose in given),
    )
