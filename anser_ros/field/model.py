"""Defines the field model that all packages share: its dipoles, and its document.

Virtual dipoles with moments for each emitter, where their field is uncertain (in the gaps of the
scan that it was fitted to), and what reference sensors read without metal when it was calibrated.

The octupole of sources on an axis, about their middle, is that of their second moment: the mean
square distance from the middle, weighted by the moments. It is negative where moments beside the
middle are of the opposite sign, as those are that stand for a flat coil.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from anser_ros.arrays import Array, ComplexArray, as_complex, as_real, numbers_of
from anser_ros.errors import ModelFileError
from anser_ros.field.measurements import frame_power
from anser_ros.fingerprint import Identity, fingerprint_of
from anser_ros.physics.dipole import dipole_field, flux_basis
from anser_ros.physics.rotations import unturned
from anser_ros.physics.sensor import along_each_axis


@dataclass(frozen=True)
class Dipoles:
    """Holds a set of N dipoles with one moment for each of K emitters."""

    positions: Array  # (N, 3), m, frame fg
    directions: Array  # (N, 3), unit vectors, frame fg
    moments: ComplexArray  # (N, K), along these at each emitter's nominal current, A m^2

    @staticmethod
    def none(emitters: int) -> 'Dipoles':
        """Return the empty set for a number of emitters."""
        empty = np.zeros((0, 3))
        return Dipoles(empty, empty, np.zeros((0, emitters), dtype=complex))

    @staticmethod
    def vectors(points: Array, moments: ComplexArray) -> 'Dipoles':
        """Return dipoles with vector moments (M, 3, K), A m^2: rows x, y, z of each point (m)."""
        flat = np.ascontiguousarray(moments.reshape(3 * len(points), -1))
        return Dipoles(*along_each_axis(points), flat)

    def joined(self, other: 'Dipoles') -> 'Dipoles':
        """Return the union of these dipoles and the others."""
        return Dipoles(
            np.concatenate([self.positions, other.positions]),
            np.concatenate([self.directions, other.directions]),
            np.concatenate([self.moments, other.moments]),
        )

    def field(self, points: Array) -> ComplexArray:
        """Return each emitter's field, shape (P, 3, K), T, at points, shape (P, 3), m."""
        return dipole_field(points, self.positions, self.directions, self.moments)

    def flux(self, points: Array, axes: Array, lengths: Array | None) -> ComplexArray:
        """Return each emitter's flux (P, K), T, along unit axes at places, m, (P, 3) in fg."""
        basis = flux_basis(points, axes, lengths, self.positions, self.directions)
        return np.asarray(basis @ self.moments)


FARTHEST_M = 10.0
"""Coordinate, m, in a board's frame that is meant in mm: a tracked volume is below 1."""

OFF_AXIS = 1e-6
"""Moment across the axis, of the whole, and distance, m, up to which a dipole is on the axis."""
STEP_M = 1e-3
"""Way along the axis, m, of a second difference: 0.3 % at 3 cm; far less shows rounding."""


@dataclass(frozen=True)
class SymmetryAxis:
    """Describes an axis of rotation that leaves a field as it is."""

    # (3,), the middle of the sources on it, m, frame fg: that of their moments, about which their
    # field has no quadrupole
    point: Array
    direction: Array  # (3,), unit vector; the first emitter's moment points along it
    second_moment_m2: float  # Of the sources about the middle, along the axis, m^2


