"""Access to ROS bags with the library ``rosbags``, without ROS.

A bag of version 1 is a file ``.bag``. A bag of version 2 is a folder, or a single file ``.mcap`` or ``.db3``.

Messages are read one by one. Only the index and the current chunk of a bag are kept in memory. A bag is compressed by
chunks (``.bag``, ``.mcap``), by messages, or as a whole file that is unpacked to disk (version 2). The size of unpacked
content is limited, because a few bytes may expand to gigabytes.
"""

from __future__ import annotations

import bz2
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, BinaryIO

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.bounded import DEFINITION, opened, require_size
from factorgraph_loc.files.models import inside, nearest
from factorgraph_loc.text import error_text, quoted

if TYPE_CHECKING:
    from rosbags.interfaces import Connection, MessageDefinition
    from rosbags.typesys.store import Typestore

SMALL, LARGE = 2**24, 2**27  # bytes: a chunk may always unpack to SMALL, and never to more than LARGE
FILE = 2**30  # bytes: unpacked size that is always allowed for a file, if the disk has room
CHUNK_RATIO, FILE_RATIO = 1000, 50  # maximum compression ratio of a chunk above SMALL, of a file above FILE
STEP = 2**22  # bytes that are unpacked at a time
ROS1 = ".bag"
SUFFIXES = (ROS1, ".mcap", ".db3")
METADATA = "metadata.yaml"  # in the folder of a version 2 bag
NO_FILE = 2**63 - 1  # the start time that rosbags returns for a bag without messages

# words in an error message of rosbags, and the cause and repair that our message adds
HINTS = {
    "not indexed": "its recording was cut off: `rosbag reindex` repairs it",
    "index looks damaged": "it is truncated: `rosbag reindex` repairs it",
    "end magic": "it is truncated: `mcap recover` repairs it",
    "missing tables": "it is truncated, or not a bag",
}


@cache
def limit_unpacking() -> None:
    """Limit the unpacked size of compressed bags. Replaces the decompression functions in all readers of ``rosbags``."""
    import lz4.frame  # type: ignore[import-untyped] # noqa: PLC0415 - optional libraries
    from rosbags.rosbag1 import reader as reader1  # noqa: PLC0415
    from rosbags.rosbag2 import reader as reader2  # noqa: PLC0415
    from rosbags.rosbag2 import storage_mcap  # noqa: PLC0415

    zstd = vars(reader2)["zstd"]
    of_bz2 = partial(unpacked, bz2.BZ2Decompressor)
    of_lz4 = partial(unpacked, lz4.frame.LZ4FrameDecompressor)
    of_zstd = partial(unpacked, zstd.ZstdDecompressor)
    reader1.decompressors.update(bz2=of_bz2, lz4=of_lz4)
    storage_mcap.DECOMPRESSORS.update(lz4=lambda data, _: of_lz4(data), zstd=lambda data, _: of_zstd(data))
    vars(reader2)["zstd"] = SimpleNamespace(open=lambda file, _: _File(zstd.open(file, "rb"), file), decompress=of_zstd)


def unpacked(make: Callable[[], Any], data: bytes) -> bytes:
    """Return ``data`` decompressed. ``data`` is one compressed block, or several compressed blocks one after the other.

    ``make``: returns a new decompressor for a block. Raises ValueError if the result is too large or ``data`` is
    truncated.
    """
    limit = max(SMALL, min(LARGE, CHUNK_RATIO * len(data)))
    parts: list[bytes] = []
    count = 0
    while data:
        decompressor = make()
        while not decompressor.eof:
            part = decompressor.decompress(data, max_length=STEP)
            data = b""
            parts.append(part)
            count += len(part)
            if count > limit:
                raise ValueError(f"a chunk or message unpacks to more than {limit:,} bytes, which is too much")
            if not part and decompressor.needs_input:
                raise ValueError("a chunk or message is cut off")
        data = decompressor.unused_data or b""
    return b"".join(parts)


