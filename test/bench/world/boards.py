"""Boards, tools and reference coils: as drawn (the setup document) and as they really are."""

from dataclasses import dataclass

import numpy as np
from filaments import coil_field
from scipy.spatial.transform import Rotation
from windings import Errors, Winding, draw

CURRENT_A = 0.25
REFERENCE_LENGTH_M = 0.008
LENGTHS_M = (0.0, 0.006, 0.002)
"""Of the tools' coils, board by board."""


@dataclass(frozen=True)
class Design:
    """What a board's drawing says."""

    name: str
    winding: Winding
    centres: np.ndarray  # (K, 2), m
    rotations_deg: np.ndarray
    clockwise: bool
    half_x_m: float  # half the board's sides
    half_y_m: float

    def emitter(self, frequencies):
        """The emitter's part of the setup document."""
        w = self.winding
        kind, sides = 'square_spiral_pcb', {'side_m': w.side_x_m}
        if w.side_x_m != w.side_y_m:
            kind = 'rectangular_spiral_pcb'
            sides = {'side_x_m': w.side_x_m, 'side_y_m': w.side_y_m}
        return {
            'kind': kind,
            'turns': w.turns,
            **sides,
            'pitch_m': w.pitch_m,
            'layers': 2,
            'thickness_m': w.thickness_m,
            'current_a': CURRENT_A,
            'coils': [
                {
                    'name': f'coil{k}',
                    'centre_m': [*(float(v) for v in centre), 0.0],
                    'rotation_deg': float(turn),
                    'frequency_hz': float(f),
                }
                for k, (centre, turn, f) in enumerate(
                    zip(self.centres, self.rotations_deg, frequencies, strict=True)
                )
            ],
        }


@dataclass(frozen=True)
class Sensors:
    """Coils on one body: what the setup says of them."""

    channel: np.ndarray
    name: list
    body: str
    place: np.ndarray
    axis: np.ndarray
    length: np.ndarray

    def documents(self):
        """The setup document's entries."""
        rows = zip(self.channel, self.name, self.place, self.axis, self.length, strict=True)
        return [
            {
                'channel': int(channel),
                'name': name,
                'body': self.body,
                'position_m': [float(v) for v in place],
                'axis': [float(v) for v in axis],
                'length_m': float(length),
            }
            for channel, name, place, axis, length in rows
        ]


@dataclass(frozen=True)
class Board:
    """A board that was built: tracks with errors, a tool, references as surveyed and as is."""

    design: Design
    frequencies: np.ndarray
    paths: list  # of each coil (M, 3), m
    amperes: np.ndarray
    tool: Sensors
    reference: Sensors
    reference_real: Sensors  # with the true geometry
    reference_gain: np.ndarray
    scan: dict  # the factory recording's grid
    heights_m: tuple  # lowest and highest z of the tool's origin in sessions

    @property
    def omega(self):
        """Angular frequencies (K,), rad/s."""
        return 2 * np.pi * self.frequencies

    def field(self, points, paths=None):
        """Field (P, K, 3) of all coils, T, at nominal current."""
        return coil_field(points, paths or self.paths) * self.amperes[:, None]

    def document(self, rate_hz):
        """The setup document."""
        return {
            'schema': 'anser_setup/1', 'frame_id': 'fg', 'flux_rate_hz': rate_hz, 'flux_unit': 'T',
            'emitter': self.design.emitter(self.frequencies),
            'sensors': self.tool.documents() + self.reference.documents(),
        }  # fmt: skip


def _ring8(rng):
    """Eight spirals around a free middle, corner ones straight and side ones turned."""
    side = float(rng.choice([0.058, 0.064, 0.076]))
    a, b = side * rng.uniform(1.28, 1.4), side * rng.uniform(1.02, 1.1)
    spots = [(-a, a), (0, b), (a, a), (-b, 0), (b, 0), (-a, -a), (0, -b), (a, -a)]
    turns = np.where([0 in spot for spot in spots], rng.choice([30.0, 45.0]), 0.0)
    winding = Winding(side, side, float(rng.choice([0.00065, 0.0009])), 26, 0.0016)
    return Design('ring8', winding, np.array(spots), turns, True, a + side, a + side)


def _wide8(rng):
    """Eight large spirals (98 mm) side by side around a free middle, wound the other way."""
    side, a = 0.098, 0.104
    spots = [(-a, a), (0, a), (a, a), (-a, 0), (a, 0), (-a, -a), (0, -a), (a, -a)]
    spots = np.array(spots) + rng.uniform(-0.001, 0.001, (8, 2))
    winding = Winding(side, side, 0.0011, 34, 0.0024)
    return Design('wide8', winding, np.round(spots, 5), np.zeros(8), False, 0.16, 0.16)


def _grid8(rng):
    """Eight spirals of 50 mm in a 3 x 3 square without its middle, far apart."""
    a = rng.uniform(0.085, 0.1)
    spots = [(x * a, y * a) for y in (1, 0, -1) for x in (-1, 0, 1) if (x, y) != (0, 0)]
    winding = Winding(0.05, 0.05, 0.0006, 36, 0.0016)
    turns = rng.choice([0.0, 15.0, 45.0], 8)
    return Design('grid8', winding, np.array(spots), turns, True, a + 0.05, a + 0.05)


def _grid9(rng):
    """Nine spirals in a 3 x 3 square, every second one turned."""
    a = rng.uniform(0.078, 0.09)
    spots = [(x * a, y * a) for y in (1, 0, -1) for x in (-1, 0, 1)]
    turns = np.where(np.arange(9) % 2, 45.0, 0.0)
    winding = Winding(0.06, 0.06, 0.0007, 30, 0.0016)
    return Design('grid9', winding, np.array(spots), turns, bool(rng.integers(2)), 0.14, 0.14)


