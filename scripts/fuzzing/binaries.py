"""Damage to binary files by their structure: Parquet, arrays, images, MATLAB, and the three kinds of ROS bags."""

from __future__ import annotations

import io
import math
import sqlite3
import struct
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.random import Generator
from scipy.io import loadmat, savemat

from fuzzing.absurd import number, pick, text

WRAPPED: tuple[Callable[[Any], Any], ...] = (
    lambda v: [v],
    lambda v: {"a": v},
    lambda v: [[v]],
    str,
    lambda v: str(v).encode(),
)
KINDS: tuple[Any, ...] = (
    *(pl.Int8, pl.UInt64, pl.Int128, pl.Float32, pl.Decimal(38, 3), pl.Boolean, pl.String, pl.Categorical, pl.Binary),
    *(pl.Date, pl.Time, pl.Duration("ns"), pl.Datetime("us"), pl.Datetime("ns", "UTC")),
)
INTEGERS = (0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 2**31, 2**40, 2**62, 2**63 - 1, 2**64 - 1)


def raw(content: bytes, rng: Generator) -> bytes:
    """Bytes flipped, truncated, removed, inserted, repeated, or interpreted as a length."""
    out = bytearray(content)
    choice, n = rng.integers(8), max(1, len(out))
    at = int(rng.integers(n if rng.random() < 0.7 else min(n, 200)))
    length = min(n - at, int(2 ** rng.integers(0, 12)))
    if choice == 0:
        for place in rng.integers(n, size=int(2 ** rng.integers(0, 6))).tolist():
            out[place : place + 1] = bytes([int(rng.integers(256))])
    elif choice == 1:
        del out[at:]
    elif choice == 2:
        del out[at : at + length]
    elif choice == 3:
        out[at:at] = rng.integers(0, 256, length, dtype=np.uint8).tobytes()
    elif choice == 4:
        out[at:at] = out[at : at + length] * int(pick(rng, (1, 2, 50)))
    elif choice == 5:
        other = int(rng.integers(n))
        out[at : at + length] = out[other : other + length]
    else:
        size = int(pick(rng, (1, 2, 4, 4, 8)))
        out[at : at + size] = (pick(rng, INTEGERS) % 256**size).to_bytes(size, pick(rng, ("little", "little", "big")))
    return bytes(out)


def parquet(content: bytes, rng: Generator) -> bytes:
    frame = pl.read_parquet(io.BytesIO(content))
    name = pick(rng, frame.columns)
    column, choice = frame[name], rng.integers(11)
    if choice == 0:
        frame = frame.drop(name)
    elif choice == 1:
        frame = frame.with_columns(pl.Series(name, [None] * frame.height, dtype=pick(rng, (pl.Null, column.dtype))))
    elif choice == 2:
        made = pick(rng, WRAPPED)
        frame = frame.with_columns(pl.Series(name, [made(v) for v in column.to_list()], strict=False))
    elif choice == 3:
        frame = frame.with_columns(column.cast(pick(rng, KINDS), strict=False))
    elif choice == 4:
        frame = frame.rename({name: text(rng)[:5000]})
    elif choice == 5:
        frame = frame.sample(fraction=1.0, shuffle=True, seed=int(rng.integers(1000)))
    elif choice == 6:
        frame = pick(rng, (frame.clear(), frame.head(1), pl.concat([frame] * 3), frame.reverse(), frame.head(2)))
    elif choice == 7:
        other = pick(rng, frame.columns)
        frame = frame.with_columns(frame[other].alias(name), column.alias(other))
    else:
        values = column.to_list()
        if values:
            at = int(rng.integers(len(values)))
            values[at] = _of_kind(values[at], rng)
            frame = frame.with_columns(pl.Series(name, values, strict=False))
    out = io.BytesIO()
    frame.write_parquet(out, compression=pick(rng, ("zstd", "uncompressed", "snappy", "gzip")))
    return out.getvalue()


def _of_kind(old: Any, rng: Generator) -> Any:
    if rng.random() < 0.1:
        return None
    if isinstance(old, int):
        return int(pick(rng, (0, -1, 2**62, 2**63 - 1, -(2**63), old + 10 ** int(rng.integers(0, 18)), -old)))
    return number(rng, old) if isinstance(old, float) else text(rng)


