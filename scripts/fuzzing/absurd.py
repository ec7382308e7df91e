"""Absurd values: as texts for the cells of any file, and as values of a tree of TOML or JSON."""

from __future__ import annotations

import datetime
import math
from collections.abc import Sequence
from typing import Any

from numpy.random import Generator

TEXTS = (
    *(
        "",
        " ",
        "nan",
        "NaN",
        "inf",
        "-inf",
        "null",
        "None",
        "true",
        "x",
        "-",
        "--",
        "#",
        "//",
        "'",
        '"',
        '""',
        "[",
        "{",
        "}",
    ),
    *(
        "0",
        "-0",
        "-1",
        "1",
        "0.0",
        "-0.0",
        "00",
        "+5",
        "1.",
        ".5",
        "1,5",
        "1_000",
        "0x10",
        "1e",
        "e5",
        "١٢",
        "½",
        "1 2",
    ),
    *(
        "1e308",
        "-1e308",
        "1e309",
        "1e-308",
        "1e-320",
        "5e-324",
        "1e400",
        "1e1000000",
        "-1e1000000",
        "1e-1000000",
        "1e12",
    ),
    *("1e6", "-1e6", "1e15", "1e20", "1e-9", "1e-300", "3.4e38", "1e39", "123456789.123456789123456789"),
    *("2147483647", "2147483648", "4294967296", "4611686018427387904", "9223372036854775807", "9223372036854775808"),
    *("-9223372036854775808", "-9223372036854775809", "18446744073709551616", "9" * 400, "9" * 5000, "0." + "3" * 5000),
    *(
        "1700000000",
        "1700000000000",
        "1700000000000000000",
        "1970-01-01",
        "2026-02-30T00:00:00Z",
        "0001-01-01T00:00:00Z",
    ),
    *(
        "9999-12-31T23:59:59.999999999999Z",
        "2026-01-01T00:00:00+99:99",
        "2026-01-01T00:00:00.",
        "12:00:00",
        "2026-W01-1",
    ),
    *(
        "\x00",
        "a\x00b",
        "\x1b[31mred\x1b[0m",
        "\u202egnirts",
        "\ufeff",
        "\u2028",
        "\r",
        "a\nb",
        "\t",
        "é",
        "日本",
        "\U0001f916",
    ),
    *(
        "$x^{$",
        "$$",
        "%s",
        "{0}",
        "<b>",
        "&amp;",
        "=1+1",
        "*",
        "**",
        "?",
        "[a",
        "~",
        ".",
        "..",
        "../x",
        "../../../etc/passwd",
    ),
    *(
        "/",
        "/etc/passwd",
        "/dev/zero",
        "/dev/null",
        "/proc/self/mem",
        "a/b/c",
        "a" * 300,
        "b" * 5000,
        "c" * 100_000,
        "[" * 5000,
    ),
)
# as written in a TOML, JSON or YAML file, without quotes
RAW = (
    *(
        "9" * 5000,
        "-" + "9" * 400,
        "1e1000000",
        "1e309",
        "0." + "1" * 5000,
        "nan",
        "NaN",
        "inf",
        "Infinity",
        "-0",
        "0x" + "f" * 400,
    ),
    *(
        "[" * 3000 + "]" * 3000,
        "[" * 200 + "]" * 200,
        "{a=" * 500 + "1" + "}" * 500,
        '{"a":' * 3000 + "1" + "}" * 3000,
        "[",
        "{",
    ),
    *(
        "1979-05-27",
        "1979-05-27T07:32:00Z",
        "07:32:00",
        "9999-12-31T23:59:59Z",
        "null",
        "~",
        "true",
        '"\\u0000"',
        '"\\ud800"',
    ),
    *('"""a\nb"""', "[1, 'a', true]", "{}", "[]", "[[]]", "&a 1", "*a", "!!python/object:os.system x", "", "0o7", ",,"),
)


def pick(rng: Generator, items: Sequence[Any]) -> Any:
    """One of several."""
    return items[int(rng.integers(len(items)))]


def text(rng: Generator) -> str:
    """A random text for a cell or a word."""
    return str(pick(rng, TEXTS))


def number(rng: Generator, value: float) -> float:
    """A replacement for a number: nearby, of another magnitude, or absurd."""
    choice = rng.integers(6)
    if choice == 0:
        return -value
    if choice == 1:
        return value * 10.0 ** int(rng.integers(-12, 13))
    if choice == 2:
        return value + 10.0 ** int(rng.integers(-3, 13)) * (-1.0) ** int(rng.integers(2))
    if choice == 3:
        return math.nextafter(value, math.inf)
    finite = (0.0, -0.0, -1.0, 1e308, -1e308, 1e300, 1e-300, 5e-324, 1e-9, 1e9, 1e12, 1e18, 2.0**63, 3.5e38, math.pi)
    return float(pick(rng, (*finite, math.nan, math.inf, -math.inf)))


class Marks:
    """Placeholders for raw texts that no TOML or JSON writer would write; replaced after writing."""

    def __init__(self) -> None:
        self._raw: list[str] = []

    def mark(self, raw: str) -> str:
        self._raw.append(raw)
        return f"@raw{len(self._raw) - 1}@"

    def put_in(self, written: str) -> str:
        for i, raw in enumerate(self._raw):
            written = written.replace(f'"@raw{i}@"', raw)
        return written


def value(rng: Generator, old: Any, marks: Marks) -> Any:
    """A replacement for the value ``old`` of a tree."""
    choice = rng.integers(8)
    if choice < 3 and isinstance(old, (int, float)) and not isinstance(old, bool):
        new = number(rng, float(old))
        return int(new) if isinstance(old, int) and math.isfinite(new) and rng.random() < 0.7 else new
    if choice < 4:
        return marks.mark(pick(rng, RAW))
    if choice < 6:
        return text(rng)
    if choice < 7:
        return pick(rng, ([old], [[old]], [], {}, {"x": old}, [old] * 50, [old, "x"], {"": old}, [None, old]))
    some = (True, False, 0, -1, 1, 5, 2**31, 2**53 + 1, 2**63 - 1, -(2**63), 0.0, 1e308, 1e-320, 0.5)
    return pick(rng, (*some, "", [], datetime.date(1979, 5, 27), [0.0], [1e308] * 3, [[1.0] * 3] * 3, {"a": {"b": {}}}))
