"""Access to fields of ROS messages by path: ``tag.epc``, or ``reads[].tag.epc`` for a list.

Paths are checked against the message type before messages are read; errors list the available fields.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from itertools import repeat
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import FileModel
from factorgraph_loc.io.bags.file import Bag, Topic
from factorgraph_loc.text import listed, quoted

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

LIST = "[]"
BYTES = ("uint8", "byte", "char", "octet")  # a list of these is one value, such as an EPC
TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
HEADER = "std_msgs/msg/Header"
DEPTH = 6  # nesting levels of messages

Row = tuple[Any, ...]
Clock = Literal["header", "receive"]
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")  # the latter in old bags


class TopicSettings(FileModel):
    """The settings that all topics have."""

    topic: str
    """name of the topic"""
    clock: Clock | None = None
    """timestamps of message headers or of receipt; by default as for the bag"""


class Fields:
    """Some fields of the messages of a topic. ``rows``: tuples of their values, in the order of ``names``, one for each element of
    the lists in the paths, or one per message without lists."""

    def __init__(self, bag: Bag, topic: Topic, paths: Mapping[Any, str]) -> None:
        self.names = tuple(paths)
        self._where = f"{bag.path}: topic {topic.name}"
        store = bag.store(topic.name)
        for name, path in paths.items():
            check_path(store, topic, path, f"{self._where}: {name}")
        self._getters = [(_list_getter(path) if LIST in path else getter(path)) for path in paths.values()]
        self._are_lists = [LIST in path for path in paths.values()]
        self.has_list = any(self._are_lists)

    def rows(self, message: Any, row: int) -> list[Row]:
        """The rows of message number ``row``; InputError if its lists have different lengths."""
        values = [get(message) for get in self._getters]
        if not self.has_list:
            return [tuple(values)]
        lengths = [len(value) for value, is_list in zip(values, self._are_lists, strict=True) if is_list]
        if len(set(lengths)) > 1:
            told = ", ".join(map(str, lengths))
            raise InputError(f"{self._where}: message {row} has lists of {told} elements, expected lists of one length")
        columns = (v if is_list else repeat(v) for v, is_list in zip(values, self._are_lists, strict=True))
        return list(zip(*columns, strict=False))  # as many as the lists have elements


def check_path(store: Typestore, topic: Topic, path: str, where: str) -> None:
    """InputError with the available fields if the messages lack ``path``."""
    known = leaves(store, topic.type)
    if path not in known and path + LIST not in known:
        raise InputError(f"{where} is {quoted(path)}, which {topic.type} lacks; its fields: {listed(known)}")
    if path.count(LIST) > 1:
        raise InputError(f"{where} is {quoted(path)}, a list within a list, expected at most one {LIST}")


def leaves(store: Typestore, kind: str, prefix: str = "", depth: int = DEPTH) -> list[str]:
    """The paths of all numbers, texts, bytes and timestamps in a message type."""
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
    """Whether the messages of a topic begin with a header."""
    fields: Any = bag.store(topic.name).fielddefs[topic.type][1]
    return bool(fields) and fields[0][0] == "header" and fields[0][1][1] == HEADER


def as_text(value: Any) -> str:
    """A name: text unchanged, bytes as hexadecimal digits (an EPC), a number in decimal digits."""
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
    """A number, or NaN for another value."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return math.nan


def as_nanoseconds(value: Any, unit: int) -> int:
    """A timestamp: a ROS time, or a number in units of ``unit`` nanoseconds. ValueError for another value."""
    if hasattr(value, "nanosec"):
        return int(value.sec) * 10**9 + int(value.nanosec)
    if isinstance(value, int):
        return value * unit
    return round(float(value) * unit)


def getter(path: str) -> Callable[[Any], Any]:
    """A getter of the field at a path, or of the message itself without one."""
    return attrgetter(path) if path else lambda value: value


def _list_getter(path: str) -> Callable[[Any], list[Any]]:
    """A getter of a field of the elements of a list."""
    outer, _, inner = path.partition(LIST)
    get_list, get = attrgetter(outer), getter(inner.lstrip("."))
    return lambda message: [get(element) for element in get_list(message)]