def array(old: Any, rng: Generator) -> Any:
    """An array in the place of another."""
    old, choice = np.asarray(old), rng.integers(9)
    if choice == 0:
        return pick(
            rng, (old[..., None], old.ravel(), old.T, np.zeros((0, *old.shape)), old[:0], np.float64(3.0), old[:1])
        )
    if choice == 1:
        return old.astype(pick(rng, ("f2", "f4", "i1", "u8", "c16", "?", "U8", "S3", "O")))
    if choice == 2 and old.size:
        return pick(
            rng,
            (np.concatenate((old, old)) if old.ndim else old, np.full(old.shape, math.nan), np.full(old.shape, 1e308)),
        )
    if choice == 3:
        return pick(
            rng,
            (
                np.array("x"),
                np.array([{"a": 1}], dtype=object),
                np.array(None),
                np.zeros((1,) * 9),
                np.array("2026-01-01", "M8"),
            ),
        )
    new = np.array(old, dtype=float) if old.dtype.kind in "fiub" else np.zeros(3)
    if new.size:
        new.flat[int(rng.integers(new.size))] = number(rng, float(new.flat[0]))
    return new


def npz(content: bytes, rng: Generator) -> bytes:
    with np.load(io.BytesIO(content)) as kept:
        arrays = {name: kept[name] for name in kept.files}
    name, choice = pick(rng, list(arrays)), rng.integers(6)
    if choice == 0:
        del arrays[name]
    elif choice == 1:
        arrays[text(rng)[:50].replace("/", "_") or "x"] = arrays[name]
    else:
        arrays[name] = array(arrays[name], rng)
    out = io.BytesIO()
    pick(rng, (np.savez, np.savez_compressed))(out, **arrays)
    written = out.getvalue()
    if choice == 5:  # a header with another shape of the right size
        shape = f"({', '.join(map(str, np.shape(arrays[name])))}"
        told = pick(rng, ("(10000000000000", "(-1", "(1e9", "((((", "([]", "(0", "(2, 2", "('a'")).ljust(len(shape))
        written = written.replace(shape.encode(), told.encode()[: max(len(shape), 1)])
    return written


def matlab(content: bytes, rng: Generator) -> bytes:
    fields = {name: made for name, made in loadmat(io.BytesIO(content)).items() if not name.startswith("__")}
    name, choice = pick(rng, list(fields)), rng.integers(8)
    if choice == 0:
        del fields[name]
    elif choice == 1:
        fields[name] = pick(
            rng, ({"a": 1.0}, np.array([[1, "x"]], dtype=object), "text", np.sqrt(-1 + 0j), np.array([]))
        )
    else:
        fields[name] = array(fields[name], rng)
    out = io.BytesIO()
    savemat(out, fields, do_compression=bool(rng.random() < 0.3))
    return b"MATLAB 5.0 MAT-file".ljust(116) + out.getvalue()[116:]


def picture(content: bytes, rng: Generator) -> bytes:
    """The header of PNG and PGM; any bytes of other images."""
    if content.startswith(b"\x89PNG"):
        width, height = struct.unpack(">II", content[16:24])
        size = pick(
            rng,
            ((width * 2, height), (0, height), (50_000, 50_000), (2**31 - 1, 2**31 - 1), (width, 1), (1_000_000, 2)),
        )
        head = b"IHDR" + struct.pack(">II", *size) + bytes([pick(rng, (8, 8, 16, 1, 3)), *content[25:29]])
        return content[:12] + head + struct.pack(">I", zlib.crc32(head)) + content[33:]
    if content.startswith(b"P5"):
        words = content.split(None, 4)
        words[int(rng.integers(4))] = (
            text(rng).encode("utf-8", "replace")
            if rng.random() < 0.5
            else pick(rng, (b"50000", b"99999999999", b"0", b"-1", b"65535", b"P2", b"P6", b"1"))
        )
        return b"\n".join(words)
    return raw(content, rng)


def sqlite(content: bytes, rng: Generator) -> bytes:
    """A ROS 2 bag as an SQLite database with changed rows or tables."""
    with sqlite3.connect(":memory:") as base:
        base.deserialize(content)
        tables = [name for (name,) in base.execute("select name from sqlite_master where type = 'table'")]
        try:
            if rng.random() < 0.2:
                base.execute(f"drop table {pick(rng, tables)}")
            else:
                _change_row(base, pick(rng, ["messages", *tables]), rng)
        except sqlite3.Error:
            return raw(content, rng)
        base.commit()
        return bytes(base.serialize())


