"""Makes setup documents and sessions of plain data, YAML text, files and arrays."""

import os
import time as clock
from collections.abc import Mapping
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike

from anser_ros.arrays import Array, numbers_of
from anser_ros.errors import ParameterError, SetupError
from anser_ros.field.model import plain
from anser_ros.stamps import NANO
from anser_ros.wire.bag_writer import SessionWriter
from anser_ros.wire.recorded import optical_topic, unit_quaternions
from anser_ros.wire.setup import Setup, dump_setup, parse_setup
from anser_ros.wire.text_files import path_of, read_text

SetupSource = Setup | Mapping[str, Any] | str | os.PathLike[str]


def load_setup(source: SetupSource) -> Setup:
    """Check a setup document (``docs/setup.md`` explains every key).

    Parameters
    ----------
    source : Setup, mapping, str or path
        The document as plain data, as YAML text, or the path of a file that holds it (a text of
        one line that ends with .yaml or .yml is one).

    Raises
    ------
    SetupError
        With the rule that is broken and the key where it is, or when the file cannot be read.

    Examples
    --------
    >>> from pathlib import Path
    >>> from anser_ros import load_setup
    >>> setup = load_setup(Path('config/demo_setup.yaml'))
    >>> setup.bodies, len(setup.tool_sensors), len(setup.reference_sensors)
    (('tool_a',), 9, 32)
    """
    if isinstance(source, Setup):
        return source
    if isinstance(source, Mapping):
        try:
            return parse_setup(yaml.safe_dump(plain(dict(source)), sort_keys=False))
        except yaml.representer.RepresenterError as error:
            raise SetupError(
                f'a setup holds text, numbers, lists and mappings: {error}'
            ) from error
    if isinstance(source, str) and ('\n' in source or not source.endswith(('.yaml', '.yml'))):
        return parse_setup(source)
    return parse_setup(read_text(path_of(source, 'a setup document'), SetupError))