def symmetry_axis(
    positions: Array, directions: Array, moments: ComplexArray
) -> SymmetryAxis | None:
    """Return the axis on which all dipoles lie and along which all moments point, if there is one.

    Positions (m) and unit directions (N, 3) are in the frame fg, moments (N, K) in A m^2.
    """
    power = (moments.real**2 + moments.imag**2).sum(axis=1)
    used = power > OFF_AXIS**2 * power.max()
    if not used.any():
        return None
    places = positions[used]
    offsets = places - places[0]
    squares = (offsets * offsets).sum(axis=1)
    far = offsets[squares.argmax()]
    across = squares * (far @ far) - (offsets @ far) ** 2
    if across.max() > (10.0 * OFF_AXIS) ** 2 * (far @ far):  # most fields: they are on no line
        return None
    vectors = (moments.real @ np.ones(moments.shape[1]))[:, None] * directions
    total = vectors.sum(axis=0)
    if np.linalg.norm(total) < OFF_AXIS * np.abs(moments).sum():
        return None
    axis = total / np.linalg.norm(total)
    weight = vectors[used] @ axis
    middle = weight @ places / weight.sum()
    away = places - middle
    along = away @ axis
    away -= np.outer(along, axis)
    if np.abs(away).max() > OFF_AXIS:
        return None
    # Dipoles at one place count together: three components of one vector may point anywhere.
    whole = np.einsum('nk,ni->ki', moments, directions)
    keys = np.round(places / OFF_AXIS).astype(np.int64)
    for place in np.unique(keys, axis=0):
        here = np.flatnonzero(used)[(keys == place).all(axis=1)]
        vector = np.einsum('nk,ni->ki', moments[here], directions[here])
        across = vector - np.einsum('ki,i->k', vector, axis)[:, None] * axis
        if np.linalg.norm(across) > OFF_AXIS * np.linalg.norm(whole):
            return None
    return SymmetryAxis(middle, axis, float(weight @ along**2 / weight.sum()))


def spread_along(base: Dipoles, emitter: int, axis: Array, second_moment_m2: float) -> Dipoles:
    """Return dipoles that give an emitter a second moment along an axis besides its own.

    Their field is half the second moment times the second derivative, along the axis, of the
    field that the emitter has by ``base``: three dipoles, without a moment together, for each.
    """
    only = np.zeros_like(base.moments)
    only[:, emitter] = base.moments[:, emitter] * (second_moment_m2 / (2.0 * STEP_M**2))
    used = np.flatnonzero(only.any(axis=1))
    place, moments, step = base.positions[used], only[used], STEP_M * axis
    return Dipoles(
        np.concatenate([place + step, place, place - step]),
        np.tile(base.directions[used], (3, 1)),
        np.concatenate([moments, -2.0 * moments, moments]),
    )


def size_figures(
    second_moment_m2: float, sigma_m2: float
) -> tuple[dict[str, float], dict[str, float]]:
    """Return a second moment with the size of a source that has it, and their uncertainties.

    A positive one is that of a thin magnet, along its axis, of length L, L^2 / 12; a negative one
    that of a flat disc of diameter D, magnetised across, -D^2 / 16.
    """
    key, share = ('length_m', 12.0) if second_moment_m2 >= 0.0 else ('diameter_m', 16.0)
    size = float(np.sqrt(share * abs(second_moment_m2)))
    # Near zero a size is known only to be below the root of its square's uncertainty.
    sigma = share * sigma_m2 / max(2.0 * size, np.sqrt(share * sigma_m2), 1e-300)
    return (
        {'second_moment_m2': second_moment_m2, key: size},
        {'second_moment_m2': sigma_m2, key: float(sigma)},
    )


def plain(value: Any) -> Any:
    """Return the value as JSON and YAML know it: lists, Python's numbers, keys as strings.

    A complex number becomes the list of its real and imaginary part.
    """
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, complex):
        return [value.real, value.imag]
    return value


@dataclass(frozen=True)
class ReferenceReadings:
    """Holds mean readings of the reference sensors while nothing distorted the field."""

    name: tuple[str, ...]  # length R
    # (R, 3), surveyed places, m, frame fg: a sensor that is elsewhere now reads something else
    position: Array
    axis: Array  # (R, 3), surveyed unit axes
    flux: ComplexArray  # (R, K), T
    sigma_t: float  # Noise of a component of these means, T


def readings_document(readings: ReferenceReadings) -> dict[str, Any]:
    """Return readings as plain lists and mappings, a row per sensor."""
    rows = np.concatenate([readings.position, readings.axis, as_real(readings.flux)], axis=1)
    return {
        'sigma_t': readings.sigma_t,
        'sensors': [
            {'name': name, 'row': row}
            for name, row in zip(readings.name, rows.tolist(), strict=True)
        ],
    }