def _change_row(base: sqlite3.Connection, kind: str, rng: Generator) -> None:
    columns = [row[1] for row in base.execute(f"pragma table_info({kind})")]
    ids = [row[0] for row in base.execute(f"select rowid from {kind}")]
    one, column = pick(rng, ids), pick(rng, columns)
    (old,) = base.execute(f"select {column} from {kind} where rowid = ?", (one,)).fetchone()
    if isinstance(old, bytes):
        new: Any = raw(old, rng) if rng.random() < 0.8 else pick(rng, (b"", 5, None, "x"))
    elif rng.random() < 0.5:
        new = text(rng).encode("utf-8", "replace").decode()
    else:
        new = pick(rng, (0, -1, 2**62, None, b"\xff\x00", 1e300, 3.5, 1))
    where = "" if rng.random() < 0.2 else f" where rowid = {one}"
    base.execute(f"update {kind} set {column} = ?{where}", (new,))


def messages(suffix: str) -> Callable[[bytes, Generator], bytes]:
    """A bag of that kind with changed values in a message, or reordered messages."""

    def change(content: bytes, rng: Generator) -> bytes:
        from rosbags import rosbag1, rosbag2  # noqa: PLC0415
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: PLC0415

        is_1 = suffix == ".bag"
        with tempfile.TemporaryDirectory() as folder:
            old, new = Path(folder) / f"old{suffix}", Path(folder) / ("new.bag" if is_1 else "new")
            old.write_bytes(content)
            plugin = rosbag2.StoragePlugin.MCAP if suffix == ".mcap" else rosbag2.StoragePlugin.SQLITE3
            writer = rosbag1.Writer(new) if is_1 else rosbag2.Writer(new, version=9, storage_plugin=plugin)
            store = get_typestore(Stores.EMPTY)
            with (rosbag1 if is_1 else rosbag2).Reader(old) as reader, writer:
                made = {}
                for one in reader.connections:
                    store.register(get_types_from_msg(one.msgdef.data, one.msgtype))
                    made[one.id] = writer.add_connection(one.topic, one.msgtype, typestore=store)
                rows = [(made[one.id], t, bytes(data)) for one, t, data in reader.messages()]
                by_topic = [
                    i
                    for topic in [pick(rng, reader.connections).topic]
                    for i in range(len(rows))
                    if rows[i][0].topic == topic
                ]
                _change_messages(rows, pick(rng, by_topic or list(range(len(rows)))), store, is_1, rng)
                for row in rows:
                    writer.write(*row)
            written = new if is_1 else next(new.glob(f"*{suffix}"))
            return written.read_bytes()

    return change


def _change_messages(rows: list[Any], at: int, store: Any, is_1: bool, rng: Generator) -> None:
    connection, t, data = rows[at]
    choice = rng.integers(8)
    if choice == 0:
        rows[at] = (connection, t, raw(data, rng))
    elif choice == 1:
        rows[at] = (connection, int(pick(rng, (0, 1, t + 10**15, 2**62, t - 10**9))), data)
    elif choice == 2:
        del rows[at]
    elif choice == 3:
        rows[at:at] = [rows[at]] * 3
    else:
        kind = connection.msgtype
        message = store.deserialize_ros1(data, kind) if is_1 else store.deserialize_cdr(data, kind)
        try:
            _change_field(message, rng)
            rows[at] = (
                connection,
                t,
                bytes(store.serialize_ros1(message, kind) if is_1 else store.serialize_cdr(message, kind)),
            )
        except Exception:  # a value that the message cannot hold
            rows[at] = (connection, t, raw(data, rng))


def _change_field(message: Any, rng: Generator) -> None:
    """Another value in a field of a message or of one within it."""
    names = [name for name in vars(message) if not name.startswith("__")]
    name = pick(rng, names)
    old = getattr(message, name)
    if isinstance(old, list) and old and rng.random() < 0.6 and hasattr(old[0], "__dict__"):
        _change_field(pick(rng, old), rng)
    elif isinstance(old, list):
        new: Any = pick(
            rng,
            (
                [],
                old * 2,
                old[:1],
                [text(rng).replace("\x00", "") for _ in old] if old and isinstance(old[0], str) else old,
            ),
        )
        object.__setattr__(message, name, new)
    elif isinstance(old, np.ndarray):
        new = old.astype(old.dtype)
        if new.size and old.dtype.kind == "f":
            new.flat[int(rng.integers(new.size))] = number(rng, 1.0)
        object.__setattr__(message, name, new if rng.random() < 0.7 else new[: new.size // 2])
    elif isinstance(old, (bool, str)):
        object.__setattr__(message, name, text(rng) if isinstance(old, str) else not old)
    elif isinstance(old, int):
        object.__setattr__(message, name, int(pick(rng, (0, 1, 127, 255, 2**31 - 1, 2**32 - 1, -1, old + 10**6))))
    elif isinstance(old, float):
        object.__setattr__(message, name, number(rng, old))
    else:
        _change_field(old, rng)
