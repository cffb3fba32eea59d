"""Faults between the control unit and the host: bytes, blocks, samples, clocks, channels."""

import time
from collections.abc import Callable

import numpy as np
import tampers as t
from fault import Fault, Off, nothing
from line import Tamper
from rig import RATE_HZ, Rig

MS_100 = 2000
"""Samples in 100 ms at the rate of the trial."""
HALF_REFERENCES = list(range(9, 25))
"""Columns of sixteen reference coils."""
LATE_BLOCK = [3, 4, 5, 6, 7, 8, 0, 1, 2]
"""Order of the tool's columns where a block of inputs is late."""
ALL_REFERENCES = list(range(9, 41))
"""Columns of all reference coils."""


def _put(make: Callable[[Rig, np.random.Generator], Tamper]) -> Callable[..., Off]:
    def on(rig: Rig, rng: np.random.Generator) -> Off:
        key = f'{id(make)}{time.monotonic()}'
        rig.line.put(key, make(rig, rng))
        return lambda: rig.line.take_off(key)

    return on


def _line(name: str, what: str, make: Callable[..., Tamper], **more: object) -> Fault:
    more.setdefault('combines', True)
    return Fault(name, what, _put(make), **more)


def _held(seconds: float) -> Callable[..., Off]:
    """Bytes pile up for a while, and come all at once."""

    def on(rig: Rig, _rng: np.random.Generator) -> Off:
        rig.line.is_held = True
        time.sleep(seconds)
        rig.line.is_held = False
        return nothing

    return on


def _unplug(rig: Rig, _rng: np.random.Generator) -> Off:
    rig.line.unplug()
    return rig.line.plug


def _flapping(rig: Rig, _rng: np.random.Generator) -> Off:
    for _ in range(6):
        rig.line.unplug()
        time.sleep(0.15)
        rig.line.plug()
        time.sleep(0.15)
    return nothing


def _old_bytes(rig: Rig, rng: np.random.Generator) -> Off:
    kept: list[bytes] = []

    def keep(records: list[bytes], _on_s: float) -> list[bytes]:
        kept.extend(records)
        return records

    rig.line.put('keep', keep)
    time.sleep(0.5)
    rig.line.take_off('keep')
    time.sleep(1.0)
    rig.line.inject(b''.join(kept))
    return nothing


def _draw(rng: np.random.Generator, count: int) -> list[int]:
    return sorted(int(v) for v in rng.choice(ALL_REFERENCES, count, replace=False))


