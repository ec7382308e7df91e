"""Reads the fields and the timestamps of the messages of a bag, and passes the messages to collectors.

A field has a path: ``tag.epc``, or ``reads[].tag.epc`` for a list. Paths are checked against the message type before messages
are read. Errors list the available fields. A timestamp is the header's (time of measurement) or the time of receipt.
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Callable, Mapping, Sequence
from itertools import repeat
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeVar

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import checks
from factorgraph_loc.files.models import FileModel
from factorgraph_loc.files.row_rules import Fault, RowRules
from factorgraph_loc.io.bags.file import Bag, Stamped, Topic
from factorgraph_loc.text import Notice, error_text, listed, notice, quoted
from factors.se2 import Array, Integers

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

LIST = "[]"
ELEMENT = re.compile(r"\[(\d+)\]$")  # matches the index at the end of a path such as covariance[0]
BYTES = ("uint8", "byte", "char", "octet")  # a list of these types is one value, such as an EPC
TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
HEADER = "std_msgs/msg/Header"
DEPTH = 6  # maximum nesting level of messages whose fields are listed

Row = tuple[Any, ...]
Clock = Literal["header", "receive"]
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")  # the latter in old bags
MAX_DELAY = 0.5  # s; larger differences between topics are clock offsets, not delays


class TopicSettings(FileModel):
    """Base class of the settings of a ROS topic: its name and its clock."""

    topic: str
    """name of the topic"""
    clock: Clock | None = None
    """timestamps to use: header for the timestamps of message headers, receive for the times of receipt; by default the
    setting clock of the bag"""


class RowTopic(TopicSettings, RowRules):
    """Base class of settings of a ROS topic. Invalid messages may be skipped, and messages may be sorted by time."""


class Fields:
    """Extracts the values of some fields from the messages of a topic.

    ``paths``: {name of a field: its path in the message}. ``names``: the names. Raises InputError if a path is unknown.
    """

    def __init__(self, bag: Bag, topic: Topic, paths: Mapping[Any, str]) -> None:
        self.names = tuple(paths)
        self._where = f"{bag.path}: topic {topic.name}"
        for name, path in paths.items():
            check_path(bag.store(topic.name), topic, path, f"{self._where}: {name}")
        self._getters = [_getter(path) for path in paths.values()]
        self._are_lists = [LIST in path for path in paths.values()]

    def rows(self, message: Any, row: int) -> list[Row]:
        """Return the values of the fields in ``message``, as a list of tuples in the order of ``names``.

        The list has one tuple, or if a path leads through a list, one for each element. ``row``: number of the message,
        for errors. Raises InputError if lists have different lengths.
        """
        values = [get(message) for get in self._getters]
        if not any(self._are_lists):
            return [tuple(values)]
        lengths = [len(value) for value, is_list in zip(values, self._are_lists, strict=True) if is_list]
        if len(set(lengths)) > 1:
            counts = ", ".join(map(str, lengths))
            raise InputError(f"{self._where}: message {row} has lists of {counts} elements, expected equal lengths")
        columns = (v if is_list else repeat(v) for v, is_list in zip(values, self._are_lists, strict=True))
        return list(zip(*columns, strict=False))  # zip ends with the lists, because repeat() is endless


def check_path(store: Typestore, topic: Topic, path: str, where: str) -> None:
    """Raise InputError if the messages of a topic lack the field ``path``. The error lists the available fields.

    ``store``: the message definitions. ``where``: the beginning of the error.
    """
    known = leaves(store, topic.type)
    if path not in known and path + LIST not in known and ELEMENT.sub(LIST, path) not in known:
        raise InputError(f"{where} is {quoted(path)}, which {topic.type} lacks; its fields: {listed(known)}")
    if path.count(LIST) > 1:
        raise InputError(f"{where} is {quoted(path)}, a list within a list, expected at most one {LIST}")


def leaves(store: Typestore, kind: str, prefix: str = "", depth: int = DEPTH) -> list[str]:
    """Return the paths of all numbers, texts, bytes and timestamps in the message type ``kind``, such as
    "header.stamp".

    ``store``: the message definitions. ``prefix``: put before each path. ``depth``: maximum nesting level.
    """
    out: list[str] = []
    definition: Any = store.fielddefs[kind][1]
    for name, (form, detail) in definition:
        path, label, inner = f"{prefix}{name}", form.name, detail
        if label in {"ARRAY", "SEQUENCE"}:
            (element, inner), _ = detail
            label = element.name
            path += "" if label == "BASE" and inner[0] in BYTES else LIST
        if label == "BASE" or inner in TIMES:
            out.append(path)
        elif depth and inner in store.fielddefs:
            out += leaves(store, str(inner), f"{path}.", depth - 1)
    return out


def has_header(bag: Bag, topic: Topic) -> bool:
    """True if the messages of a topic begin with a header."""
    fields: Any = bag.store(topic.name).fielddefs[topic.type][1]
    return bool(fields) and fields[0][0] == "header" and fields[0][1][1] == HEADER


def as_text(value: Any) -> str:
    """Return a value as a name: text without spaces around it, bytes as hexadecimal digits (an EPC), a number in decimal digits.

    The elements of a list are joined by hyphens.
    """
    if isinstance(value, str):
        return value.strip()
    if isinstance(value, np.ndarray) and value.dtype == np.uint8:
        return value.tobytes().hex().upper()
    if isinstance(value, (bytes, bytearray)):
        return value.hex().upper()
    if isinstance(value, (np.ndarray, list)):  # marker numbers of a bundle
        return "-".join(str(part) for part in value)
    return str(value)


def as_number(value: Any) -> float:
    """Return the value as a number, or NaN if it is not a number."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return math.nan


