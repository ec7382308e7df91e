"""MATLAB files of versions 5 to 7: named arrays of real numbers.

The format is that of "MAT-File Format" (The MathWorks, 2019), level 5. scipy is not used, because its compiled reader crashes on
some damaged files.
"""

import math
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import bounded
from factors.se2 import Array

HEADER = 128  # bytes, ending with version and byte order
VERSION = 0x0100
ORDERS = {b"IM": "<", b"MI": ">"}
WHAT = "is not a MATLAB file (of version 5 to 7)"
MATRIX, COMPRESSED = 14, 15  # types of elements
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
NUMERIC = range(6, 16)  # array classes double to uint64; others are texts, cells, structures
COMPLEX = 0x0800


def read_matlab(path: Path, fields: Mapping[str, int]) -> tuple[dict[str, Array], list[str]]:
    """The arrays (N, K) of ``fields`` (name -> K), and the names of all others; InputError names file and field of a missing or
    invalid array."""
    arrays, others = read_arrays(path, {name: (None, width) for name, width in fields.items()})
    for name, array in arrays.items():
        if len(array) == 0:
            raise InputError(f"{path}: {name} contains no rows")
    return arrays, others


def read_arrays(path: Path, shapes: Mapping[str, tuple[int | None, ...]]) -> tuple[dict[str, Array], list[str]]:
    """The arrays of ``shapes`` (name -> size along each axis, None for any), and the names of all others; InputError as in
    :func:`read_matlab`."""
    content = bounded.read_bytes(path, bounded.DATA)
    found: dict[str, Array | None] = {}
    others = []
    with bounded.foreign(path, WHAT):
        for name, matrix in _matrices(content, path):
            if name in shapes:
                found[name] = matrix.numbers()
            else:
                others.append(name)
    arrays = {}
    for name, shape in shapes.items():
        if name not in found:
            raise InputError(f"{path}: {name} is missing")
        array = found[name]
        if array is None:
            raise InputError(f"{path}: {name} is not an array of real numbers, expected {_described(shape)}")
        if array.ndim != len(shape) or not all(n in (None, m) for n, m in zip(shape, array.shape, strict=True)):
            raise InputError(f"{path}: {name} has shape {array.shape}, expected numbers in {_described(shape)}")
        arrays[name] = array
    return arrays, others


@dataclass(frozen=True)
class _Matrix:
    """A variable whose values are still unread: the next element of ``values``."""

    order: str
    flags: int
    shape: tuple[int, ...]
    values: Iterator[tuple[int, memoryview]]

    def numbers(self) -> Array | None:
        """Its values; None if they are not real numbers. ValueError if their number contradicts the shape."""
        if self.flags & 0xFF not in NUMERIC or self.flags & COMPLEX:
            return None
        kind, content = next(self.values)
        flat = np.frombuffer(content, dtype=self.order + NUMBERS[kind])
        if min(self.shape) < 0 or math.prod(self.shape) != flat.size:
            raise ValueError(f"a variable of shape {self.shape} has {flat.size} values")
        return flat.astype(float).reshape(self.shape, order="F")


def _matrices(content: bytes, path: Path) -> Iterator[tuple[str, _Matrix]]:
    """The variables by name."""
    order = ORDERS.get(content[HEADER - 2 : HEADER])
    if order is None or struct.unpack(f"{order}H", content[HEADER - 4 : HEADER - 2]) != (VERSION,):
        raise InputError(f"{path}: {WHAT}")
    room = bounded.DATA
    for kind, value in _elements(memoryview(content)[HEADER:], order):
        element = kind, value
        if kind == COMPRESSED:
            unpacked = zlib.decompressobj().decompress(value, room + 1)
            bounded.require_size(path, "its size in bytes, unpacked", len(unpacked), room)
            room -= len(unpacked)
            element = next(_elements(memoryview(unpacked), order))
        if element[0] == MATRIX:
            parts = _elements(element[1], order)
            flags, sizes, name = (next(parts)[1] for _ in range(3))
            shape = tuple(np.frombuffer(sizes, dtype=f"{order}i4").tolist())
            yield bytes(name).decode("latin-1"), _Matrix(order, struct.unpack_from(f"{order}I", flags)[0], shape, parts)


def _elements(content: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Type and content of consecutive elements. ValueError if one is truncated."""
    at = 0
    while at < len(content):
        kind, size = struct.unpack_from(f"{order}II", content, at)
        begin = at + 8
        if kind >> 16:  # up to four bytes are stored instead of the size
            kind, size, begin = kind & 0xFFFF, kind >> 16, at + 4
            at += 8
        else:
            at = begin + size + (0 if kind == COMPRESSED else -size % 8)
        if begin + size > len(content):
            raise ValueError(f"an element of {size} bytes is cut off")
        yield kind, content[begin : begin + size]


def _described(shape: tuple[int | None, ...]) -> str:
    if len(shape) == 2 and shape[0] is None:
        return f"{shape[1]} columns"
    return " x ".join("any" if n is None else str(n) for n in shape)
