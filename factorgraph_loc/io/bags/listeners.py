"""The collectors of the topics of a bag, and the timestamps of messages: those in headers (time of measurement) or those of the
recording."""

from __future__ import annotations

from array import array
from typing import Protocol, TypeVar

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.io.bags.fields import TF, Clock, TopicSettings, as_nanoseconds, has_header
from factorgraph_loc.io.bags.file import Bag, Stamped, Topic
from factorgraph_loc.text import told

APART = 0.5  # s; larger differences between topics are clock offsets, not delays


class Gatherer(Protocol):
    """Collects the needed data from the messages of one topic; messages are not kept, so they are validated here."""

    def add(self, item: Stamped, t_ns: int) -> None: ...


G = TypeVar("G", bound=Gatherer)


class Listeners:
    """The collectors of each topic, with their clocks."""

    def __init__(self, bag: Bag, clock: Clock) -> None:
        self.bag, self.clock = bag, clock
        self.stampers: list[Stamper] = []
        self._of: dict[str, list[tuple[Stamper, Gatherer]]] = {}

    def stamper(self, topic: str, clock: Clock | None) -> Stamper:
        """The timestamps of a topic, by its own clock or that of the bag."""
        return Stamper(self.bag, self.bag.topic(topic), clock or self.clock)

    def add(self, topic: str, gatherer: Gatherer, stamper: Stamper, *, timed: bool = True) -> None:
        """Register a collector. ``timed``: whether timestamps of the topic are meaningful."""
        self._of.setdefault(topic, []).append((stamper, gatherer))
        if timed:
            self.stampers.append(stamper)

    def listen(self, options: TopicSettings, gatherer: G) -> G:
        """Register a collector for a topic and return it."""
        self.add(options.topic, gatherer, self.stamper(options.topic, options.clock))
        return gatherer

    @property
    def topics(self) -> tuple[str, ...]:
        """The topics that are read."""
        return tuple(self._of)

    def run(self) -> None:
        """Read the bag."""
        for item in self.bag.messages(list(self._of)):
            for stamper, gatherer in self._of[item.topic]:
                try:
                    gatherer.add(item, stamper.stamp(item))
                except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
                    kind = self.bag.topics[item.topic].type
                    where = f"{self.bag.path} {item.topic}:{item.row}"
                    raise InputError(f"{where}: {kind} is defined in the bag unlike in ROS: {told(error)}") from error
        for stamper in self.stampers:
            stamper.check()


class Stamper:
    """Timestamps of the messages of one topic [ns], by a ``clock``; the time of receipt for messages without a header. For tf,
    whose headers are nested, use :meth:`choose`."""

    def __init__(self, bag: Bag, topic: Topic, clock: Clock) -> None:
        self.topic = topic
        self._before = has_header(bag, topic)
        self.has_header = self._before or topic.type in TF
        self._where = f"{bag.path}: topic {topic.name}"
        self.uses_header = self.has_header and clock == "header"
        self._delays = array("q")
        self._any_set = False

    def stamp(self, item: Stamped) -> int:
        if not self._before:
            return item.received
        return self.choose(as_nanoseconds(item.message.header.stamp, 1), item.received)

    def choose(self, in_header: int, received: int) -> int:
        """The timestamp of a header or the time of receipt [ns], by the clock."""
        self._any_set |= in_header != 0
        self._delays.append(received - in_header)
        return in_header if self.uses_header else received

    def check(self) -> None:
        """InputError if headers are used but all their timestamps are 0."""
        if self.uses_header and len(self._delays) > 1 and not self._any_set:
            raise InputError(f'{self._where}: the stamps of all headers are 0: set clock = "receive" in the manifest')

    def delay(self) -> float | None:
        """Median delay of receipt after the header's timestamp [s]; None without valid headers."""
        if not self._any_set:
            return None
        return float(np.median(np.frombuffer(self._delays, dtype=np.int64))) / 1e9


def report(stampers: list[Stamper], clock: Clock) -> tuple[str, list[str]]:
    """A line on the clock used and the delays found, and warnings."""
    delays = {s.topic.name: delay for s in stampers if (delay := s.delay()) is not None}
    line = "header stamps" if clock == "header" else "time of receipt"
    if bare := sorted({s.topic.name for s in stampers if not s.has_header}):
        line += f"; without headers, as received: {', '.join(bare)}" if clock == "header" else ""
    if delays:
        line += "; received after the header's stamp (median): "
        line += ", ".join(f"{name} {delay:.3f} s" for name, delay in sorted(delays.items()))
    warnings = []
    # the delay is 0 if the recorder sets both timestamps
    compared = {s.topic.name: s.delay() if s.uses_header else 0.0 for s in stampers}
    known = {name: delay for name, delay in compared.items() if delay is not None}
    if known and max(known.values()) - min(known.values()) > APART:
        low, high = min(known, key=known.__getitem__), max(known, key=known.__getitem__)
        warnings.append(
            f"the clocks of {low} and {high} differ by {known[high] - known[low]:.3f} s: "
            "choose clock in the manifest, or set time_offset in the rig"
        )
    return line, warnings
