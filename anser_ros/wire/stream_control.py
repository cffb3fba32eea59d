"""Chooses the next command that the control unit needs in order to stream what the host wants."""

from __future__ import annotations

from anser_ros.wire.frames import TYPE_OF
from anser_ros.wire.records import (
    Hello,
    Identify,
    Payload,
    Record,
    Reply,
    ReplyCode,
    SampleBlock,
    SetFrequencies,
    Start,
)

_REPEAT_NS = 500_000_000
"""Time (0.5 s) after which a command without effect is sent again; an answer takes far less."""
_DOUBT_NS = 60_000_000_000
"""Time (1 min) for which the unit is asked again after its hello has changed: by itself it says it
once a second, and a wrong one has no poses until the next."""
_ASK_NS = 250_000_000
"""Time (0.25 s) from one such question to the next. Each costs a hello of some hundred bytes."""
_TONE_TOLERANCE_HZ = 1.0
"""Difference up to which a frequency of the device is that of the setup, Hz; synthesisers
round."""


class StreamControl:
    """Follows the records of one connection and determines the commands to send.

    The order is: hello, right tones (where the host may set them), start, samples. Each command is
    repeated every half second until the control unit does what it asks; a refusal is kept as text
    and not repeated. After a hello that contradicts a good one, the unit is asked again for a
    minute. Samples that arrive before the reply to the start command are left over from a buffer.
    """

    def __init__(self, frequencies_hz: tuple[float, ...], *, set_frequencies: bool = True) -> None:
        self._wanted = frequencies_hz
        self._may_set = set_frequencies
        self.hello: Hello | None = None
        self.refusal = ''
        self.started = False
        self._refused = False
        self._last_block_ns = 0
        self._doubted_ns: int | None = None
        self._last_sent: dict[type, int] = {}

    def reset(self) -> None:
        """Begin a new connection."""
        self.hello = None
        self.refusal = ''
        self.started = False
        self._refused = False
        self._last_block_ns = 0
        self._doubted_ns = None
        self._last_sent.clear()

    @property
    def tones_agree(self) -> bool:
        """Return whether the control unit drives the tones of the setup document."""
        return self.hello is not None and self._agree(self.hello)

    def take(self, record: Record, arrival_ns: int) -> None:
        """Take in a received record."""
        payload = record.payload
        if isinstance(payload, SampleBlock):
            self._last_block_ns = arrival_ns
        elif isinstance(payload, Hello):
            if self.tones_agree and payload != self.hello:
                self._doubted_ns = arrival_ns
            self.hello = payload
            if self._agree(payload):
                self.refusal = ''
            elif not self._may_set or self._refused:
                self.refusal = self.refusal or _disagreement(self._wanted, payload)
        elif isinstance(payload, Reply) and payload.code is ReplyCode.OK:
            if payload.command == TYPE_OF[Start]:
                self.started = True
                self._last_block_ns = arrival_ns
        elif isinstance(payload, Reply):
            self.refusal = f'the control unit refused: {payload.code.name.lower()} {payload.text}'
            if payload.command == TYPE_OF[SetFrequencies]:
                self._refused = True

    def due(self, now_ns: int) -> Payload | None:
        """Return the command to send now, None when nothing is due."""
        command: Payload
        pause_ns = _REPEAT_NS
        if self.hello is None:
            command = Identify()
        elif not self._agree(self.hello):
            if not self._may_set or self._refused:
                return None
            command = SetFrequencies(self._wanted)
        elif not self.started or now_ns - self._last_block_ns > _REPEAT_NS:
            command = Start()
        elif self._doubted_ns is not None and now_ns - self._doubted_ns < _DOUBT_NS:
            command, pause_ns = Identify(), _ASK_NS
        else:
            return None
        if now_ns - self._last_sent.get(type(command), -pause_ns) < pause_ns:
            return None
        self._last_sent[type(command)] = now_ns
        return command

    def _agree(self, hello: Hello) -> bool:
        return len(hello.frequencies_hz) == len(self._wanted) and all(
            abs(have - want) <= _TONE_TOLERANCE_HZ
            for have, want in zip(hello.frequencies_hz, self._wanted, strict=True)
        )


def _disagreement(wanted: tuple[float, ...], hello: Hello) -> str:
    have = ', '.join(f'{tone:g}' for tone in hello.frequencies_hz)
    want = ', '.join(f'{tone:g}' for tone in wanted)
    return f'the control unit drives {have} Hz, but the setup requires {want} Hz'