def parse_readings(document: Any, emitters: int) -> ReferenceReadings:
    """Return what `readings_document` wrote; raises `ModelFileError` with the rule it breaks."""
    try:
        sensors = document['sensors']
        names = tuple(str(item['name']) for item in sensors)
        rows = _table([item['row'] for item in sensors], 6 + 2 * emitters, 'references')
        sigma = float(document['sigma_t'])
    except (KeyError, TypeError, ValueError) as error:
        raise ModelFileError(f'model: references are malformed: {error}') from error
    if not 0.0 <= sigma < np.inf:
        raise ModelFileError('model: references hold values that are not finite')
    flux = as_complex(rows[:, 6:])
    return ReferenceReadings(names, rows[:, :3].copy(), rows[:, 3:6].copy(), flux, sigma)


@dataclass(frozen=True, eq=False)
class ScanGaps:
    """Holds what a scan leaves open of the field, alike for all emitters."""

    positions: Array  # (N, 3), of dipoles, m, frame fg
    directions: Array  # (N, 3), unit vectors, frame fg
    # (R, N), A m^2. The variance of a phasor component of any emitter's flux is the sum of the
    # squares of the fluxes of these R combinations of the dipoles.
    moments: Array

    def sigma_t(self, points: Array, axes: Array, lengths: Array) -> Array:
        """Return how far the modelled flux may be off, T a phasor component, shape (F, S).

        Sensor centres (m) and unit axes (F, S, 3) are in the frame fg, coil ``lengths`` (S,) in m.
        """
        frames, sensors = points.shape[:2]
        basis = flux_basis(
            points.reshape(-1, 3), axes.reshape(-1, 3), np.tile(lengths, frames),
            self.positions, self.directions,
        )  # fmt: skip
        squares = np.sum((basis @ self.moments.T) ** 2, axis=1)
        return np.asarray(np.sqrt(squares).reshape(frames, sensors))


def parse_gaps(document: Any) -> ScanGaps:
    """Return gaps of a row per dipole: place, direction, R moments; raises `ModelFileError`."""
    table = _table(document, 7, 'gaps', is_least=True)
    return ScanGaps(table[:, :3].copy(), table[:, 3:6].copy(), table[:, 6:].T.copy())


@dataclass(frozen=True)
class OpenArm:
    """States how a body stood, whose lever arm its scan does not determine."""

    sigma_m: float  # standard deviation of the arm along each axis, in the model's shift
    turn: Array  # (3, 3), mean of the rotation matrices of the scan, body to fg
    axes_rad: float = 0.0  # standard deviation about each axis of a turn that all its coils share


SCHEMA = 'anser_model/1'
ERRORS = ('flux_error_t', 'shift_sigma_m', 'noise_t', 'error_share')
"""What a model states of its own errors, by the names of its fields, which files use too."""
SESSION = 'session'
"""Parameter of an effect that holds in one of several sessions alone: its name."""


@dataclass(frozen=True)
class EffectRecord:
    """Records one effect that a model corrects."""

    name: str  # name of the effect
    # its parameters in SI units unless their names have another unit
    parameters: Mapping[str, Any]
    # standard deviations of the parameters, under the same keys
    uncertainty: Mapping[str, Any] = field(default_factory=dict)
    evidence: Mapping[str, Any] = field(default_factory=dict)  # figures that support the effect

    @property
    def channels(self) -> list[Any]:
        """Return the channels of the sensors that the effect names."""
        given = (self.parameters.get(key, ()) for key in ('channel', 'channels'))
        return [channel for one in given for channel in np.ravel(one).tolist()]

    def needed(self, key: str) -> Any:
        """Return a parameter; raises `ModelFileError` when it is missing."""
        try:
            return self.parameters[key]
        except KeyError:
            raise ModelFileError(f'model: the effect {self.name} lacks {key!r}') from None


