"""What can happen to samples and records between the control unit and the host."""

import itertools
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from line import Tamper, inside, with_crc

from anser_ros.wire.frames import Channel, ChannelKind, Hello, SampleBlock

TOOL, REFERENCE = slice(0, 9), slice(9, 41)
"""Columns of the demo's nine tool coils, and of its 32 reference coils; the current is last."""


def _in_place(change: Callable[[np.ndarray], None]) -> Tamper:
    """Change the codes (n, C) of every block where they stand."""

    def block(given: SampleBlock) -> SampleBlock:
        codes = np.array(given.codes)
        change(codes)
        return replace(given, codes=codes)

    return inside(block=block)


def columns(change: Callable[[np.ndarray], np.ndarray], where: object) -> Tamper:
    """Change the codes of some columns, which stay within the range of the converter."""

    def altered(codes: np.ndarray) -> None:
        codes[:, where] = _rounded(change(codes[:, where].astype(float)))

    return _in_place(altered)


def _rounded(codes: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(codes), -32768, 32767).astype(np.int16)


def gain(factor: float, where: object) -> Tamper:
    """Multiply columns."""
    return columns(lambda codes: factor * codes, where)


def drifting(per_second: float, where: object, rate_hz: float) -> Tamper:
    """Let the gain of columns grow by so much a second."""
    seen = itertools.count()
    return columns(lambda codes: codes * (1.0 + per_second * next(seen) * len(codes) / rate_hz),
                   where)  # fmt: skip


def sometimes_permuted(order: Sequence[int], samples: int, every: int) -> Tamper:
    """Permute the tool's columns in one stretch of so many samples of so many stretches."""
    seen = itertools.count()

    def change(codes: np.ndarray) -> None:
        place = np.array([next(seen) for _ in codes]) // samples
        late = place % every == 0
        codes[late, : len(order)] = codes[late][:, order]

    return _in_place(change)


def offset(codes_up: float, where: object) -> Tamper:
    """Shift columns by a constant."""
    return columns(lambda codes: codes + codes_up, where)


def hum(amplitude: float, where: object, rate_hz: float) -> Tamper:
    """Add mains hum of 50 Hz."""
    seen = itertools.count()

    def change(codes: np.ndarray) -> np.ndarray:
        time = np.array([next(seen) for _ in codes]) / rate_hz
        wave = sum(np.sin(2 * np.pi * k * 50.0 * time) / k for k in (1, 3, 5))
        return codes + amplitude * wave[:, None]

    return columns(change, where)


def noise(sigma: float, where: object, rng: np.random.Generator) -> Tamper:
    """Add white noise, codes rms."""
    return columns(lambda codes: codes + sigma * rng.standard_normal(codes.shape), where)


def dead(where: object, rng: np.random.Generator) -> Tamper:
    """Leave noise only."""
    return columns(lambda codes: 2.4 * rng.standard_normal(codes.shape), where)


def constant(value: int, where: object) -> Tamper:
    """Replace columns by one code."""
    return columns(lambda codes: np.full_like(codes, value), where)


def clipped(share: float, where: object) -> Tamper:
    """Clip columns at the ends of the range, as an amplifier that is driven too far."""
    return columns(lambda codes: codes / share, where)


def swapped(one: int, other: int) -> Tamper:
    """Exchange two columns."""

    def change(codes: np.ndarray) -> None:
        codes[:, [one, other]] = codes[:, [other, one]]

    return _in_place(change)


def mixed(target: int, source: int, share: float) -> Tamper:
    """Let one column leak into another."""

    def change(codes: np.ndarray) -> None:
        codes[:, target] = _rounded(codes[:, target] + share * codes[:, source].astype(float))

    return _in_place(change)


def ring(samples: int, where: object = slice(None)) -> Tamper:
    """Repeat the last samples of some columns for ever, under fresh numbers and stamps."""
    memory = np.zeros((0, 0), dtype=np.int16)
    place = 0

    def change(codes: np.ndarray) -> None:
        nonlocal memory, place
        if len(memory) < samples:
            memory = np.concatenate([memory, codes]) if memory.size else codes.copy()
            return
        rows = len(memory) - samples + (place + np.arange(len(codes))) % samples
        place += len(codes)
        codes[:, where] = memory[rows][:, where]

    return _in_place(change)


def without_columns(where: Sequence[int]) -> Tamper:
    """Take channels away from hellos and blocks: a board of inputs that was unplugged."""
    gone = set(where)

    def hello(given: Hello) -> Hello:
        left = tuple(c for i, c in enumerate(given.channels) if i not in gone)
        return replace(given, channels=left)

    def block(given: SampleBlock) -> SampleBlock:
        left = [i for i in range(given.codes.shape[1]) if i not in gone]
        return replace(given, codes=np.array(given.codes)[:, left])

    return inside(hello=hello, block=block)


def with_column() -> Tamper:
    """Add a channel that the setup does not know."""

    def hello(given: Hello) -> Hello:
        more = Channel(999, ChannelKind.SENSE, 1.0)
        return replace(given, channels=(more, *given.channels))

    def block(given: SampleBlock) -> SampleBlock:
        codes = np.array(given.codes)
        return replace(given, codes=np.hstack([codes[:, :1], codes]))

    return inside(hello=hello, block=block)


def ticks(change: Callable[[int, int], int]) -> Tamper:
    """Change the blocks' time stamps: a function of the ticks and of those at the beginning."""
    return _counted('timestamp_ticks', 64, change)


