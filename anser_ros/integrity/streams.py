"""Judges a stream of messages: does it have one sender?

The middleware numbers the messages of a publisher, 1, 2, 3, but does not identify the publisher.
Messages that continue one sequence are one stream; a second sequence is a second sender,
recognised by its first message. The number of publishers that the graph knows distinguishes a lost
message from another sequence, and shows when a sender has gone. A sender that crashed stays in the
graph for some time: it does not count once it has been silent, unless its last message holds until
it is replaced.
"""

from collections.abc import Hashable
from dataclasses import dataclass

SILENT_S = 1.0
"""A sender of a stream that said nothing for this time, s, counts as gone."""


@dataclass
class _Run:
    """Consecutive messages of one sender: the last number, when it came, and what holds by it."""

    number: int
    received_s: float
    lasting: Hashable


class Senders:
    """Distinguishes the senders of one topic.

    With ``is_constant`` what a sender says never changes: who says otherwise is another one,
    whatever number the message has. ``complaint`` is why the topic cannot be believed now; it is
    empty while there is one sender.
    """

    def __init__(self, topic: str, is_constant: bool = False) -> None:
        self._topic, self._is_constant = topic, is_constant
        self._runs: list[_Run] = []
        self._is_numbered = True
        self.complaint = ''

    def forget(self) -> None:
        """Forget all that was received."""
        self._runs, self.complaint = [], ''

    def continues(self, number: int | None) -> bool:
        """Return whether a message is the next one of the only sender that is received."""
        return len(self._runs) == 1 and number == self._runs[0].number + 1

    def take(
        self, number: int | None, publishers: int, now_s: float, lasting: Hashable = None
    ) -> bool:
        """Take a message; return whether it may be believed.

        ``number`` is its sender's number for it, None where the middleware gives none;
        ``publishers`` is how many the graph knows. ``lasting`` is what it says, where that holds
        until the sender says otherwise: senders that say the same do not contradict each other.
        """
        self._is_numbered = number is not None
        if number is not None:
            self._drop_silent(now_s)
            run = self._run_of(number, publishers)
            if run is not None and self._is_constant and run.lasting != lasting:
                run = None
            if run is None:
                if publishers <= 1 and len(self._runs) == 1 and self._is_ended(lasting, now_s):
                    self._runs.clear()  # it has gone, and this is its successor
                self._runs.append(_Run(number, now_s, lasting))
            else:
                run.number, run.received_s, run.lasting = number, now_s, lasting
        return not self.look(publishers, now_s)

    def look(self, publishers: int, now_s: float) -> str:
        """Return `complaint` as it is now, when no message has come."""
        self._drop_silent(now_s)
        complaint = {run.lasting for run in self._runs}
        agree = len(complaint) == 1 and None not in complaint
        if not self._is_numbered and publishers > 1:
            self.complaint = f'{publishers} publishers of {self._topic}'
        elif len(self._runs) > 1 and not agree:
            self.complaint = f'two publishers of {self._topic}'
        else:
            self.complaint = ''
        return self.complaint

    def _drop_silent(self, now_s: float) -> None:
        """Drop the runs that have ended.

        A lasting message outlives its sender's silence. When one of several senders has gone, it
        is unknown which, so their messages stay valid until they are forgotten and requested
        again.
        """
        self._runs = [
            run
            for run in self._runs
            if now_s - run.received_s < SILENT_S or run.lasting is not None
        ]

    def _is_ended(self, lasting: Hashable, now_s: float) -> bool:
        """Return whether silence shows that a sender has gone, to whom another one may succeed.

        It does not where what was said holds on: the graph may not know the second one yet.
        """
        (run,) = self._runs
        if run.lasting is not None:
            return run.lasting == lasting
        return now_s - run.received_s >= SILENT_S

    def _run_of(self, number: int, publishers: int) -> _Run | None:
        """Return the run that a message continues; None for the first of another."""
        for run in self._runs:
            if number == run.number + 1:
                return run
        if publishers > 1:
            return None
        earlier = [run for run in self._runs if run.number < number]
        return max(earlier, key=lambda run: run.number, default=None)
