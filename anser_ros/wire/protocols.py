"""Lists the serial protocols of control units that a port can speak.

A protocol turns bytes into records and commands into bytes. The records (`records.Hello`,
`SampleBlock`, `DeviceStatus`, `Reply`) are what the rest of the package knows of any control unit:
another unit's reader translates what it receives into them. Everything above the port stays as
it is.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from anser_ros.wire.frame_reader import FrameReader
from anser_ros.wire.frames import encode
from anser_ros.wire.records import Payload, Record


class RecordReader(Protocol):
    """Finds records in received bytes; one instance serves one port for as long as it exists.

    Attributes
    ----------
    last_refusal : str
        Why the last refused record was refused, in words for an operator; empty when none was.
    """

    last_refusal: str

    def feed(self, data: bytes) -> list[Record]:
        """Take bytes as they come and return the records that they complete.

        It must not raise, whatever the bytes are: an exception ends the thread of the port.
        What cannot be read is counted, and its reason kept in ``last_refusal``. A hello has passed
        `records.check_hello` before it is returned.
        """

    def reset(self) -> None:
        """Forget what belongs to the connection that has ended."""

    def fault_counters(self) -> dict[str, int]:
        """Return what was met so far, by name; the names appear in ``/diagnostics``."""


@dataclass(frozen=True)
class SerialProtocol:
    """Describes how a kind of control unit speaks.

    Attributes
    ----------
    make_reader : callable
        Returns a new `RecordReader`.
    encode : callable
        Bytes of a command (`frames.Identify`, `SetFrequencies`, `Start`, `Stop`) with a tag that
        its reply repeats. A command that the unit does not have is no bytes.
    """

    make_reader: Callable[[], RecordReader]
    encode: Callable[[Payload, int], bytes]


ANSER = SerialProtocol(FrameReader, encode)
"""Version 1 of the protocol of `docs/cu_protocol.md`."""

PROTOCOLS = {'anser': ANSER}
"""By the name that the parameter ``protocol`` of ``acquisition`` takes."""
