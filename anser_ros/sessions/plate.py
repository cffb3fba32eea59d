"""Guides a coil through the places of a plate, and writes its rests as a session.

A rest is judged at once by where the drawn board puts the coil: beside its place by as much as at
the places around it, but for what a drawing is wrong over that distance.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from anser_ros.arrays import Array, ComplexArray, Integers
from anser_ros.errors import ParameterError, SetupError
from anser_ros.frames.intake import GOOD, reading_codes
from anser_ros.sessions.drawn_calibration import WAYS
from anser_ros.sessions.nominal_board import NominalBoard
from anser_ros.sessions.session import sensor_table, session_of, tracking_noise
from anser_ros.sessions.tracked_session import track_session
from anser_ros.stamps import SECOND_NS
from anser_ros.tracking.estimate import NO_GATE, TrackerSettings
from anser_ros.wire.bag_writer import SessionWriter
from anser_ros.wire.recorded import Bag, RecordedFluxes, optical_topic
from anser_ros.wire.setup import Setup, dump_setup
from anser_ros.wire.tables import read_table

PLATES = {
    '7x7': (7, 42.86e-3, 84e-3),
    '9x9': (9, 33.3e-3, 84e-3),
    'duplo': (7, 31.75e-3, 15e-3 + 5.5 * 19.2e-3),
}
"""Plates of Anser's owners: places a side, their distance, m, and the coil's height, m. Duplo:
bricks of 2 x 2 studs, the coil half a brick above five of 19.2 mm, on a case of 15 mm."""
REST_S, FEWEST = 1.0, 8
"""Time that a coil rests until it is taken, s, and frames of it at least."""
GAP = 3.0
"""Distance of two frames, in periods, from which on it is not known where the coil was between."""
STILL, NOISY = 1e-3, 3.0
"""Part of the fluxes by which they change in a rest at most, 0.03 mm at 8 cm, and the same in
standard deviations of noise, which is as many times the stated one at most: a hand trembles."""
APART_M = 7e-3
"""Distance from a place to where the drawn board puts the coil, beyond that of the places around:
it was up to 6.6 mm for the drawings of ten boards, and other places are 30 mm off."""
FIRST_M = 16e-3
"""The same of the first place, which has none around it: a plate laid by eye."""
AROUND = 4
"""Places around that are looked at."""


def places_of(name: str, pitch_m: float | None = None, heights_m: Sequence[float] = ()) -> Array:
    """Return the places (P, 3) of a plate, m, frame fg, row by row with x ascending.

    ``name`` is of `PLATES`, or the path of a table with x_m, y_m and z_m (or _mm). Pitch and
    heights of a plate that are stated go before its own. Raises `ParameterError` when there is no
    such plate or a figure is not positive, `TableError` when the table can't be read.
    """
    if name not in PLATES:
        if not Path(name).is_file():
            raise ParameterError(f'no plate {name!r}: there are {", ".join(PLATES)}, or a table')
        return read_table(name).positions()
    side, pitch, height = PLATES[name]
    step, heights = pitch if pitch_m is None else pitch_m, heights_m or [height]
    if not all(1e-3 <= one < 1.0 for one in (step, *heights)):
        raise ParameterError('pitch and heights must be between 1 and 1000 mm')
    line = step * (np.arange(side) - (side - 1) / 2.0)
    return np.array([(x, y, z) for z in heights for y in line for x in line])


class Rest(NamedTuple):
    """Holds what the coils of a probe read in a rest."""

    stamp_ns: int  # of its middle
    flux: ComplexArray  # (S, K), T, the mean
    found: Array  # (3,), where the drawn board puts the probe, m; NaN for nowhere


class PlateGuide:
    """Takes a rest of a probe at each of some places (P, 3), m, one after the other.

    The probe is the only body of the setup's tools, or the one named. Raises `SetupError` when
    there is no such body, or the board cannot be drawn.
    """

    def __init__(self, setup: Setup, places: Array, body: str = '') -> None:
        bodies = [one for one in setup.bodies if body in ('', one)]
        if len(bodies) != 1:
            raise SetupError(f'which body is the probe? There are: {", ".join(setup.bodies)}')
        specs = tuple(sensor for sensor in setup.sensors if sensor.body == bodies[0])
        self.setup, self.body, self.places = replace(setup, sensors=specs), bodies[0], places
        self.sensors = sensor_table(specs)
        self._nominal = NominalBoard.of(setup).model
        if self._nominal is None:
            raise SetupError(f'a board of the kind {setup.emitter.kind!r} can not be drawn')
        # Of each place in their order: a reading, or None where it was passed over.
        self.taken: list[Rest | None] = []
        self._refused: Rest | None = None
        frames = max(FEWEST, round(REST_S * setup.flux_rate_hz))
        self._window: deque[tuple[int, ComplexArray]] = deque(maxlen=frames)
        self._has_moved, self._silent = True, 0

    @property
    def is_complete(self) -> bool:
        return len(self.taken) == len(self.places)

    @property
    def words(self) -> str:
        """Return which place is next, and where it is."""
        if self.is_complete:
            return f'all {len(self.places)} places are taken'
        x, y, z = 1e3 * self.places[len(self.taken)]
        return (
            f'place {len(self.taken) + 1} of {len(self.places)} is next: '
            f'x {x:.1f}, y {y:.1f}, z {z:.1f} mm'
        )

    def take(self, stamp_ns: int, channels: Integers, flux: ComplexArray, flags: Integers) -> str:
        """Take in a frame (C, K); return in words what came of a rest that it ends, if it does."""
        if self.is_complete:
            return ''
        late_ns = GAP * SECOND_NS / self.setup.flux_rate_hz
        if self._window and stamp_ns - self._window[-1][0] > late_ns:
            self._window.clear()
        rows = {int(channel): i for i, channel in enumerate(channels)}
        own = [rows[channel] for channel in self.sensors.channel.tolist() if channel in rows]
        if len(own) < len(self.sensors) or (reading_codes(flux[own], flags[own]) != GOOD).any():
            self._window.clear()
            self._silent += 1
            is_said = self._silent == self._window.maxlen
            return 'not taken: the coil gives no reading. Is it connected?' if is_said else ''
        self._silent = 0
        self._window.append((stamp_ns, flux[own]))
        if len(self._window) < (self._window.maxlen or 0):
            return ''
        is_still, had_moved = self._is_still(), self._has_moved
        self._has_moved = had_moved or not is_still
        if not (is_still and had_moved):
            return ''
        stamps, fluxes = zip(*self._window, strict=True)
        mean = np.mean(fluxes, axis=0)
        found, axes = self._found(mean)
        reading = Rest(stamps[len(stamps) // 2], mean, found)
        self._forget_motion()
        self._refused = reading
        complaint = self._complaint(reading, axes)
        return f'not taken: {complaint}' if complaint else self.keep()

    def undo(self) -> str:
        """Forget the place before; return in words what is next."""
        self._forget_motion()
        if not self.taken:
            return 'nothing is taken yet'
        self.taken.pop()
        return f'place {len(self.taken) + 1} is forgotten'

    def skip(self) -> str:
        """Pass over the next place."""
        if self.is_complete:
            return self.words
        self._forget_motion()
        self.taken.append(None)
        return f'place {len(self.taken)} is passed over'

    def keep(self) -> str:
        """Take the rest that was refused last as it is."""
        if self._refused is None:
            return 'no rest was refused'
        self.taken.append(self._refused)
        self._refused = None
        return f'place {len(self.taken)} is taken'

    def write(self, path: Path) -> None:
        """Write the readings as a session whose poses are the places; the file is replaced.

        Raises `BagError` when it cannot be written.
        """
        draft = path.with_name(f'.{path.name}.part')
        draft.unlink(missing_ok=True)
        with SessionWriter(draft, self.setup.frame_id) as writer:
            for place, rest in zip(self.places.tolist(), self.taken, strict=False):
                if rest is not None:
                    if not writer.record.messages:
                        writer.write_setup(dump_setup(self.setup), rest.stamp_ns)
                    writer.write_readings(self.setup.sensors, rest.stamp_ns, rest.flux)
                    upright = (0.0, 0.0, 0.0, 1.0)
                    writer.write_pose(optical_topic(self.body), rest.stamp_ns, place, upright)
        draft.replace(path)

    def _forget_motion(self) -> None:
        self._window.clear()
        self._has_moved, self._refused = False, None

    def _is_still(self) -> bool:
        """Whether both halves of the window agree, and it scatters as noise does."""
        flux = np.stack([one for _, one in self._window])
        half = len(flux) // 2
        size = float(np.sqrt(np.mean(np.abs(flux) ** 2)))
        noise = float(np.sqrt(np.mean(np.abs(np.diff(flux, axis=0)) ** 2) / 2.0))
        moved = flux[half:].mean(axis=0) - flux[:half].mean(axis=0)
        change = float(np.sqrt(np.mean(np.abs(moved) ** 2)))
        most = max(NOISY * np.sqrt(2.0) * tracking_noise(self.setup), STILL * size)
        least = max(NOISY * 2.0 * noise / np.sqrt(len(flux)), STILL * size)
        return bool(noise <= most and change <= least)

    def _found(self, flux: ComplexArray) -> tuple[Array, Array]:
        """Where the drawn board puts the coils, less their arms, m, and their axes (S, 3)."""
        assert self._nominal is not None
        stamps, flags = np.ones(1, dtype=np.int64), np.zeros((1, len(flux)), dtype=np.int64)
        stream = RecordedFluxes(stamps, self.sensors.channel, flags, flux[None])
        session = session_of(Bag('', self.setup, '', stream, None, {}))
        settings = TrackerSettings(gate=NO_GATE, max_sigma_m=1.0)
        tracked = track_session(session, self._nominal, settings).sensors
        poses = [tracked[name].estimates[0] for name in self.sensors.name]
        places = np.array([pose.position for pose in poses]) - self.sensors.position
        return places.mean(axis=0), np.array([pose.axis for pose in poses])

    def _complaint(self, reading: Rest, axes: Array) -> str:
        """What is wrong with a rest at the next place, in words; empty if nothing is."""
        row = len(self.taken)
        if not np.isfinite(reading.found).all():
            return 'the drawn board puts the coil nowhere. Is it connected, or metal near?'
        if np.median(np.einsum('si,si->s', axes, self.sensors.axis)) < 0.0:
            return 'the coil points the other way than stated. Is the probe upside down?'
        known = [(i, one) for i, one in enumerate(self.taken) if one is not None]
        known.sort(key=lambda one: float(np.linalg.norm(self.places[one[0]] - self.places[row])))
        around = [one.found - self.places[i] for i, one in known[:AROUND]]
        there = reading.found - (np.median(around, axis=0) if around else 0.0)
        off = there - self.places[row]
        if np.linalg.norm(off) <= (APART_M if around else FIRST_M):
            return ''
        distances = np.linalg.norm(there - self.places, axis=1)
        nearest = int(distances.argmin())
        if distances[nearest] <= APART_M:
            again = ' again' if any(i == nearest for i, _ in known) else ''
            return f'that is place {nearest + 1}{again}, not {row + 1}'
        size = 1e3 * np.abs(off)
        words = [f'{size[j]:.0f} mm too far {WAYS[j][int(off[j] > 0)]}' for j in range(3)]
        far = ', '.join(words[j] for j in np.argsort(-size) if size[j] >= size.max() / 3.0)
        return f'the coil lies {far}, beside the places around. Is it seated, and the pitch right?'
