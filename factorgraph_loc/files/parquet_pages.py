"""Validation of the sizes declared in a Parquet file before it is unpacked (Apache Parquet's ``parquet.thrift``).

A file of a kilobyte may declare 2^40 rows or huge pages, for which a reader would allocate memory. So the footer and all page
headers are read here, in Thrift's compact protocol, and compared with the length of the file, with each other and with limits.
"""

from typing import Any

from factorgraph_loc.files.bounded import CELLS, DATA, RATIO, require_size

MARK = b"PAR1"
FIXED = 64 * 2**10  # cells that are always allowed
_DEEPEST = 12  # nesting levels of structures
_TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _LIST, _STRUCT = 1, 2, 3, 7, 8, 9, 12
_WIDTHS = {_TRUE: 0, _FALSE: 0, _BYTE: 1, _DOUBLE: 8}  # bytes

# field numbers in parquet.thrift
_ROWS, _GROUPS = 3, 4  # FileMetaData
_COLUMNS, _GROUP_ROWS = 1, 3  # RowGroup
_COLUMN = 3  # ColumnChunk
_VALUES, _UNPACKED, _PACKED, _DATA_AT, _DICTIONARY_AT = 5, 6, 7, 9, 11  # ColumnMetaData
_PAGE_UNPACKED, _PAGE_PACKED, _PAGE, _DICTIONARY, _PAGE_V2 = 2, 3, 5, 7, 8  # PageHeader
_COUNT = 1  # of a page header


def check(content: bytes, source: object) -> None:
    """ValueError if the parts of a Parquet file are outside of it or inconsistent; InputError if they are too large."""
    try:
        _check(content, source)
    except IndexError as error:
        raise ValueError("its footer or the head of a page is cut off") from error


def _check(content: bytes, source: object) -> None:
    size = len(content)
    if size < 12 or content[:4] != MARK or content[-4:] != MARK:
        raise ValueError("it does not begin and end with PAR1")
    length = int.from_bytes(content[-8:-4], "little")
    if length > size - 12:
        raise ValueError("its footer is longer than the file")
    footer, _ = _structure(content[size - 8 - length : size - 8], 0)
    groups = _list(footer, _GROUPS)
    if sum(_number(group, _GROUP_ROWS) for group in groups) != _number(footer, _ROWS):
        raise ValueError("its groups do not hold as many rows as it says")
    cells, unpacked = 0, 0
    for group in groups:
        for chunk in _list(group, _COLUMNS):
            told = _struct(chunk, _COLUMN)
            cells += max(_number(told, _VALUES), _number(group, _GROUP_ROWS))
            unpacked += _pages(content, size - 8 - length, told)
    require_size(source, "its number of values", cells, min(CELLS, FIXED + RATIO * size))
    require_size(source, "its size in bytes when unpacked", unpacked, DATA)


def _pages(content: bytes, last: int, told: dict[int, Any]) -> int:
    """Unpacked bytes of the pages of a column; ValueError if they are inconsistent with the column, or extend beyond ``last``."""
    at = [_number(told, place) for place in (_DICTIONARY_AT, _DATA_AT) if place in told]
    start, packed, values = min(at), _number(told, _PACKED), _number(told, _VALUES)
    end = start + packed
    if not 4 <= start <= end <= last:
        raise ValueError("a column lies outside of the file")
    unpacked, found = 0, 0
    while start < end:
        page, start = _structure(content, start)
        start += _number(page, _PAGE_PACKED)
        if start > end:
            raise ValueError("a page is longer than its column")
        unpacked += _number(page, _PAGE_UNPACKED)
        found += sum(_number(_struct(page, place), _COUNT) for place in (_PAGE, _PAGE_V2) if place in page)
        if _DICTIONARY in page and _number(page[_DICTIONARY], _COUNT) > FIXED + RATIO * len(content):
            raise ValueError("a dictionary has more values than the file could hold")
    if found != values:
        raise ValueError("the pages of a column do not hold as many values as it says")
    return unpacked


def _number(fields: dict[int, Any], place: int) -> int:
    found = fields.get(place)
    if not isinstance(found, int) or found < 0:
        raise ValueError(f"field {place} is no size")
    return found


def _struct(fields: dict[int, Any], place: int) -> dict[int, Any]:
    found = fields.get(place)
    if not isinstance(found, dict):
        raise ValueError(f"field {place} is no structure")
    return found


def _list(fields: dict[int, Any], place: int) -> list[dict[int, Any]]:
    found = fields.get(place)
    if not isinstance(found, list) or not all(isinstance(entry, dict) for entry in found):
        raise ValueError(f"field {place} is no list of structures")
    return found


def _structure(content: bytes, at: int, depth: int = 0) -> tuple[dict[int, Any], int]:
    """The structure of Thrift's compact protocol at ``at``, by field number, and its end; texts are None, as they are not
    needed."""
    if depth > _DEEPEST:
        raise ValueError("its structures are nested too deep")
    found: dict[int, Any] = {}
    place = 0
    while head := content[at]:
        at += 1
        if head >> 4:
            place += head >> 4
        else:
            place, at = _signed(content, at)
        found[place], at = _value(content, at, head & 15, depth)
    return found, at + 1


def _value(content: bytes, at: int, kind: int, depth: int) -> tuple[Any, int]:
    if 4 <= kind <= 6:
        return _signed(content, at)
    if kind == _BINARY:
        length, at = _unsigned(content, at)
        return None, at + length
    if kind == _STRUCT:
        return _structure(content, at, depth + 1)
    if kind == _LIST:
        return _entries(content, at, depth)
    if kind not in _WIDTHS:
        raise ValueError("its footer or the head of a page is damaged")
    return None, at + _WIDTHS[kind]


def _entries(content: bytes, at: int, depth: int) -> tuple[list[Any], int]:
    head = content[at]
    at += 1
    count, kind = head >> 4, head & 15
    if count == 15:
        count, at = _unsigned(content, at)
    if count > len(content) - at:  # each takes a byte at least
        raise ValueError("a list is longer than the file")
    entries = []
    for _ in range(count):
        entry, at = _value(content, at, kind, depth) if kind > _FALSE else (None, at + 1)
        entries.append(entry)
    return entries, at


def _unsigned(content: bytes, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        byte = content[at]
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, at
    raise ValueError("a number has more than 64 bits")


def _signed(content: bytes, at: int) -> tuple[int, int]:
    value, at = _unsigned(content, at)
    return value >> 1 ^ -(value & 1), at