def _window6(rng):
    """Six rectangles around a radiolucent window."""
    x, y = 0.105, 0.07
    spots = [(-x, y), (0, 0.115), (x, y), (-x, -y), (0, -0.115), (x, -y)]
    winding = Winding(0.09, 0.12, 0.001, 28, 0.0016)
    turns = np.where([s[0] == 0 for s in spots], 90.0, 0.0)
    spots = np.array(spots) * [1.35, 1.0]
    return Design('window6', winding, spots, turns, bool(rng.integers(2)), 0.2, 0.17)


DESIGNS = (_ring8, _grid9, _wide8, _window6, _grid8)


def _frequencies(count, rng):
    step = rng.uniform(140, 1400 / count)
    return np.round((6000 + rng.uniform(0, 40) + step * np.arange(count)) / 5) * 5.0


def _tool(index, rng):
    """Triaxial clusters along z; three 30 mm apart or two at another distance."""
    if rng.uniform() < 0.7:
        z = [-0.03, 0.0, 0.03]
    else:
        apart = float(rng.choice([0.03, 0.04, 0.05]))
        z = [-0.5 * apart, 0.5 * apart]
    place = np.repeat([[0.0, 0.0, v] for v in z], 3, axis=0)
    axis = np.tile(np.eye(3), (len(z), 1))
    body = str(rng.choice(['tool_a', 'probe', 'stylus']))
    names = [f'{body}/{i // 3}/{"xyz"[i % 3]}' for i in range(3 * len(z))]
    length = np.full(3 * len(z), LENGTHS_M[index % 3])
    return Sensors(np.arange(3 * len(z)), names, body, place, axis, length)


def _stations(design, count, below, rng):
    """Places of reference pairs: at the board's rim, some higher up, some below the board."""
    around = count - below
    low = (around + 1) // 2
    angle = np.concatenate(
        [np.arange(low) / low, (np.arange(around - low) + 0.5) / (around - low)]
    )
    angle = 2 * np.pi * angle + rng.uniform(0, 0.6)
    height = np.concatenate([rng.uniform(0.015, 0.05, low), rng.uniform(0.09, 0.22, around - low)])
    wide = np.array([design.half_x_m, design.half_y_m]) + rng.uniform(0.005, 0.02)
    reach = np.max(np.abs(np.stack([np.cos(angle), np.sin(angle)])), axis=0)
    rim = np.stack([np.cos(angle) / reach * wide[0], np.sin(angle) / reach * wide[1]], axis=1)
    place = np.column_stack([rim, height]) + rng.uniform(-0.006, 0.006, (around, 3))
    if below:
        under = rng.uniform(-0.8, 0.8, (below, 2)) * wide
        under = np.column_stack([under, rng.uniform(-0.05, -0.02, below)])
        place = np.concatenate([place, under])
    return np.round(place, 7)


def _references(design, below, rng):
    """Pairs of single coils at stations (``below`` of them under the board) and their gains.

    Returns them as surveyed, as they really are, and the gains.
    """
    count = int(rng.choice([12, 14, 16]))
    place = np.repeat(_stations(design, count, below, rng), 2, axis=0)
    axis = rng.normal(size=(2 * count, 3))
    axis = np.round(axis / np.linalg.norm(axis, axis=1)[:, None], 7)
    names = [f'ref/{i // 2}/{i % 2}' for i in range(2 * count)]
    length = np.full(2 * count, REFERENCE_LENGTH_M + round(rng.uniform(-3e-4, 3e-4), 4))
    channel = 16 + np.arange(2 * count)
    drawn = Sensors(channel, names, 'fg', place, axis, length)
    tilt = Rotation.from_rotvec(np.radians(0.3) * rng.normal(size=(2 * count, 3)))
    moved = place + 0.2e-3 * rng.normal(size=place.shape)
    tilted = tilt.apply(axis / np.linalg.norm(axis, axis=1)[:, None])
    longer = length * (1 + 0.02 * rng.normal(size=2 * count))
    real = Sensors(channel, names, 'fg', moved, tilted, longer)
    return drawn, real, 1 + 0.004 * rng.normal(size=2 * count)


def build(index, rng):
    """Build a board; ``index`` goes through the designs in turn."""
    design = DESIGNS[index % len(DESIGNS)](rng)
    count = len(design.centres)
    coils = [
        draw(
            design.winding,
            np.array([*centre, 0.0]),
            turn,
            [centre[0] + rng.uniform(-0.01, 0.01), -design.half_y_m],
            Errors(),
            rng,
            design.clockwise,
        )
        for centre, turn in zip(design.centres, design.rotations_deg, strict=True)
    ]
    reference, real, gain = _references(design, below=3 if index % 3 == 1 else 0, rng=rng)
    tool = _tool(index, rng)
    tall = index % 2 == 1
    side = 0.15 if design.half_x_m < 0.19 else 0.16
    scan = {'count': 21, 'half_m': side, 'heights_m': (0.115, 0.16, 0.205), 'tilt_rad': 0.012}
    if not tall:
        scan.update(count=31, heights_m=(0.15,))
    return Board(
        design=design, frequencies=_frequencies(count, rng), paths=[path for path, _ in coils],
        amperes=CURRENT_A * np.array([strength for _, strength in coils]), tool=tool,
        reference=reference, reference_real=real, reference_gain=gain, scan=scan,
        heights_m=(0.112, 0.208) if tall else (0.147, 0.183),
    )  # fmt: skip