class _File:
    """A file that is decompressed while it is read. Reading raises ValueError if its unpacked size exceeds a limit.

    ``file``: the compressed file. ``content``: the decompressing stream on it."""

    def __init__(self, content: BinaryIO, file: BinaryIO) -> None:
        self._content = content
        room = shutil.disk_usage(tempfile.gettempdir()).free // 2
        self._limit = min(max(FILE, FILE_RATIO * Path(file.name).stat().st_size), room)
        self._count = 0

    def __enter__(self) -> _File:
        return self

    def __exit__(self, *_: object) -> None:
        self._content.close()

    def read(self, size: int) -> bytes:
        part = self._content.read(size)
        self._count += len(part)
        if self._count > self._limit:
            raise ValueError(f"its file unpacks to more than {self._limit:,} bytes, which is too much")
        return part


@dataclass(frozen=True)
class Topic:
    """A topic of a bag. ``type``: its message type in ROS 2 notation (``nav_msgs/msg/Odometry``). ``count``: the number
    of its messages."""

    name: str
    type: str
    count: int


@dataclass(frozen=True)
class Stamped:
    """A message of a bag. ``topic``: the name of its topic. ``row``: its number within the topic, counted from 1.
    ``received``: its time of receipt [ns]. ``message``: the decoded ROS message."""

    topic: str
    row: int
    received: int
    message: Any


class Bag:
    """An open ROS bag. ``topics``: a :class:`Topic` by name. ``duration``: from the first to the last message [s]."""

    def __init__(self, path: Path, reader: Any) -> None:
        self.path = path
        self._reader = reader
        self._stores: dict[str, Typestore] = {}
        self._connections: dict[str, list[Connection]] = {}
        for connection in reader.connections:
            # a text column of SQLite may contain bytes or numbers
            if not isinstance(connection.topic, str) or not isinstance(connection.msgtype, str):
                raise InputError(f"{path}: the name or the type of a topic is not text")
            self._connections.setdefault(connection.topic, []).append(connection)
        self.topics = {
            name: Topic(name, connections[0].msgtype, sum(c.msgcount for c in connections))
            for name, connections in sorted(self._connections.items())
        }
        self.duration = 0.0 if reader.start_time == NO_FILE else max(reader.end_time - 1 - reader.start_time, 0) / 1e9

    def topic(self, name: str, *types: str) -> Topic:
        """Return the topic ``name``. ``types``: the accepted message types; if none is given, any type is accepted.

        Raises InputError if the bag lacks the topic, if its type is not accepted, or if it has no messages. Raises
        InputError also if it has messages of several types.
        """
        if name not in self.topics:
            raise InputError(f"{self.path}: has no topic {quoted(name)}{nearest(name, list(self.topics))}")
        topic = self.topics[name]
        if not topic.count:
            raise InputError(f"{self.path}: topic {name} ({topic.type}) has no messages: leave it out of the manifest")
        kinds = {connection.msgtype for connection in self._connections[name]}
        if len(kinds) > 1:
            raise InputError(
                f"{self.path}: topic {name} has messages of {' and of '.join(sorted(kinds))}, expected one type"
            )
        if types and topic.type not in types:
            expected = "one of " * (len(types) > 1) + ", ".join(types)
            raise InputError(f"{self.path}: topic {name} is of type {topic.type}, expected {expected}")
        return topic

    def store(self, name: str) -> Typestore:
        """Return the message definitions of the topic ``name``: those in the bag, or those of ROS 2 if it has none."""
        if name not in self._stores:
            connection = self._connections[name][0]
            definition = connection.msgdef
            require_size(
                self.path, f"the length of the definition of {connection.msgtype}", len(definition.data), DEFINITION
            )
            with _bag_errors(self.path):
                self._stores[name] = _store(connection.msgtype, definition)
            if connection.msgtype not in self._stores[name].fielddefs:
                raise InputError(
                    f"{self.path}: topic {name} is of type {connection.msgtype}, which the bag does not define: "
                    "convert the bag to mcap on a machine that has the package of this type installed"
                )
        return self._stores[name]

    def messages(self, topics: Sequence[str]) -> Iterator[Stamped]:
        """Yield the messages of ``topics`` in order of receipt. Raises InputError if a message cannot be read."""
        if not topics:
            return
        chosen = [connection for name in topics for connection in self._connections[name]]
        decode = {}
        for name in topics:
            store, kind = self.store(name), self.topics[name].type
            call = store.deserialize_ros1 if self.path.suffix == ROS1 else store.deserialize_cdr
            decode[name] = (call, kind)
        rows = dict.fromkeys(topics, 0)
        source = iter(self._reader.messages(chosen))
        while True:
            with _bag_errors(self.path):
                try:
                    connection, received, raw = next(source)
                except StopIteration:
                    break
                name = connection.topic
                rows[name] += 1
                call, kind = decode[name]
                message = call(raw, kind)
            yield Stamped(name, rows[name], received, message)
        if missing := [name for name in topics if not rows[name]]:
            raise InputError(f"{self.path}: topic {missing[0]} has no messages, although the bag's index lists some")