@dataclass(frozen=True)
class FieldModel:
    """Represents the field generator and all that distorts its field by virtual dipoles.

    Raises `ModelFileError` when the shapes do not fit together or there is no dipole.
    """

    # (N, 3), positions (m) and unit vectors, frame fg. A dipole whose three components are free
    # takes three rows
    positions: Array
    directions: Array
    moments: ComplexArray  # (N, K), complex, moments at each emitter's nominal current, A m^2
    emitters: tuple[str, ...]  # length K, names of the emitters
    frequencies_hz: tuple[float, ...]  # length K, their drive frequencies, Hz
    # standard deviation of the model's own error, T a phasor component, in the volume that it was
    # fitted in (from held-out data, with noise and pose jitter subtracted)
    flux_error_t: float = 0.0
    # (R, N, K), complex, or None, low-rank factor of the moments' covariance. The variance of the
    # field is the sum of the squares of the R fields of these moments; real and imaginary part of
    # a mode vary together
    modes: ComplexArray | None = None
    # corrections of measured fluxes, sensors or the optical frame that belong to this model.
    # Effects on the field itself are already in the dipoles
    effects: tuple[EffectRecord, ...] = ()
    # how the model was made, with its held-out error
    provenance: Mapping[str, Any] = field(default_factory=dict)
    # board and bodies that it was calibrated on, or its effects were found on; None if not stated
    made_for: Identity | None = None
    references: ReferenceReadings | None = None  # what the references read when it was calibrated
    # standard deviation along each axis, m, of a shift that all places in the field share: what
    # the calibration could not tell between the field and where the tool's sensors are
    shift_sigma_m: float = 0.0
    # by body, for those whose lever arm is part of that, how they stood then
    open_arms: Mapping[str, OpenArm] = field(default_factory=dict)
    # by how much the field may be off where the scan has gaps, beyond ``flux_error_t``
    gaps: ScanGaps | None = None
    # noise of a phasor component that the calibration found, with what its fit misses beyond that
    # error, T; 0 if none was
    noise_t: float = 0.0
    # by which share of a strong flux the field errs beyond ``flux_error_t``, which is typical
    error_share: float = 0.0

    def __post_init__(self) -> None:
        n, k = self.positions.shape[0], len(self.emitters)
        if self.positions.shape != (n, 3) or self.directions.shape != (n, 3) or n == 0:
            raise ModelFileError(
                f'model: positions {self.positions.shape} and directions {self.directions.shape} '
                'must both be (N, 3) with N of at least 1'
            )
        if self.moments.shape != (n, k) or len(self.frequencies_hz) != k:
            raise ModelFileError(
                f'model: moments {self.moments.shape} and {len(self.frequencies_hz)} frequencies '
                f'must fit {n} dipoles and {k} emitters'
            )
        if self.modes is not None and self.modes.shape[1:] != (n, k):
            raise ModelFileError(f'model: modes {self.modes.shape} must be (R, {n}, {k})')

    @cached_property
    def fingerprint(self) -> str:
        """Return the model's short name, of all that poses follow from but ``error_t``."""
        return fingerprint_of(
            [
                self.positions, self.directions, self.moments, self.emitters, self.frequencies_hz,
                self.flux_error_t, self.modes,
                [[effect.name, plain(dict(effect.parameters))] for effect in self.effects],
                *(value for value in (self.shift_sigma_m, self.noise_t) if value),
                *(v for a in self.open_arms.values() for v in (a.sigma_m, a.turn)),
                *(a.axes_rad for a in self.open_arms.values() if a.axes_rad),
            ]
        )  # fmt: skip

    def flux(self, points: Array, axes: Array, lengths: Array | None = None) -> ComplexArray:
        """Return each emitter's flux (..., K), T, along unit axes at places, m, in fg."""
        spans = None if lengths is None else np.broadcast_to(lengths, points.shape[:-1]).ravel()
        flux = self.dipoles.flux(points.reshape(-1, 3), axes.reshape(-1, 3), spans)
        return flux.reshape(*points.shape[:-1], len(self.emitters))

    def error_t(self, points: Array, axes: Array, lengths: Array) -> Array:
        """Return how far the flux may be off at places beyond ``flux_error_t``, (F, S), T a
        phasor component. Sensor centres (m) and unit axes (F, S, 3) are in fg, ``lengths`` (S,).
        """
        gaps = self.gaps
        error = np.zeros(points.shape[:2]) if gaps is None else gaps.sigma_t(points, axes, lengths)
        if self.error_share == 0.0:
            return error
        power = frame_power(self.flux(points, axes, lengths))[:, None]
        return np.asarray(np.hypot(error, self.error_share * np.sqrt(power)))

    def __repr__(self) -> str:
        return f'FieldModel({len(self.positions)} dipoles, emitters {", ".join(self.emitters)})'

    def __call__(self, points: ArrayLike) -> ComplexArray:
        """Return each emitter's field (..., 3, K), T, at points (..., 3), m, both in fg.

        Raises `ParameterError` when the points are of another shape, no numbers or too far.
        """
        places = numbers_of(points, 'points', 3, FARTHEST_M)
        fields = self.dipoles.field(places.reshape(-1, 3))
        return fields.reshape(*places.shape, len(self.emitters))

    @property
    def dipoles(self) -> Dipoles:
        """Return the dipoles alone."""
        return Dipoles(self.positions, self.directions, self.moments)

    def turned(self, turn: Array, shift: Array) -> 'FieldModel':
        """Return this model where its field is turned about fg's origin by a rotation matrix, then
        shifted (3,), m.
        """

        def stands(one: Any) -> Any:
            place, direction = one.positions @ turn.T + shift, one.directions @ turn.T
            return replace(one, positions=place, directions=direction)

        arms = {b: replace(a, turn=turn @ a.turn) for b, a in self.open_arms.items()}
        whole: FieldModel = replace(stands(self), open_arms=arms)
        return whole if self.gaps is None else replace(whole, gaps=stands(self.gaps))

    def shift_covariance(self, body: str, rotation: Array | None) -> Array:
        """Return the covariance (6, 6), m and rad, that poses of a body turned so, and of its
        coils, share.

        An open lever arm's error has shifted the field as the scan had the body, and a turn of all
        its coils has turned it, about what the scan did not turn. A pose is off by what these are
        now beside that: by nothing where the body is turned as it was.
        """
        known, arm = np.zeros((6, 6)), self.open_arms.get(body)
        np.fill_diagonal(known[:3, :3], self.shift_sigma_m**2)
        if arm is None or rotation is None:
            return known
        away = arm.turn - rotation
        known[:3, :3] += arm.sigma_m**2 * (away @ away.T - np.eye(3))
        turned = away @ unturned(arm.turn).T
        known[3:, 3:] = arm.axes_rad**2 * turned @ turned.T
        return known

    def with_dipoles(
        self, positions: Array, directions: Array, moments: ComplexArray
    ) -> 'FieldModel':
        """Return this model with M more dipoles, whose moments (M, K), A m^2, count as certain."""
        modes = self.modes
        if modes is not None:
            modes = np.pad(modes, ((0, 0), (0, len(positions)), (0, 0)))
        whole = self.dipoles.joined(Dipoles(positions, directions, moments))
        return replace(self, **vars(whole), modes=modes)


