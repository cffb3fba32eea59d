"""Defines the field model that all rooms share: virtual dipoles with moments for each emitter."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import ModelFileError
from anser_ros.field.gaps import ScanGaps, gaps_document, parse_gaps
from anser_ros.field.plain_data import plain
from anser_ros.field.reference_readings import (
    ReferenceReadings,
    parse_readings,
    readings_document,
)
from anser_ros.fingerprint import Identity, fingerprint_of
from anser_ros.physics.dipole import flux_basis

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

SCHEMA = 'anser_model/1'


@dataclass(frozen=True)
class EffectRecord:
    """Records one effect that a model corrects.

    Attributes
    ----------
    name : str
        Name of the effect.
    parameters : mapping
        Its parameters in SI units unless their names have another unit.
    uncertainty : mapping
        Standard deviations of the parameters, under the same keys.
    evidence : mapping
        Figures that speak for the effect.
    """

    name: str
    parameters: Mapping[str, Any]
    uncertainty: Mapping[str, Any] = field(default_factory=dict)
    evidence: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class FieldModel:
    """Represents the field generator and all that distorts its field by virtual dipoles.

    Attributes
    ----------
    positions, directions : ndarray, shape (N, 3)
        Positions (m) and unit vectors, frame fg. A dipole whose three components are free takes
        three rows.
    moments : ndarray, shape (N, K), complex
        Moments at each emitter's nominal current, A m^2.
    emitters : tuple of str, length K
        Names of the emitters.
    frequencies_hz : tuple of float, length K
        Their drive frequencies, Hz.
    flux_error_t : float
        Standard deviation of the model's own error, T a phasor component, in the volume that it
        was fitted in (from held-out data, with noise and pose jitter subtracted).
    modes : ndarray, shape (R, N, K), complex, or None
        Low-rank factor of the moments' covariance. The variance of the field is the sum of the
        squares of the R fields of these moments; real and imaginary part of a mode vary together.
    effects : tuple of EffectRecord
        Corrections of measured fluxes, sensors or the optical frame that belong to this model.
        Effects on the field itself are already in the dipoles.
    provenance : mapping
        How the model was made, with its held-out error.
    made_for : Identity or None
        Board and bodies that it was calibrated on, or its effects were found on; None if not
        stated.
    references : ReferenceReadings or None
        What the references read when it was calibrated.
    shift_sigma_m : float
        Standard deviation along each axis, m, of a shift that all places in the field share: what
        the calibration could not tell between the field and where the tool's sensors are.
    gaps : ScanGaps or None
        By how much the field may be off where the scan has gaps, beyond ``flux_error_t``. Only a
        diagnosis reads it; no pose follows from it.

    Raises
    ------
    ModelFileError
        When the shapes do not fit together or there is no dipole.
    """

    positions: Array
    directions: Array
    moments: ComplexArray
    emitters: tuple[str, ...]
    frequencies_hz: tuple[float, ...]
    flux_error_t: float = 0.0
    modes: ComplexArray | None = None
    effects: tuple[EffectRecord, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)
    made_for: Identity | None = None
    references: ReferenceReadings | None = None
    shift_sigma_m: float = 0.0
    gaps: ScanGaps | None = None

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
        """Return the model's short name, made of all that poses follow from."""
        return fingerprint_of(
            [
                self.positions, self.directions, self.moments, self.emitters, self.frequencies_hz,
                self.flux_error_t, self.modes,
                [[effect.name, plain(dict(effect.parameters))] for effect in self.effects],
                *([self.shift_sigma_m] if self.shift_sigma_m else []),
            ]
        )  # fmt: skip

    def flux(self, points: Array, axes: Array, lengths: Array | None = None) -> ComplexArray:
        """Return the flux (..., K), T, that each sensor has of each emitter, along its axis.

        Sensor centres (m) and unit axes (..., 3) are in the frame fg; no ``lengths`` are those of
        points.
        """
        flat = points.reshape(-1, 3)
        spans = None if lengths is None else np.broadcast_to(lengths, points.shape[:-1]).ravel()
        basis = flux_basis(flat, axes.reshape(-1, 3), spans, self.positions, self.directions)
        return np.asarray((basis @ self.moments).reshape(*points.shape[:-1], -1))

    def with_dipoles(
        self, positions: Array, directions: Array, moments: ComplexArray
    ) -> 'FieldModel':
        """Return this model with further dipoles, such as those of metal, added.

        The modes of uncertainty stay the same: the added dipoles count as certain.

        Parameters
        ----------
        positions, directions : ndarray, shape (M, 3)
            Positions (m) and unit directions, frame fg.
        moments : ndarray, shape (M, K), complex
            Moments, A m^2.
        """
        modes = self.modes
        if modes is not None:
            pad = np.zeros((modes.shape[0], positions.shape[0], modes.shape[2]), dtype=complex)
            modes = np.concatenate([modes, pad], axis=1)
        return replace(
            self,
            positions=np.concatenate([self.positions, positions]),
            directions=np.concatenate([self.directions, directions]),
            moments=np.concatenate([self.moments, moments]),
            modes=modes,
        )