def as_nanoseconds(value: Any, unit: int) -> int:
    """Return a timestamp in nanoseconds. ``value``: a ROS time, or a number in units of ``unit`` nanoseconds.

    Raises ValueError if ``value`` is a text that is not a number.
    """
    if hasattr(value, "nanosec"):
        return int(value.sec) * 10**9 + int(value.nanosec)
    if isinstance(value, int):
        return value * unit
    return round(float(value) * unit)


def _getter(path: str) -> Callable[[Any], Any]:
    """Return a function that gets the field at ``path`` from a message.

    The path ``list[2]`` gets one element of a list. The path ``list[].field`` gets the field of all elements as a list.
    """
    if element := ELEMENT.search(path):
        of_list, i = attrgetter(path[: element.start()]), int(element[1])
        return lambda message: of_list(message)[i]
    outer, is_list, inner = path.partition(LIST)
    get = attrgetter(outer)
    if not is_list:
        return get
    within: Callable[[Any], Any] = attrgetter(inner.lstrip(".")) if inner else lambda element: element
    return lambda message: [within(element) for element in get(message)]


def _getter_of(paths: Sequence[str]) -> Callable[[Any], Any]:
    """Return a function that gets a tuple of the fields at ``paths`` from a message, or one value for one path."""
    if any(ELEMENT.search(path) for path in paths):
        getters = [_getter(path) for path in paths]
        return lambda message: [get(message) for get in getters]
    return attrgetter(*paths)


class TopicRows:
    """Collects rows of numbers, each with a timestamp and the number of its message within the topic, counted from 1.

    ``source``: the bag and the topic, for errors. ``width``: how many numbers a row has. ``paths``: the fields that
    form the row of a message. Without paths, the caller appends rows. A value that is not a number becomes NaN.
    ``rules``: whether invalid rows are skipped, and rows sorted by time. By default an invalid row and a decreasing
    timestamp are errors.
    """

    def __init__(self, source: str, width: int, paths: Sequence[str] = (), rules: RowRules | None = None) -> None:
        self.source = source
        self.rules = rules or RowRules()
        self._width = width
        self._get = _getter_of(paths) if paths else None
        self._row, self._t_ns, self._values = array("q"), array("q"), array("d")

    def add(self, item: Stamped, t_ns: int) -> None:
        """Add the row of the message ``item`` with the timestamp ``t_ns``."""
        assert self._get is not None
        values = self._get(item.message)
        self.append(item, t_ns, values if self._width > 1 else (values,))

    def append(self, item: Stamped, t_ns: int, values: Sequence[Any]) -> None:
        self._row.append(item.row)
        self._t_ns.append(t_ns)
        self._values.extend(map(as_number, values))

    def __len__(self) -> int:
        return len(self._row)

    @property
    def rows(self) -> Integers:
        return np.array(self._row, dtype=np.int64)

    @property
    def t_ns(self) -> Integers:
        return np.array(self._t_ns, dtype=np.int64)

    @property
    def values(self) -> Array:
        """The numbers (N, width) of all rows."""
        return np.array(self._values, dtype=float).reshape(-1, self._width)

    def in_order(self, names: Sequence[str], warnings: list[Notice]) -> tuple[Integers, Array]:
        """Return the timestamps (M,) [ns] and the numbers (M, width) of the valid rows, in order of time.

        ``names``: the names of the columns, for errors. A row with a number that is not finite is invalid. Raises
        InputError at an invalid row or a decreasing timestamp, unless ``rules`` skip or sort such rows. Then warnings
        are appended to ``warnings``.
        """
        keep = self.kept(checks.not_finite(names, self.values), warnings)
        return self.t_ns[keep], self.values[keep]

    def kept(self, faults: Sequence[Fault], warnings: list[Notice], among: Integers | None = None) -> Integers:
        """Return the indices of the valid rows in order of time. Of rows with equal timestamps, only the last is
        returned.

        ``faults``: the invalid cells. ``among``: indices of the rows that ``faults`` describe; other rows are not
        returned. None: all rows. Raises InputError at an invalid row or a decreasing timestamp, unless ``rules`` skip
        or sort such rows. Then a warning is appended to ``warnings``.
        """
        rows, t_ns = self.rows, self.t_ns
        keep = np.arange(len(rows)) if among is None else among
        keep = keep[self.rules.usable(self.source, rows[keep], faults, warnings)]
        keep = keep[self.rules.in_time(self.source, rows[keep], t_ns[keep], warnings)]
        return keep[checks.in_order(self.source, rows[keep], t_ns[keep], warnings, self.rules)]