def to_document(model: FieldModel) -> dict[str, Any]:
    """Return the model as plain lists and mappings, ready to be written to a text file."""
    table = np.concatenate([model.positions, model.directions, as_real(model.moments)], axis=1)
    document: dict[str, Any] = {
        'schema': SCHEMA,
        'fingerprint': model.fingerprint,
        **({} if model.made_for is None else {'made_for': plain(asdict(model.made_for))}),
        'frame_id': 'fg',
        'units': {'position': 'm', 'direction': '1', 'moment': 'A m^2', 'frequency': 'Hz',
                  'flux': 'T'},
        'emitters': [
            {'name': name, 'frequency_hz': frequency}
            for name, frequency in zip(model.emitters, model.frequencies_hz, strict=True)
        ],
        'provenance': dict(model.provenance),
        **{name: getattr(model, name) for name in ERRORS},
        'effects': [plain(asdict(effect)) for effect in model.effects],
        'columns': ['x', 'y', 'z', 'ux', 'uy', 'uz']
        + [f'm{k}_{part}' for k in range(len(model.emitters)) for part in ('re', 'im')],
        'dipoles': table.tolist(),
    }  # fmt: skip
    if model.open_arms:
        document['open_arms'] = plain({body: asdict(a) for body, a in model.open_arms.items()})
    if model.references is not None:
        document['references'] = readings_document(model.references)
    if model.gaps is not None:
        columns = [model.gaps.positions, model.gaps.directions, model.gaps.moments.T]
        document['gaps'] = np.concatenate(columns, axis=1).tolist()
    if model.modes is not None:
        document['modes'] = as_real(model.modes).tolist()
    return document