def numbers(change: Callable[[int, int], int]) -> Tamper:
    """Change the blocks' sequence numbers: a function of the number and of the first one."""
    return _counted('sequence', 32, change)


def _counted(field: str, bits: int, change: Callable[[int, int], int]) -> Tamper:
    first: list[int] = []

    def block(given: SampleBlock) -> SampleBlock:
        value = getattr(given, field)
        first.append(value)
        del first[1:]
        return replace(given, **{field: change(value, first[0]) % 2**bits})

    return inside(block=block)


def each(change: Callable[[bytes], list[bytes]], share: float, rng: np.random.Generator) -> Tamper:
    """Change a share of the records, as bytes."""

    def tamper(records: list[bytes], _on_s: float) -> list[bytes]:
        out: list[bytes] = []
        for record in records:
            out += change(record) if rng.random() < share else [record]
        return out

    return tamper


def bit_flips(share: float, rng: np.random.Generator, *, hidden: bool = False) -> Tamper:
    """Flip a bit in a share of the records; hidden: with a checksum that is right again."""

    def change(record: bytes) -> list[bytes]:
        damaged = bytearray(record)
        place = int(rng.integers(12, len(record) - 4))
        damaged[place] ^= 1 << int(rng.integers(8))
        return [with_crc(bytes(damaged)) if hidden else bytes(damaged)]

    return each(change, share, rng)


def torn(share: float, rng: np.random.Generator) -> Tamper:
    """Lose the rest of a share of the records."""
    return each(lambda record: [record[: int(rng.integers(1, len(record)))]], share, rng)


def garbage(share: float, rng: np.random.Generator) -> Tamper:
    """Put bytes that are nothing in front of a share of the records."""
    return each(lambda record: [rng.bytes(int(rng.integers(1, 900))), record], share, rng)


def noise_only(rng: np.random.Generator) -> Tamper:
    """Let nothing but noise arrive."""
    return lambda records, _on_s: [rng.bytes(len(record)) for record in records]


def nothing() -> Tamper:
    """Let nothing arrive."""
    return lambda _records, _on_s: []


def lost(share: float, rng: np.random.Generator) -> Tamper:
    """Lose a share of the records."""
    return each(lambda _record: [], share, rng)


def doubled(share: float, rng: np.random.Generator) -> Tamper:
    """Let a share of the records arrive twice."""
    return each(lambda record: [record, record], share, rng)


def replayed(seconds: float) -> Tamper:
    """Let all records of the first seconds arrive again and again in place of the live ones."""
    kept: list[bytes] = []
    again: Iterator[bytes] = iter(())

    def tamper(records: list[bytes], on_s: float) -> list[bytes]:
        nonlocal again
        if on_s < seconds:
            kept.extend(records)
            again = itertools.cycle(kept)
            return records
        return list(itertools.islice(again, len(records)))

    return tamper


def shuffled(depth: int, rng: np.random.Generator) -> Tamper:
    """Let blocks arrive in another order."""
    waiting: list[bytes] = []

    def tamper(records: list[bytes], _on_s: float) -> list[bytes]:
        waiting.extend(records)
        out = []
        while len(waiting) > depth:
            out.append(waiting.pop(int(rng.integers(len(waiting)))))
        return out

    return tamper


def _delayed(delay: Callable[[float], float]) -> Tamper:
    """Let everything arrive later, s, by a function of the time, s, that this goes on."""
    waiting: deque[tuple[float, bytes]] = deque()

    def tamper(records: list[bytes], on_s: float) -> list[bytes]:
        waiting.extend((on_s + delay(on_s), record) for record in records)
        out = []
        while waiting and waiting[0][0] <= on_s:
            out.append(waiting.popleft()[1])
        return out

    return tamper


def late(seconds: float) -> Tamper:
    """Let everything arrive later by a constant."""
    return _delayed(lambda _: seconds)


def creeping(per_second: float) -> Tamper:
    """Let everything arrive later and later, by so many seconds a second."""
    return _delayed(lambda on_s: per_second * on_s)


def in_bursts(period_s: float) -> Tamper:
    """Let everything arrive in bursts, as from a host that is busy."""
    waiting: list[bytes] = []
    next_s = period_s

    def tamper(records: list[bytes], on_s: float) -> list[bytes]:
        nonlocal next_s
        waiting.extend(records)
        if on_s < next_s:
            return []
        next_s = on_s + period_s
        out = waiting[:]
        waiting.clear()
        return out

    return tamper


def hello(**changes: object) -> Tamper:
    """Change what hellos state."""
    return inside(hello=lambda given: replace(given, **changes))


def hello_scaled(**factors: float) -> Tamper:
    """Multiply figures of hellos."""
    return inside(
        hello=lambda given: replace(
            given, **{k: getattr(given, k) * f for k, f in factors.items()}
        )
    )


def scaled_channels(factor: float) -> Callable[[Hello], Hello]:
    """Return what multiplies the full scale of all channels."""
    return lambda given: replace(
        given, channels=tuple(replace(c, full_scale=factor * c.full_scale) for c in given.channels)
    )


def reordered_channels() -> Callable[[Hello], Hello]:
    """Return what moves the first channel to the end of the tool's."""

    def change(given: Hello) -> Hello:
        first, *rest = given.channels[:9]
        return replace(given, channels=(*rest, first, *given.channels[9:]))

    return change