def write_session(
    path: str | os.PathLike[str],
    setup: SetupSource,
    times: ArrayLike,
    flux: ArrayLike,
    poses: Mapping[str, tuple[ArrayLike, ArrayLike, ArrayLike]] | None = None,
    *,
    start_ns: int | None = None,
    overwrite: bool = False,
) -> None:
    """Write your own arrays as a session that every command reads.

    Parameters
    ----------
    path : str or path
        The ``.mcap`` file to write; its folder is made if missing.
    setup : Setup, mapping, str or path
        As for `load_setup`.
    times : array_like, shape (F,)
        Middle of each demodulation window, s, ascending, from any origin.
    flux : array_like, shape (F, S, K), complex
        Flux density along each coil's axis, T at nominal current: S sensors in the order of
        ``setup.sensors`` (reference sensors among them), K emitters in the order of the setup's
        coils. NaN where there is no reading: the sensor is flagged stale, unless the emitter is
        NaN for all tools' sensors, or for all references, and so had no current. The bag stores
        single precision.
    poses : mapping of str to (times, positions, quaternions), optional
        Optical poses of bodies: times (M,) in s on the origin of ``times``, positions (M, 3) of
        the body's origin in fg in m, unit quaternions x y z w (M, 4) from body to fg. Their rate
        may differ from the fluxes'.
    start_ns : int, optional
        Stamp of time 0, ns. By default the present time; a diagnosis distinguishes sessions by it.
    overwrite : bool
        Whether a file that is there already is replaced.

    Raises
    ------
    SetupError
        When the setup breaks a rule.
    ParameterError
        When shapes do not match, times do not ascend, a body is not in the setup, or a quaternion
        is not of unit length.
    BagError
        When the file is there already, or cannot be written.

    Examples
    --------
    A board of one loop, and a coil 10 cm above it that rests for five readings:

    >>> import numpy as np
    >>> from anser_ros import load_session, write_session
    >>> setup = {
    ...     'schema': 'anser_setup/1',
    ...     'flux_rate_hz': 50.0,
    ...     'emitter': {
    ...         'kind': 'circular_loop', 'radius_m': 0.05, 'turns': 100, 'current_a': 0.1,
    ...         'coils': [{'name': 'k0', 'centre_m': [0, 0, 0], 'frequency_hz': 1000}],
    ...     },
    ...     'sensors': [
    ...         {'channel': 0, 'name': 'pen/tip', 'body': 'pen',
    ...          'position_m': [0, 0, 0], 'axis': [0, 0, 1]},
    ...     ],
    ... }
    >>> times = np.arange(5) / 50.0
    >>> flux = np.full((5, 1, 1), 2e-6 + 0j)
    >>> still = np.tile([0.0, 0.0, 0.1], (5, 1)), np.tile([0.0, 0.0, 0.0, 1.0], (5, 1))
    >>> write_session('own.mcap', setup, times, flux, {'pen': (times, *still)}, overwrite=True)
    >>> load_session('own.mcap').tools[0].flux.shape
    (5, 1, 1)
    """
    file, checked = path_of(path, 'a file to write'), load_setup(setup)
    seconds = _ascending(times, 'times')
    try:
        values = np.asarray(flux, dtype=np.complex128)
    except (TypeError, ValueError) as error:
        raise ParameterError(f'flux must be complex numbers: {error}') from error
    wanted = (seconds.size, len(checked.sensors), len(checked.emitter.coils))
    if values.shape != wanted:
        raise ParameterError(
            f'flux must be (times, sensors, coils) = {wanted} by the setup, got {values.shape}'
        )
    tracks = poses_given(checked, poses or {})
    origin = clock.time_ns() if start_ns is None else start_ns
    stamps = [origin + round(t / NANO) for t in seconds.tolist()]
    pose_stamps = {
        body: [origin + round(t / NANO) for t in track[0].tolist()]
        for body, track in tracks.items()
    }
    if min([stamps[0], *(s[0] for s in pose_stamps.values())]) <= 0:
        raise ParameterError('a stamp is not positive: give a larger start_ns')
    if overwrite:
        file.unlink(missing_ok=True)
    with SessionWriter(file, checked.frame_id) as writer:
        writer.write_setup(dump_setup(checked), stamps[0])
        for stamp, frame in zip(stamps, values, strict=True):
            writer.write_readings(checked.sensors, stamp, frame)
        for body, (_, position, quaternion) in tracks.items():
            topic = optical_topic(body)
            listed = zip(pose_stamps[body], position.tolist(), quaternion.tolist(), strict=True)
            for stamp, place, turn in listed:
                writer.write_pose(topic, stamp, place, turn)


def _ascending(times: ArrayLike, what: str) -> Array:
    seconds = numbers_of(times, what)
    if seconds.ndim != 1 or seconds.size == 0 or not np.isfinite(seconds).all():
        raise ParameterError(f'{what} must be a list of finite numbers, got {seconds.shape}')
    if not (np.diff(seconds) > 0.0).all():
        raise ParameterError(f'{what} must ascend')
    return seconds


def poses_given(
    setup: Setup, poses: Mapping[str, tuple[ArrayLike, ArrayLike, ArrayLike]]
) -> dict[str, tuple[Array, Array, Array]]:
    """Return poses of bodies as arrays; raises `ParameterError` where they are none."""
    checked = {}
    for body, given in poses.items():
        if not isinstance(given, tuple | list) or len(given) != 3:
            raise ParameterError(f'poses of {body} must be times, positions and quaternions')
        times, positions, quaternions = given
        if body not in setup.bodies:
            raise ParameterError(f'no body {body!r} in the setup: {", ".join(setup.bodies)}')
        seconds = _ascending(times, f'times of {body}')
        position = numbers_of(positions, f'positions of {body}')
        quaternion = numbers_of(quaternions, f'quaternions of {body}')
        if position.shape != (seconds.size, 3) or quaternion.shape != (seconds.size, 4):
            raise ParameterError(
                f'poses of {body} need positions ({seconds.size}, 3) and quaternions '
                f'({seconds.size}, 4), got {position.shape} and {quaternion.shape}'
            )
        quaternion = unit_quaternions(quaternion)
        if not (np.isfinite(position).all() and np.isfinite(quaternion).all()):
            raise ParameterError(
                f'poses of {body} must be finite, with quaternions of unit length'
            )
        checked[body] = (seconds, position, quaternion)
    return checked