def to_document(model: FieldModel) -> dict[str, Any]:
    """Return the model as plain lists and mappings, ready to be written to a text file."""
    table = np.concatenate(
        [
            model.positions,
            model.directions,
            np.stack([model.moments.real, model.moments.imag], axis=2).reshape(
                len(model.moments), -1
            ),
        ],
        axis=1,
    )
    document: dict[str, Any] = {
        'schema': SCHEMA,
        'fingerprint': model.fingerprint,
        **({} if model.made_for is None else {'made_for': plain(asdict(model.made_for))}),
        'frame_id': 'fg',
        'units': {
            'position': 'm',
            'direction': '1',
            'moment': 'A m^2',
            'frequency': 'Hz',
            'flux': 'T',
        },
        'emitters': [
            {'name': name, 'frequency_hz': frequency}
            for name, frequency in zip(model.emitters, model.frequencies_hz, strict=True)
        ],
        'provenance': dict(model.provenance),
        'flux_error_t': model.flux_error_t,
        'shift_sigma_m': model.shift_sigma_m,
        'effects': [
            {
                'name': effect.name,
                'parameters': plain(dict(effect.parameters)),
                'uncertainty': plain(dict(effect.uncertainty)),
                'evidence': plain(dict(effect.evidence)),
            }
            for effect in model.effects
        ],
        'columns': ['x', 'y', 'z', 'ux', 'uy', 'uz']
        + [f'm{k}_{part}' for k in range(len(model.emitters)) for part in ('re', 'im')],
        'dipoles': table.tolist(),
    }
    if model.references is not None:
        document['references'] = readings_document(model.references)
    if model.gaps is not None:
        document['gaps'] = gaps_document(model.gaps)
    if model.modes is not None:
        parts = np.stack([model.modes.real, model.modes.imag], axis=3)
        document['modes'] = parts.reshape(*model.modes.shape[:2], -1).tolist()
    return document


def _table(value: Any, width: int, what: str) -> Array:
    try:
        table = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ModelFileError(f'model: {what} is not a table of numbers') from error
    if table.ndim != 2 or table.shape[1] != width or table.shape[0] == 0:
        raise ModelFileError(f'model: {what} must be rows of {width} numbers, got {table.shape}')
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
    """Return the field model that a document of plain data holds.

    A document of an earlier version, without fingerprints, is accepted unchecked.

    Raises
    ------
    ModelFileError
        With the rule that the document breaks.
    """
    if not isinstance(document, dict) or document.get('schema') != SCHEMA:
        got = document.get('schema') if isinstance(document, dict) else document
        raise ModelFileError(f'model: schema must be {SCHEMA!r}, got {got!r}')
    emitters = document.get('emitters')
    if not isinstance(emitters, list) or not emitters:
        raise ModelFileError('model: emitters must be a list of at least one')
    try:
        names = tuple(str(item['name']) for item in emitters)
        frequencies = tuple(float(item['frequency_hz']) for item in emitters)
        flux_error = float(document.get('flux_error_t', 0.0))
        shift_sigma = float(document.get('shift_sigma_m', 0.0))
    except (KeyError, TypeError, ValueError) as error:
        raise ModelFileError(
            f'model: an emitter, flux_error_t or shift_sigma_m is malformed: {error}'
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
        modes = np.array([part[:, 0::2] + 1j * part[:, 1::2] for part in parts])
    effects = document.get('effects') or []
    if not isinstance(effects, list):
        raise ModelFileError('model: effects must be a list')
    provenance = document.get('provenance') or {}
    if not isinstance(provenance, dict):
        raise ModelFileError('model: provenance must be a mapping')
    references, gaps = document.get('references'), document.get('gaps')
    model = FieldModel(
        positions=table[:, :3].copy(),
        directions=table[:, 3:6].copy(),
        moments=np.ascontiguousarray(table[:, 6::2] + 1j * table[:, 7::2]),
        emitters=names,
        frequencies_hz=frequencies,
        flux_error_t=flux_error,
        shift_sigma_m=shift_sigma,
        modes=modes,
        effects=tuple(_effect(item) for item in effects),
        provenance=provenance,
        made_for=_made_for(document.get('made_for')),
        references=None if references is None else parse_readings(references, k),
        gaps=None if gaps is None else parse_gaps(gaps),
    )
    stated = document.get('fingerprint')
    if stated is not None and str(stated) != model.fingerprint:
        raise ModelFileError(
            f'model: the file states the fingerprint {stated}, but its content has '
            f'{model.fingerprint}; was it changed? Remove the key fingerprint to use it all the '
            'same'
        )
    return model