def _table(value: Any, width: int, what: str, is_least: bool = False) -> Array:
    """Rows of so many finite numbers, or of so many at least; raises `ModelFileError`."""
    try:
        table = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ModelFileError(f'model: {what} is not a table of numbers') from error
    given = table.shape[1] if table.ndim == 2 and len(table) else 0
    if given < width or (given > width and not is_least):
        least = 'at least ' if is_least else ''
        words = f'must be rows of {least}{width} numbers, got {table.shape}'
        raise ModelFileError(f'model: {what} {words}')
    if not np.isfinite(table).all():
        raise ModelFileError(f'model: {what} holds values that are not finite')
    return table


def _effect(item: Any) -> EffectRecord:
    if not isinstance(item, dict) or not isinstance(item.get('name'), str):
        raise ModelFileError(f'model: an effect needs a name, got {item!r}')
    parts = [item.get(key) or {} for key in ('parameters', 'uncertainty', 'evidence')]
    if not all(isinstance(part, dict) for part in parts):
        raise ModelFileError(f'model: effect {item["name"]!r} needs mappings of parameters')
    return EffectRecord(item['name'], *parts)


def _made_for(item: Any) -> Identity | None:
    if item is None:
        return None
    bodies = item.get('bodies') if isinstance(item, dict) else None
    if not isinstance(bodies, dict) or not isinstance(item.get('board'), str):
        raise ModelFileError(f'model: made_for must name a board and bodies, got {item!r}')
    return Identity(item['board'], {str(body): str(value) for body, value in bodies.items()})


def from_document(document: Any) -> FieldModel:
    """Return the field model that a document holds; raises `ModelFileError` with the rule."""
    if not isinstance(document, dict) or document.get('schema') != SCHEMA:
        got = document.get('schema') if isinstance(document, dict) else document
        raise ModelFileError(f'model: schema must be {SCHEMA!r}, got {got!r}')
    emitters = document.get('emitters')
    if not isinstance(emitters, list) or not emitters:
        raise ModelFileError('model: emitters must be a list of at least one')
    try:
        names = tuple(str(item['name']) for item in emitters)
        frequencies = tuple(float(item['frequency_hz']) for item in emitters)
        errors = {name: float(document.get(name, 0.0)) for name in ERRORS}
        arms = {
            str(body): OpenArm(
                float(arm['sigma_m']),
                np.array(arm['turn'], float).reshape(3, 3),
                float(arm.get('axes_rad', 0.0)),
            )
            for body, arm in dict(document.get('open_arms') or {}).items()
        }
    except (KeyError, TypeError, ValueError) as error:
        raise ModelFileError(
            f'model: an emitter, error, noise_t, shift_sigma_m or open_arms is malformed: {error}'
        ) from error
    k = len(names)
    table = _table(document.get('dipoles'), 6 + 2 * k, 'dipoles')
    norms = np.linalg.norm(table[:, 3:6], axis=1)
    if np.abs(norms - 1.0).max() > 1e-6:
        raise ModelFileError('model: a dipole direction is not a unit vector')
    modes = None
    if document.get('modes'):
        parts = [_table(mode, 2 * k, 'modes') for mode in document['modes']]
        if any(part.shape[0] != table.shape[0] for part in parts):
            raise ModelFileError('model: every mode needs one row a dipole')
        modes = as_complex(np.array(parts))
    effects = document.get('effects') or []
    if not isinstance(effects, list):
        raise ModelFileError('model: effects must be a list')
    provenance = document.get('provenance') or {}
    if not isinstance(provenance, dict):
        raise ModelFileError('model: provenance must be a mapping')
    references, gaps = document.get('references'), document.get('gaps')
    model = FieldModel(
        positions=table[:, :3].copy(), directions=table[:, 3:6].copy(),
        moments=as_complex(table[:, 6:]), emitters=names, frequencies_hz=frequencies, **errors,
        open_arms=arms, modes=modes, effects=tuple(_effect(item) for item in effects),
        provenance=provenance, made_for=_made_for(document.get('made_for')),
        references=None if references is None else parse_readings(references, k),
        gaps=None if gaps is None else parse_gaps(gaps),
    )  # fmt: skip
    stated = document.get('fingerprint')
    if stated is not None and str(stated) != model.fingerprint:
        raise ModelFileError(
            f'model: the file states the fingerprint {stated}, but its content has '
            f'{model.fingerprint}; was it changed? Remove the key fingerprint to use it all the '
            'same'
        )
    return model