class Gatherer(Protocol):
    """Protocol of collectors of data from the messages of a topic. ``add`` checks a message and copies its data."""

    def add(self, item: Stamped, t_ns: int) -> None: ...


G = TypeVar("G", bound=Gatherer)


class Listeners:
    """The collectors of data from the topics of a bag. :meth:`run` passes the messages to them.

    ``clock``: "header" or "receive", the timestamps to use for topics without a clock setting.
    """

    def __init__(self, bag: Bag, clock: Clock) -> None:
        self.bag, self.clock = bag, clock
        self.stampers: list[Stamper] = []
        self._of: dict[str, list[tuple[Stamper | None, Gatherer]]] = {}

    def stamper(self, topic: str, clock: Clock | None) -> Stamper:
        """Return the :class:`Stamper` of a topic. ``clock``: the setting of the topic, None for the setting of the bag."""
        return Stamper(self.bag, self.bag.topic(topic), clock or self.clock)

    def add(self, topic: str, gatherer: Gatherer, stamper: Stamper | None = None) -> None:
        """Register the collector ``gatherer`` for a topic. Without ``stamper``, timestamps are times of receipt."""
        self._of.setdefault(topic, []).append((stamper, gatherer))
        if stamper is not None:
            self.stampers.append(stamper)

    def listen(self, options: TopicSettings, gatherer: G) -> G:
        """Register the collector ``gatherer`` for the topic and the clock in ``options``, and return the collector."""
        self.add(options.topic, gatherer, self.stamper(options.topic, options.clock))
        return gatherer

    @property
    def topics(self) -> tuple[str, ...]:
        """The names of the topics that have collectors."""
        return tuple(self._of)

    def run(self) -> None:
        """Read the bag once, and pass each message to the collectors of its topic. Raises InputError at an invalid message."""
        for item in self.bag.messages(list(self._of)):
            for stamper, gatherer in self._of[item.topic]:
                try:
                    gatherer.add(item, item.received if stamper is None else stamper.stamp(item))
                except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
                    kind = self.bag.topics[item.topic].type
                    where = f"{self.bag.path} {item.topic}:{item.row}"
                    raise InputError(
                        f"{where}: the definition of {kind} in the bag differs from that of ROS: {error_text(error)}"
                    ) from error
        for stamper in self.stampers:
            stamper.check()


class Stamper:
    """Chooses the timestamps [ns] of the messages of one topic.

    If ``clock`` is "header", a timestamp is that of the header, or the time of receipt if a message has no header. If
    it is "receive", a timestamp is the time of receipt. Messages of tf have several headers: use :meth:`choose`.
    """

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
        """Return the timestamp [ns] that the clock setting selects: ``in_header`` or ``received``."""
        self._any_set |= in_header != 0
        self._delays.append(received - in_header)
        return in_header if self.uses_header else received

    def check(self) -> None:
        """Raise InputError if the timestamps of headers are used but all of them are 0."""
        if self.uses_header and len(self._delays) > 1 and not self._any_set:
            raise InputError(f'{self._where}: all header timestamps are 0: set clock = "receive" in the manifest')

    def delay(self) -> float | None:
        """Return the median delay [s] from the header's timestamp to receipt. Returns None if no header has a timestamp."""
        if not self._any_set:
            return None
        return float(np.median(np.frombuffer(self._delays, dtype=np.int64))) / 1e9


def report(stampers: list[Stamper], clock: Clock) -> tuple[str, list[Notice]]:
    """Return a text about the timestamps in use and the delays of receipt, and a list of warnings if clocks differ.

    ``stampers``: the sources of timestamps of all topics. ``clock``: the clock setting of the bag.
    """
    delays = {s.topic.name: delay for s in stampers if (delay := s.delay()) is not None}
    line = "timestamps of headers" if clock == "header" else "time of receipt"
    if bare := sorted({s.topic.name for s in stampers if not s.has_header}):
        line += f"; topics without headers have the time of receipt: {', '.join(bare)}" if clock == "header" else ""
    if delays:
        line += "; median delay of receipt after the header's timestamp: "
        line += ", ".join(f"{name} {delay:.3f} s" for name, delay in sorted(delays.items()))
    warnings = []
    # a topic that uses the time of receipt has no delay
    compared = {s.topic.name: s.delay() if s.uses_header else 0.0 for s in stampers}
    known = {name: delay for name, delay in compared.items() if delay is not None}
    if known and max(known.values()) - min(known.values()) > MAX_DELAY:
        low, high = min(known, key=known.__getitem__), max(known, key=known.__getitem__)
        sentence = (
            "the clocks of {low} and {high} differ by {delay:.3f} s: "
            "choose clock in the manifest, or set time_offset in the rig"
        )
        warnings.append(notice("clocks_differ", sentence, low, high, known[high] - known[low]))
    return line, warnings