def is_bag(path: Path) -> bool:
    """True if the path is a ROS bag, judged by its suffix, or by a metadata.yaml in the folder."""
    return (path / METADATA).is_file() if path.is_dir() else path.suffix in SUFFIXES


def require_metadata(folder: Path) -> None:
    """Raise InputError if ``folder`` has the files of a ROS 2 bag, but no metadata.yaml."""
    files = sorted(file.name for file in folder.iterdir() if file.suffix in SUFFIXES[1:]) if folder.is_dir() else []
    if files and not (folder / METADATA).is_file():
        advice = f"`ros2 bag reindex {folder}` writes it; a single file, {folder / files[0]}, can be read without it"
        raise InputError(f"{folder}: is a ROS 2 bag without {METADATA}: {advice}")


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Context manager that opens a bag, yields it, and closes it at the end of the ``with`` block. Raises InputError
    if the bag is unreadable or ``rosbags`` is not installed."""
    if not path.exists():
        raise InputError(f"{path}: does not exist")
    require_metadata(path)
    if not is_bag(path):
        expected = f"a file {', '.join(SUFFIXES)}, or a folder with {METADATA}"
        raise InputError(f"{path}: is not a ROS bag, expected {expected}")
    # a link to a file outside of the folder is an InputError
    files = [inside(path, file.name, path) for file in path.iterdir()] if path.is_dir() else [path]
    for file in files:
        if not file.is_dir():
            with opened(file, sys.maxsize):  # raises InputError at a FIFO and at a pointer file of Git LFS
                pass
    require_rosbags()
    limit_unpacking()
    from rosbags.rosbag1 import Reader as Reader1  # noqa: PLC0415 - an optional library
    from rosbags.rosbag2 import Reader as Reader2  # noqa: PLC0415

    with _bag_errors(path):
        reader: Any = Reader1(path) if path.suffix == ROS1 else Reader2(path)
        reader.open()
    try:
        yield Bag(path, reader)
    finally:
        reader.close()


def require_rosbags() -> None:
    """Raise InputError with the command that installs ``rosbags`` if the library is missing."""
    try:
        import rosbags.interfaces  # noqa: F401, PLC0415
    except ImportError as error:
        raise InputError("ROS bags need the library rosbags: pip install 'factorgraph-loc[ros]'") from error


@lru_cache(maxsize=64)
def _store(msgtype: str, definition: MessageDefinition) -> Typestore:
    """Return a rosbags type store with the message type ``msgtype`` and the types that it contains.

    ``definition``: the text in the bag that defines these types. Its compilation takes a hundred times as long as
    reading a message. Therefore the last 64 results are cached.
    """
    from rosbags.interfaces import MessageDefinitionFormat  # noqa: PLC0415
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore  # noqa: PLC0415

    if definition.format == MessageDefinitionFormat.NONE:
        return get_typestore(Stores.LATEST)
    store = get_typestore(Stores.EMPTY)
    types: dict[str, Any] = {}
    if definition.format == MessageDefinitionFormat.MSG:
        types.update(get_types_from_msg(definition.data, msgtype))
    else:
        line = "=" * 80 + "\n"
        parts = definition.data.split(line)
        for text in parts[1:] if len(parts) > 1 else parts:
            types.update(get_types_from_idl(text.partition("\n")[2] if text.startswith("IDL: ") else text))
    store.register(types)
    return store


@contextmanager
def _bag_errors(path: Path) -> Iterator[None]:
    """Convert exceptions inside the block to InputError. ``rosbags`` raises many types of exceptions on damaged files."""
    try:
        yield
    except InputError:
        raise
    except PermissionError as error:
        raise InputError(f"{path}: there is no permission to read it") from error
    except Exception as error:
        text = error_text(error)
        hint = next((hint for words, hint in HINTS.items() if words in text), "")
        raise InputError(f"{path}: cannot be read as a bag: {text.rstrip('.')}{'; ' + hint if hint else ''}") from error
