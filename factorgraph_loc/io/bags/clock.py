"""Which clock stamps the messages of a bag: that of their headers, set where they were measured, or that of the recorder."""

from array import array
from typing import Any, Literal

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.io.bags.fields import as_nanoseconds, has_header
from factorgraph_loc.io.bags.file import Bag, Stamped, Topic

Clock = Literal["header", "receive"]
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")  # the latter in old bags
APART = 0.5  # s: offsets of topics that differ by more come from different clocks, no longer from delays


class Stamper:
    """Stamps of the messages of one topic [ns], by a ``clock``; messages without a header are stamped as they were received.

    Those of tf have headers within, which :meth:`choose` is for."""

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
        return self.choose(item.message.header.stamp, item.received)

    def choose(self, stamp: Any, received: int) -> int:
        """The one of a header's stamp and the time of receipt that counts."""
        return self.heard(as_nanoseconds(stamp, 1), received)

    def heard(self, in_header: int, received: int) -> int:
        """The same of a stamp in nanoseconds."""
        self._any_set |= in_header != 0
        self._delays.append(received - in_header)
        return in_header if self.uses_header else received

    def check(self) -> None:
        """InputError if the headers should have told the time, but all say 0."""
        if self.uses_header and len(self._delays) > 1 and not self._any_set:
            raise InputError(f'{self._where}: the stamps of all headers are 0: set clock = "receive" in the manifest')

    def delay(self) -> float | None:
        """Median of receipt after header [s]; None where there are no headers that are set."""
        if not self._any_set:
            return None
        return float(np.median(np.frombuffer(self._delays, dtype=np.int64))) / 1e9


def report(stampers: list[Stamper], clock: Clock) -> tuple[str, list[str]]:
    """A line on the clock that was used and the delays that were found, and warnings."""
    delays = {s.topic.name: delay for s in stampers if (delay := s.delay()) is not None}
    line = "header stamps" if clock == "header" else "time of receipt"
    if bare := sorted({s.topic.name for s in stampers if not s.has_header}):
        line += f"; without headers, as received: {', '.join(bare)}" if clock == "header" else ""
    if delays:
        line += "; received after the header's stamp (median): "
        line += ", ".join(f"{name} {delay:.3f} s" for name, delay in sorted(delays.items()))
    warnings = []
    # of a recorder that stamps everything the delay is 0
    compared = {s.topic.name: s.delay() if s.uses_header else 0.0 for s in stampers}
    known = {name: delay for name, delay in compared.items() if delay is not None}
    if known and max(known.values()) - min(known.values()) > APART:
        low, high = min(known, key=known.__getitem__), max(known, key=known.__getitem__)
        warnings.append(
            f"the clocks of {low} and {high} differ by {known[high] - known[low]:.3f} s: "
            "choose clock in the manifest, or set time_offset in the rig"
        )
    return line, warnings
