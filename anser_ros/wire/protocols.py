"""Lists the serial protocols of control units that a port can speak.

A protocol turns bytes into records and commands into bytes. The rest of the package knows a
control unit only by its records (`records.Hello`, `SampleBlock`, `DeviceStatus`, `Reply`): another
unit's reader translates the received bytes into them. Everything above the port stays the same.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from anser_ros.errors import PortError
from anser_ros.wire.frame_reader import FrameReader
from anser_ros.wire.frames import encode
from anser_ros.wire.records import Hello, Payload, Record, SetFrequencies, check_hello


class RecordReader(Protocol):
    """Finds records in received bytes; one instance serves one port for as long as it exists.

    ``last_refusal`` says in words for an operator why the last refused record was refused.
    """

    last_refusal: str

    def feed(self, data: bytes) -> list[Record]:
        """Take bytes as they come and return the records that they complete.

        It must not raise, whatever the bytes are: an exception closes the port, which is opened
        again. Bytes that cannot be read are counted, and the reason is kept in ``last_refusal``.
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
        Bytes of a command (`records.Identify`, `SetFrequencies`, `Start`, `Stop`) with a tag that
        its reply repeats. A command that the unit does not have is no bytes.
    """

    make_reader: Callable[[], RecordReader]
    encode: Callable[[Payload, int], bytes]

    @property
    def sets_tones(self) -> bool:
        """Return whether the host can change the unit's tones."""
        return bool(self.encode(SetFrequencies((1.0,)), 1))


def records_of(reader: RecordReader, data: bytes) -> list[Record]:
    """Return the records that a reader completes with these bytes.

    Raises
    ------
    PortError
        When the reader fails, or gives a hello that no receiver could use.
    """
    try:
        records = reader.feed(data)
        for record in records:
            if isinstance(record.payload, Hello):
                check_hello(record.payload)
    except Exception as error:
        words = ' '.join(str(error).split())
        raise PortError(f'the frame reader failed: {type(error).__name__}: {words}') from error
    return records


ANSER = SerialProtocol(FrameReader, encode)
"""Version 1 of the protocol of `docs/cu_protocol.md`."""

PROTOCOLS = {'anser': ANSER}
"""By the name that the parameter ``protocol`` of ``acquisition`` takes."""