SERIAL = (
    _line('ring', 'a ring of the last 100 ms repeats', lambda r, g: t.ring(MS_100)),
    _line('ring-30ms', 'a ring of the last 30 ms repeats', lambda r, g: t.ring(600)),
    _line('ring-1s', 'a ring of the last second repeats', lambda r, g: t.ring(20000), lasts_s=5.0),
    _line('replayed-bytes', 'all bytes of the last half second come again and again',
          lambda r, g: t.replayed(0.5)),
    _line('column-ring', "one coil's column repeats its last 100 ms",
          lambda r, g: t.ring(MS_100, [4])),
    _line('cluster-ring', 'one cluster of three repeats its last 100 ms',
          lambda r, g: t.ring(MS_100, [3, 4, 5])),
    _line('tool-ring', 'all coils of the tool repeat their last 100 ms, the current lives',
          lambda r, g: t.ring(MS_100, t.TOOL)),
    _line('current-ring', 'the current channel repeats its last 100 ms',
          lambda r, g: t.ring(MS_100, [-1])),
    _line('column-constant', "one coil's column has one code", lambda r, g: t.constant(17, [4])),
    _line('column-dead', "one coil's column is noise", lambda r, g: t.dead([4], g)),
    _line('tool-dead', 'all coils of the tool are noise', lambda r, g: t.dead(t.TOOL, g)),
    _line('swap-clusters', 'columns of two clusters are swapped', lambda r, g: t.swapped(0, 7)),
    _line('swap-in-cluster', 'two columns of one cluster are swapped',
          lambda r, g: t.swapped(3, 4)),
    _line('swap-tool-reference', 'a tool and a reference column are swapped',
          lambda r, g: t.swapped(4, 12)),
    _line('swap-same-axis', 'the same axis of two clusters is swapped',
          lambda r, g: t.swapped(2, 8)),
    _line('gain-all', 'a gain of 2 % on all coils', lambda r, g: t.gain(1.02, t.TOOL)),
    _line('gain-all-big', 'a gain of 30 % on all coils', lambda r, g: t.gain(1.3, t.TOOL)),
    _line('gain-one', 'a gain of 5 % on one coil', lambda r, g: t.gain(1.05, [4])),
    _line('gain-cluster', 'a gain of 5 % on one cluster', lambda r, g: t.gain(1.05, [3, 4, 5])),
    _line('gain-current', 'a gain of 2 % on the current', lambda r, g: t.gain(1.02, [-1])),
    _line('inverted-one', 'one coil is inverted', lambda r, g: t.gain(-1.0, [4])),
    _line('inverted-all', 'all coils of the tool are inverted', lambda r, g: t.gain(-1.0, t.TOOL)),
    _line('inverted-current', 'the current is inverted', lambda r, g: t.gain(-1.0, [-1])),
    _line('saturated', 'an amplifier clips', lambda r, g: t.clipped(0.02, [4])),
    _line('saturated-all', 'all amplifiers of the tool clip',
          lambda r, g: t.clipped(0.02, t.TOOL)),
    _line('offset', 'an offset of 3000 codes on one coil', lambda r, g: t.offset(3000, [4])),
    _line('hum', 'mains hum of 500 codes on the tool',
          lambda r, g: t.hum(500.0, t.TOOL, r.rate_hz)),
    _line('noisy', 'noise of 60 codes on the tool', lambda r, g: t.noise(60.0, t.TOOL, g)),
    _line('noisy-one', 'noise of 60 codes on one coil', lambda r, g: t.noise(60.0, [4], g)),
    _line('leak', 'one coil leaks 5 % into another', lambda r, g: t.mixed(4, 1, 0.05)),
    _line('leak-emitters', 'the current leaks 1 % into a coil', lambda r, g: t.mixed(4, -1, 0.01)),
    _line('bit-flips', 'a flipped bit in one record of ten', lambda r, g: t.bit_flips(0.1, g)),
    _line('bit-flips-hidden', 'a flipped bit in one record of ten, the checksum right',
          lambda r, g: t.bit_flips(0.1, g, hidden=True)),
    _line('torn', 'the rest of one record of ten is lost', lambda r, g: t.torn(0.1, g)),
    _line('garbage', 'garbage in front of one record of ten', lambda r, g: t.garbage(0.1, g)),
    _line('noise-only', 'nothing but noise arrives', lambda r, g: t.noise_only(g)),
    _line('silence', 'nothing arrives', lambda r, g: t.nothing()),
    _line('lost', 'one record of ten is lost', lambda r, g: t.lost(0.1, g)),
    _line('lost-most', 'nine records of ten are lost', lambda r, g: t.lost(0.9, g)),
    _line('doubled', 'one record of ten arrives twice', lambda r, g: t.doubled(0.1, g)),
    _line('shuffled', 'blocks arrive in another order', lambda r, g: t.shuffled(6, g)),
    _line('gap-numbers', 'sequence numbers jump ahead by 1000',
          lambda r, g: t.numbers(lambda n, first: n + 1000)),
    _line('same-number', 'all blocks have one number',
          lambda r, g: t.numbers(lambda n, first: first)),
    _line('hello-rate', 'the hello states another sample rate',
          lambda r, g: t.hello_scaled(sample_rate_hz=1.25)),
    _line('hello-tones', 'the hello states other tones', lambda r, g: t.hello(
        frequencies_hz=tuple(6100.0 + 170.0 * k for k in range(8)))),
    _line('hello-scale', 'the hello states twice the full scale',
          lambda r, g: t.inside(hello=t.scaled_channels(2.0))),
    _line('hello-reordered', 'the hello states the channels in another order',
          lambda r, g: t.inside(hello=t.reordered_channels())),
    _line('channel-gone', 'a channel is gone from hello and blocks',
          lambda r, g: t.without_columns([4])),
    _line('channel-new', 'a channel more in hello and blocks', lambda r, g: t.with_column()),
    Fault('unplugged', 'the cable is pulled out', _unplug),
    Fault('flapping', 'the cable is pulled out six times', _flapping, lasts_s=0.5),
    Fault('old-bytes', 'half a second of old bytes comes a second late', _old_bytes, lasts_s=1.0),
)  # fmt: skip
"""Bytes, blocks and samples."""

