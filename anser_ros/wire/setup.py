"""Reads the setup document (`anser_setup/1`): which coils drive, which sense, and where they are.

It is in every bag and on the latched topic ``setup``. Sensors lie in the frame of their body; the
body ``fg`` is the field generator itself.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import yaml

from anser_ros.arrays import Array, Integers
from anser_ros.errors import ParameterError, SetupError
from anser_ros.fingerprint import Identity, fingerprint_of
from anser_ros.settings import SECTIONS, Accuracy, RefitSettings, sections_of, settings_from
from anser_ros.wire.setup_values import (
    TipSpec,
    Vector,
    Winding,
    dump_tips,
    parse_tips,
    read_axis,
    read_mapping,
    read_name,
    read_number,
    read_vector,
    read_windings,
    refuse_misspelt,
    refuse_repeats,
    refuse_unknown_bodies,
    take,
)
from anser_ros.wire.text_files import DUMPER, read_own_yaml

SCHEMA = 'anser_setup/1'
KEYS = (
    'schema', 'fingerprint', 'frame_id', 'flux_rate_hz', 'flux_unit', 'emitter', 'sensors',
    'volume', 'tips', *SECTIONS,
)  # fmt: skip
CORNERS = ('low_m', 'high_m')
"""Keys of the volume."""
FIELD_GENERATOR = 'fg'


@dataclass(frozen=True)
class Coil:
    """Describes an emitter coil: centre (m, frame fg), turn about z (degrees), drive tone (Hz)."""

    name: str
    centre_m: Vector
    rotation_deg: float
    frequency_hz: float


@dataclass(frozen=True)
class Emitter:
    """Describes the field generator: its kind, the geometry that all coils share, and the coils.

    ``geometry`` holds the document's remaining keys (``turns``, ``side_m``, ``pitch_m``,
    ``layers``, ``thickness_m``, ``current_a`` for ``square_spiral_pcb``), as given.
    """

    kind: str
    geometry: Mapping[str, Any]
    coils: tuple[Coil, ...]


@dataclass(frozen=True)
class SensorSpec:
    """Describes a coil: channel, name, body, position (m) and unit axis in the body's frame.

    ``windings`` (offset from the position, m, and weight each) make it a weighted sum of points.
    """

    channel: int
    name: str
    body: str
    position_m: Vector
    axis: Vector
    length_m: float
    windings: tuple[Winding, ...] = ()


class SensorRows(NamedTuple):
    """Holds channels (S,), positions, m, and unit axes (S, 3), in the frames of bodies."""

    channel: Integers
    position: Array
    axis: Array

    @staticmethod
    def of(sensors: Sequence[SensorSpec], fixed_only: bool = False) -> 'SensorRows':
        """Return sensors in their order; with ``fixed_only`` places of what moves are NaN."""
        position = np.array([s.position_m for s in sensors], np.float64).reshape(-1, 3)
        axis = np.array([s.axis for s in sensors], np.float64).reshape(-1, 3)
        if fixed_only:
            moves = np.array([s.body != FIELD_GENERATOR for s in sensors], bool)
            position[moves] = axis[moves] = np.nan
        return SensorRows(np.array([s.channel for s in sensors], np.int64), position, axis)


@dataclass(frozen=True)
class Setup:
    """Holds a validated setup document.

    ``volume`` holds low and high corner (m, frame fg) of the box in which tools are tracked, None
    if the document leaves it to the board's size; ``tips`` the tips of tools, by body.
    """

    frame_id: str
    flux_rate_hz: float
    emitter: Emitter
    sensors: tuple[SensorSpec, ...]
    volume: tuple[Vector, Vector] | None = None
    stated: Mapping[str, float] = field(default_factory=dict)
    extra: Mapping[str, Any] = field(default_factory=dict)
    tips: Mapping[str, TipSpec] = field(default_factory=dict)
    said: frozenset[str] = frozenset()  # names of values that were stated over the document's

    def __repr__(self) -> str:
        of = f' of {", ".join(self.bodies)}' if self.bodies else ''
        return (
            f'Setup({len(self.emitter.coils)} emitters, {len(self.tool_sensors)} tool coils{of}, '
            f'{len(self.reference_sensors)} reference coils)'
        )

    @cached_property
    def refit(self) -> RefitSettings:
        """Return how the refit follows: what is stated, and defaults for the rest."""
        return settings_from(self.stated)

    @property
    def accuracy(self) -> Accuracy:
        """Return how accurate the instruments are: what is stated, and defaults for the rest."""
        return self.refit.accuracy

    def with_stated(self, stated: Mapping[str, float]) -> 'Setup':
        """Return the setup with values stated before its own; raises `ParameterError`."""
        if not isinstance(stated, Mapping):
            raise ParameterError(f'values must be a mapping by name, got {stated!r}')
        together = {**self.stated, **stated}
        settings_from(together)
        return replace(self, stated=together, said=self.said | stated.keys())

    def with_tips(self, tips: Mapping[str, TipSpec]) -> 'Setup':
        """Return the setup with tips before its own; raises `SetupError` for no body."""
        topics = [topic_of(name) for name in (*(s.name for s in self.tool_sensors), *self.bodies)]
        refuse_unknown_bodies(tips, {body: topic_of(body) for body in self.bodies}, topics)
        return replace(self, tips={**self.tips, **tips})

    @cached_property
    def identity(self) -> Identity:
        """Return fingerprints of the board, and of the sensors on each body."""
        emitter = self.emitter
        coils = [[c.name, c.centre_m, c.rotation_deg, c.frequency_hz] for c in emitter.coils]
        sensors = sorted(self.sensors, key=lambda sensor: sensor.channel)
        return Identity(
            fingerprint_of([emitter.kind, emitter.geometry, coils]),
            {
                body: fingerprint_of(
                    [
                        [s.channel, s.name, s.position_m, s.axis, s.length_m, *s.windings]
                        for s in sensors if s.body == body
                    ]
                )
                for body in sorted({sensor.body for sensor in sensors})
            },
        )  # fmt: skip

    @property
    def tool_sensors(self) -> tuple[SensorSpec, ...]:
        """Return the sensors on bodies that move."""
        return tuple(s for s in self.sensors if s.body != FIELD_GENERATOR)

    @property
    def reference_sensors(self) -> tuple[SensorSpec, ...]:
        """Return the sensors that are fixed in fg."""
        return tuple(s for s in self.sensors if s.body == FIELD_GENERATOR)

    @property
    def bodies(self) -> tuple[str, ...]:
        """Return the names of the bodies that move, in the order of their first sensor."""
        return tuple(dict.fromkeys(s.body for s in self.tool_sensors))

    @property
    def emitter_names(self) -> tuple[str, ...]:
        """Return the names of the emitters, in the order of the flux fields."""
        return tuple(coil.name for coil in self.emitter.coils)

    @property
    def frequencies_hz(self) -> tuple[float, ...]:
        """Drive frequencies, Hz, in the order of the flux fields."""
        return tuple(coil.frequency_hz for coil in self.emitter.coils)

    def follows_as(self, other: 'Setup') -> bool:
        """Return whether a refit by another setup, and its baseline, hold for this one too."""
        return self.has_same_board(other) and self.refit == other.refit

    def has_same_board(self, other: 'Setup') -> bool:
        """Return whether two setups have the same emitters, sensors and tracked volume."""
        ours = (self.frame_id, self.emitter, self.sensors, self.volume)
        return ours == (other.frame_id, other.emitter, other.sensors, other.volume)


def topic_of(name: str) -> str:
    """Return the relative ROS topic stem of a sensor's or body's name.

    A token that begins with a digit is not legal in a ROS 2 name, so it is joined to the token
    before it: ``tool_a/0/x`` becomes ``tool_a_0/x``; a leading digit gets ``sensor_`` in front.
    """
    tokens: list[str] = []
    for token in name.split('/'):
        if token[:1].isdigit():
            token = f'{tokens.pop()}_{token}' if tokens else f'sensor_{token}'
        tokens.append(token)
    return '/'.join(tokens)


def _parse_coil(item: Any, where: str) -> Coil:
    coil = read_mapping(item, where)
    return Coil(
        name=read_name(take(coil, 'name', where), f'{where}.name'),
        centre_m=read_vector(take(coil, 'centre_m', where), f'{where}.centre_m'),
        rotation_deg=read_number(coil.get('rotation_deg', 0.0), f'{where}.rotation_deg'),
        frequency_hz=read_number(
            take(coil, 'frequency_hz', where), f'{where}.frequency_hz', 1e-3, 1e9
        ),
    )


def _parse_emitter(item: Any) -> Emitter:
    emitter = read_mapping(item, 'emitter')
    coils = take(emitter, 'coils', 'emitter')
    if not isinstance(coils, list) or not coils:
        raise SetupError('setup: emitter.coils must be a list of at least one coil')
    parsed = tuple(_parse_coil(coil, f'emitter.coils[{i}]') for i, coil in enumerate(coils))
    refuse_repeats([coil.name for coil in parsed], 'coil')
    # What distinguishes emitters is their tone.
    refuse_repeats([coil.frequency_hz for coil in parsed], "emitter's frequency_hz")
    geometry = {k: v for k, v in emitter.items() if k not in ('kind', 'coils')}
    kind = take(emitter, 'kind', 'emitter')
    return Emitter(read_name(kind, 'emitter.kind'), geometry, parsed)


def _parse_sensor(item: Any, where: str) -> SensorSpec:
    sensor = read_mapping(item, where)
    channel = take(sensor, 'channel', where)
    if isinstance(channel, bool) or not isinstance(channel, int) or not 0 <= channel <= 0xFFFF:
        raise SetupError(
            f'setup: {where}.channel must be an integer in [0, 65535], got {channel!r}'
        )
    return SensorSpec(
        channel=channel,
        name=read_name(take(sensor, 'name', where), f'{where}.name'),
        body=read_name(take(sensor, 'body', where), f'{where}.body'),
        position_m=read_vector(take(sensor, 'position_m', where), f'{where}.position_m'),
        axis=read_axis(take(sensor, 'axis', where), f'{where}.axis'),
        length_m=read_number(sensor.get('length_m', 0.0), f'{where}.length_m', 0.0, 1.0),
        windings=(
            read_windings(sensor['windings'], f'{where}.windings') if 'windings' in sensor else ()
        ),
    )


def _parse_volume(item: Any) -> tuple[Vector, Vector]:
    volume = read_mapping(item, 'volume', *CORNERS)
    low, high = (read_vector(take(volume, key, 'volume'), f'volume.{key}') for key in CORNERS)
    if not all(a < b for a, b in zip(low, high, strict=True)):
        raise SetupError(f'setup: volume.low_m must be below volume.high_m, got {low} and {high}')
    return low, high


def _parse_stated(root: dict[str, Any]) -> dict[str, float]:
    """The values of the sections `SECTIONS`, checked."""
    stated: dict[str, float] = {}
    for section, names in SECTIONS.items():
        given = read_mapping(root.get(section, {}), section)
        unknown = sorted(set(map(str, given)) - set(names))
        if unknown:
            raise SetupError(
                f'setup: {section} has no key {", ".join(unknown)}; it may have {", ".join(names)}'
            )
        try:
            settings_from(given)
        except ParameterError as error:
            raise SetupError(f'setup: {section}: {error}') from error
        stated |= given
    return stated


def parse_setup(text: str) -> Setup:
    """Read and check a setup document.

    The keys of the optional sections, with units and defaults, are the fields of the classes of
    `anser_ros.settings`. ``fingerprint`` is for other readers and is computed again. Any other key
    is kept in ``extra``; one that looks like a misspelling is refused. Raises `SetupError` with
    the rule that is broken and the key where it is.
    """
    root = read_mapping(read_own_yaml(text, 'setup'), 'the document')
    if root.get('schema') != SCHEMA:
        raise SetupError(f'setup: schema must be {SCHEMA!r}, got {root.get("schema")!r}')
    if root.get('flux_unit', 'T') != 'T':
        raise SetupError(f'setup: flux_unit must be T, got {root.get("flux_unit")!r}')
    frame_id = read_name(root.get('frame_id', FIELD_GENERATOR), 'frame_id')
    if frame_id != FIELD_GENERATOR:
        raise SetupError(
            f'setup: frame_id must be {FIELD_GENERATOR!r}, the board that all positions are '
            f'given in, got {frame_id!r}'
        )
    sensors = take(root, 'sensors', 'the document')
    if not isinstance(sensors, list) or not sensors:
        raise SetupError('setup: sensors must be a list of at least one sensor')
    parsed = tuple(_parse_sensor(sensor, f'sensors[{i}]') for i, sensor in enumerate(sensors))
    refuse_repeats([sensor.channel for sensor in parsed], 'channel')
    refuse_repeats([sensor.name for sensor in parsed], 'sensor')
    tools = [sensor for sensor in parsed if sensor.body != FIELD_GENERATOR]
    for sensor in parsed:
        if sensor.windings and sensor not in tools:
            raise SetupError(f'setup: {sensor.name} is a reference: it cannot have windings')
    bodies = list(dict.fromkeys(sensor.body for sensor in tools))
    refuse_repeats(
        [topic_of(name) for name in [s.name for s in tools] + bodies], 'topic of sensor or body'
    )
    extra = {key: value for key, value in root.items() if key not in KEYS}
    refuse_misspelt(extra, KEYS)
    return Setup(
        frame_id=frame_id,
        flux_rate_hz=read_number(
            take(root, 'flux_rate_hz', 'the document'), 'flux_rate_hz', 1e-3, 1e6
        ),
        emitter=_parse_emitter(take(root, 'emitter', 'the document')),
        sensors=parsed,
        volume=_parse_volume(root['volume']) if 'volume' in root else None,
        stated=_parse_stated(root),
        extra=extra,
    ).with_tips(parse_tips(root.get('tips', {})))


def dump_setup(setup: Setup) -> str:
    """Write a setup as the YAML document that `parse_setup` reads back unchanged."""
    emitter = setup.emitter
    sensors = [asdict(sensor) for sensor in setup.sensors]
    for sensor in sensors:
        if not sensor['windings']:
            del sensor['windings']
    volume = {key: list(c) for key, c in zip(CORNERS, setup.volume or (), strict=False)}
    document = {
        'schema': SCHEMA,
        'fingerprint': asdict(setup.identity),
        'frame_id': setup.frame_id,
        'flux_rate_hz': setup.flux_rate_hz,
        'flux_unit': 'T',
        'emitter': {
            'kind': emitter.kind,
            **emitter.geometry,
            'coils': list(map(asdict, emitter.coils)),
        },
        'sensors': sensors,
        **({'volume': volume} if volume else {}),
        **({'tips': dump_tips(setup.tips)} if setup.tips else {}),
        **{name: values for name, values in sections_of(setup.stated).items() if values},
        **setup.extra,
    }
    return str(yaml.dump(document, Dumper=DUMPER, sort_keys=False))
