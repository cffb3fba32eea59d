"""Offers what a layout of coils is designed with: simulated sessions, pictures of fields."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from anser_ros.api.model import Model, ModelSource, field_given
from anser_ros.api.recording import SetupSource, load_setup, poses_given
from anser_ros.arrays import Array, numbers_of
from anser_ros.errors import ParameterError
from anser_ros.physics.pose_track import PoseTrack
from anser_ros.sessions.plausibility import check_distance
from anser_ros.sessions.session import MOST_NOISE_T, Session, session_of
from anser_ros.settings import Accuracy
from anser_ros.simulation.world import Path, World, board_source
from anser_ros.stamps import SECOND_NS
from anser_ros.wire.recorded import Bag, PoseStream, RecordedFluxes
from anser_ros.wire.setup import SensorRows, dump_setup

Poses = tuple[ArrayLike, ArrayLike, ArrayLike]


def simulate(
    setup: SetupSource,
    path: Poses | Mapping[str, Poses],
    noise: float = Accuracy.flux_noise_t,
    *,
    model: ModelSource | None = None,
    seed: int = 0,
) -> Session:
    """Simulate what the sensors of a setup read while tools move.

    Parameters
    ----------
    setup : Setup, mapping, str or path
        As for `load_setup`.
    path : (times, positions, quaternions), or mapping of body to such
        Times (F,), s, ascending; at each there is a frame. Positions (F, 3) of the body's origin
        in fg, m, and unit quaternions x y z w (F, 4) from body to fg. Without a body's name the
        setup's first body moves; all bodies are stated, at the same times.
    noise : float
        Standard deviation of a component of each flux, T.
    model : Model or path, optional
        Field that is measured; by default that of the board as the setup draws it.
    seed : int
        Of the noise: the same seed makes the same session.

    Returns
    -------
    Session
        As if it was recorded, with the exact poses as the optical ones.

    Raises
    ------
    SetupError
        When the setup breaks a rule, or its emitter kind is not one of known geometry.
    ParameterError
        When the path does not fit the setup, or the noise is negative.
    PlausibilityError
        When tools are nowhere near the board.

    Examples
    --------
    >>> from anser_ros import Model, simulate, track
    >>> times, still = [0.0, 0.1, 0.2], [[0.0, 0.0, 0.15]] * 3
    >>> path = times, still, [[0.0, 0.0, 0.0, 1.0]] * 3
    >>> session = simulate('config/demo_setup.yaml', path)
    >>> tool = track(session, Model.nominal(session.setup))['tool_a']
    >>> bool(tool.position_error_m.max() < 0.2e-3)
    True
    """
    checked = load_setup(setup)
    if not checked.bodies:
        raise ParameterError('the setup has no body that moves')
    tracks = poses_given(checked, path if isinstance(path, Mapping) else {checked.bodies[0]: path})
    times = next((track[0] for track in tracks.values()), np.zeros(0))
    if not all(
        body in tracks and np.array_equal(tracks[body][0], times) for body in checked.bodies
    ):
        raise ParameterError(f'poses at the same times of {", ".join(checked.bodies)} are wanted')
    if not 0.0 <= numbers_of(noise, 'noise') < MOST_NOISE_T:
        raise ParameterError(f'noise must be T, 0 or more and below {MOST_NOISE_T}, got {noise}')
    source = board_source(checked) if model is None else field_given(model, checked)
    paths = {body: _moving(PoseTrack(*track)) for body, track in tracks.items()}
    if not isinstance(seed, int | np.integer) or seed < 0:
        raise ParameterError(f'seed must be a whole number, 0 or more, got {seed!r}')
    world, rng = World(checked, source, paths=paths), np.random.default_rng(seed)
    flux = np.array([world.flux(time) for time in times.tolist()])
    flux += noise * rng.normal(size=(*flux.shape, 2)).view(complex)[..., 0]
    stamps = SECOND_NS + np.round((times - times[0]) * SECOND_NS).astype(np.int64)
    flags = np.zeros(flux.shape[:2], dtype=np.int64)
    stream = RecordedFluxes(stamps, SensorRows.of(checked.sensors).channel, flags, flux)
    optical = {body: PoseStream(stamps, *track[1:]) for body, track in tracks.items()}
    session = session_of(Bag('simulated', checked, dump_setup(checked), stream, stream, optical))
    for tool in session.tools:
        check_distance('path', checked, tool)
    return session


def _moving(track: PoseTrack) -> Path:
    def pose(time_s: float) -> tuple[Array, Array]:
        position, rotation, _ = track.at(np.array([time_s]))
        return position[0], rotation[0]

    return pose


PLANES = {'x': (1, 2), 'y': (0, 2), 'z': (0, 1)}
"""Axes of a plane by its normal."""


def plot_field(
    model: ModelSource,
    emitter: int | str = 0,
    *,
    normal: str = 'y',
    at_m: float = 0.0,
    axes: Any = None,
) -> Any:
    """Draw the field of an emitter in a plane, up to 20 cm from the board's middle along each axis
    and from 2 cm above it on: its strength, and the lines that it follows.

    Parameters
    ----------
    model : Model
    emitter : int or str
        Its place in ``model.emitters``, or its name.
    normal : str
        Axis of fg across the plane, ``x``, ``y`` or ``z``.
    at_m : float
        Where the plane crosses that axis, m.
    axes : matplotlib.axes.Axes, optional
        Where it is drawn; by default in a new figure.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    ParameterError
        When the model has no such emitter, or the plane is none.

    Examples
    --------
    >>> from anser_ros import Model, plot_field
    >>> axes = plot_field(Model.load('config/demo_model.yaml'), 'coil3')
    >>> axes.get_xlabel(), axes.get_ylabel()
    ('x, mm', 'z, mm')
    """
    from matplotlib import pyplot  # late: it takes a second
    from matplotlib.colors import LogNorm

    field = Model.load(model).field
    names = field.emitters
    column = names.index(emitter) if emitter in names else emitter
    if not (isinstance(column, int) and 0 <= column < len(names)):
        raise ParameterError(f'no emitter {emitter!r}; there are: {", ".join(names)}')
    if normal not in PLANES or not np.isfinite(numbers_of(at_m, 'at_m')):
        raise ParameterError(f'normal must be x, y or z, at_m finite, got {normal!r}, {at_m}')
    across, up = PLANES[normal]
    right = np.linspace(-0.2, 0.2, 61)
    top = right if normal == 'z' else np.linspace(0.02, 0.2, 61)
    points = np.full((61, 61, 3), at_m)
    points[..., across], points[..., up] = np.meshgrid(right, top)
    vectors = field(points)[..., column].real
    if axes is None:
        axes = pyplot.subplots(layout='constrained')[1]
    strength = np.linalg.norm(vectors, axis=-1)
    drawn = axes.pcolormesh(1e3 * right, 1e3 * top, strength, norm=LogNorm(), shading='gouraud')
    flow = vectors[..., across], vectors[..., up]
    axes.streamplot(1e3 * right, 1e3 * top, *flow, color='white', linewidth=0.5, density=0.8)
    axes.figure.colorbar(drawn, ax=axes, label=f'field of {names[column]}, T')
    axes.set(xlabel=f'{"xyz"[across]}, mm', ylabel=f'{"xyz"[up]}, mm', aspect='equal')
    return axes