CLOCK = (
    _line('ticks-frozen', 'the device tick stands still',
          lambda r, g: t.ticks(lambda now, first: first)),
    _line('tick-rate', "the hello's tick rate is doubled",
          lambda r, g: t.hello_scaled(tick_hz=2.0)),
    _line('ticks-doubled', 'the device tick runs twice as fast',
          lambda r, g: t.ticks(lambda now, first: first + 2 * (now - first))),
    _line('ticks-drift', 'the device tick runs 2000 ppm fast',
          lambda r, g: t.ticks(lambda now, first: first + round(1.002 * (now - first)))),
    _line('ticks-reset', 'the device clock begins at zero',
          lambda r, g: t.ticks(lambda now, first: now - first)),
    _line('ticks-back', 'the device clock is set back by 10 s',
          lambda r, g: t.ticks(lambda now, first: now - 10_000_000)),
    _line('ticks-ahead', 'the device clock is set ahead by 0.5 s',
          lambda r, g: t.ticks(lambda now, first: now + 500_000)),
    _line('ticks-wrapped', 'the device clock wraps at 32 bits',
          lambda r, g: t.ticks(lambda now, first: (now - first - 10**6) % 2**32)),
    _line('ticks-jitter', 'the device tick jitters by 3 ms',
          lambda r, g: t.ticks(lambda now, first: now + int(g.integers(-3000, 3000)))),
    _line('late', 'everything comes 0.3 s late', lambda r, g: t.late(0.3)),
    _line('creeping', 'everything comes later by 0.1 s a second', lambda r, g: t.creeping(0.1)),
    _line('bursts', 'everything comes in bursts of 0.3 s', lambda r, g: t.in_bursts(0.3)),
    Fault('piled-up', 'bytes pile up for 1.2 s', _held(1.2), lasts_s=1.0),
    _line('late-long', 'everything comes 1.2 s late for 3.5 s', lambda r, g: t.late(1.2),
          lasts_s=3.5),
)  # fmt: skip
"""The unit's clock, and how late its bytes come."""

TOGETHER = (
    *(_line(f'tool-gain-{g:g}', f'a gain of {g:g} % on all coils, 10 s',
            lambda r, rng, g=g: t.gain(1.0 + g / 100.0, t.TOOL), lasts_s=10.0)
      for g in (1.0, 1.5, 2.0)),
    *(_line(f'tool-drift-{g:g}', f'the gain of all coils drifts by {g:g} % in 15 s',
            lambda r, rng, g=g: t.drifting(g / 1500.0, t.TOOL, r.rate_hz), lasts_s=15.0)
      for g in (1.0, 1.5, 2.0)),
    *(_line(f'references-drift-{g:g}', f'all references drift by {g:g} %/min',
            lambda r, rng, g=g: t.drifting(g / 6000.0, ALL_REFERENCES, r.rate_hz), lasts_s=20.0)
      for g in (2.0, 5.0, 15.0)),
    *(_line(f'late-block-{n}', f'clusters are permuted in one window of {n}',
            lambda r, rng, n=n: t.sometimes_permuted(LATE_BLOCK, round(r.rate_hz / RATE_HZ), n),
            lasts_s=10.0)
      for n in (2, 5, 20)),
)  # fmt: skip
"""What changes together, slowly or in some frames; slides and bends are on the recorded path."""

REFERENCES = (
    _line('references-gone', 'the references stop while metal is in force',
          lambda r, g: t.without_columns(ALL_REFERENCES), lasts_s=8.0, world='metal'),
    _line('references-half-ring', '16 of 32 references repeat 100 ms while metal moves',
          lambda r, g: t.ring(MS_100, HALF_REFERENCES), lasts_s=8.0, world='metal'),
    _line('references-all-ring', 'all references repeat 100 ms while metal moves',
          lambda r, g: t.ring(MS_100, ALL_REFERENCES), lasts_s=8.0, world='metal'),
    _line('references-few-ring', '4 references repeat 100 ms while metal moves',
          lambda r, g: t.ring(MS_100, _draw(g, 4)), lasts_s=8.0, world='metal'),
    _line('references-half-gain', 'half of the references are 2 % off',
          lambda r, g: t.gain(1.02, HALF_REFERENCES), lasts_s=8.0, world='metal'),
    _line('references-all-gain', 'all references are 1 % off',
          lambda r, g: t.gain(1.01, ALL_REFERENCES), lasts_s=5.0),
    _line('references-dead', '16 references are noise while metal moves',
          lambda r, g: t.dead(HALF_REFERENCES, g), lasts_s=8.0, world='metal'),
    _line('references-constant', 'all references have one code while metal moves',
          lambda r, g: t.constant(11, ALL_REFERENCES), lasts_s=8.0, world='metal'),
    _line('references-swapped', 'two references are swapped', lambda r, g: t.swapped(11, 20),
          lasts_s=5.0, world='metal'),
    _line('references-inverted', 'four references are inverted',
          lambda r, g: t.gain(-1.0, _draw(g, 4)), lasts_s=5.0, world='metal'),
    _line('references-noisy', 'all references are noisy',
          lambda r, g: t.noise(100.0, ALL_REFERENCES, g), lasts_s=5.0, world='metal'),
    _line('references-moved', 'a station of references is turned',
          lambda r, g: t.swapped(9, 10), lasts_s=5.0),
)  # fmt: skip
"""The reference coils."""
