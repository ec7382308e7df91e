"""Damage to text files by their structure: trees of TOML and JSON, tables of cells, and words of any text."""

from __future__ import annotations

import datetime
import json
import re
import tomllib
from typing import Any

import tomli_w
from numpy.random import Generator

from fuzzing.absurd import RAW, Marks, pick, text, value

WORD = re.compile(r'"[^"\n]*"|[-+]?\d[\w.+-]*|[A-Za-z_][\w.-]*')
SEPARATORS = (",", ";", "\t")


def toml(content: bytes, rng: Generator) -> bytes:
    tree, marks = tomllib.loads(content.decode()), Marks()
    _change(tree, rng, marks)
    return marks.put_in(tomli_w.dumps(_plain(tree))).encode("utf-8", "surrogatepass")


def json_lines(content: bytes, rng: Generator) -> bytes:
    """JSON, or lines of it."""
    whole = content.lstrip().startswith(b"{\n") or b"\n" not in content.strip()
    lines = [content.decode()] if whole else content.decode().splitlines()
    at, marks = int(rng.integers(len(lines))), Marks()
    tree = json.loads(lines[at])
    _change(tree, rng, marks)
    lines[at] = marks.put_in(json.dumps(tree, default=str))
    if rng.random() < 0.1:
        lines[at] = pick(rng, RAW)
    return ("\n".join(lines) + "\n").encode("utf-8", "surrogatepass")


def _places(tree: Any) -> list[tuple[Any, Any]]:
    """All (container, key) of a tree of dicts and lists."""
    out: list[tuple[Any, Any]] = []
    keys = list(tree) if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else ()
    for key in keys:
        out.append((tree, key))
        out += _places(tree[key])
    return out


def _change(tree: Any, rng: Generator, marks: Marks) -> None:
    places = _places(tree)
    if not places:
        return
    inside, key = pick(rng, places)
    choice = rng.integers(10)
    if choice == 0:
        del inside[key]
    elif choice == 1:
        other, its = pick(rng, places)
        inside[key], other[its] = json.loads(json.dumps(other[its], default=str)), inside[key]
    elif choice == 2 and isinstance(inside, dict):
        inside[text(rng)] = inside.pop(key)
    elif choice == 3 and isinstance(inside, dict):
        inside[text(rng)] = value(rng, inside[key], marks)
    elif choice == 4 and isinstance(inside, list):
        inside += [inside[key]] * int(pick(rng, (1, 2, 100)))
    else:
        inside[key] = value(rng, inside[key], marks)


def _plain(tree: Any) -> Any:
    """Restrict to TOML: no nulls, text keys."""
    if isinstance(tree, dict):
        return {str(key): _plain(item) for key, item in tree.items() if item is not None}
    if isinstance(tree, list):
        return [_plain(item) for item in tree if item is not None]
    return tree if isinstance(tree, (str, bool, int, float, datetime.date)) else str(tree)


def words(content: bytes, rng: Generator) -> bytes:
    """A replaced word, or a line added or removed, in any text."""
    written = content.decode("utf-8", "surrogateescape")
    found = list(WORD.finditer(written))
    if rng.random() < 0.25 or not found:
        lines = written.splitlines(keepends=True) or [""]
        at = int(rng.integers(len(lines)))
        lines[at] = pick(
            rng, ("", lines[at] * 2, pick(rng, lines), "\n", f"{text(rng)}\n", lines[at].rstrip() + lines[at])
        )
        written = "".join(lines)
    else:
        one = pick(rng, found)
        new = pick(rng, RAW) if rng.random() < 0.3 else text(rng)
        new = pick(rng, found).group() if rng.random() < 0.15 else new
        written = written[: one.start()] + new + written[one.end() :]
    return written.encode("utf-8", "surrogatepass" if rng.random() < 0.5 else "replace")


def table(content: bytes, rng: Generator) -> bytes:
    """Cells, rows and columns of a table with its most frequent separator."""
    written = content.decode("utf-8", "surrogateescape")
    counts = {mark: written.count(mark) for mark in SEPARATORS}
    mark = max(SEPARATORS, key=lambda m: counts[m]) if any(counts.values()) else " "
    rows = [line.split(mark) for line in written.splitlines()]
    if not rows:
        return words(content, rng)
    i = int(rng.integers(len(rows)))
    j = int(rng.integers(max(1, len(rows[i]))))
    _change_table(rows, i, j, rng)
    end = pick(rng, ("\r\n", "\r", "\n\n")) if rng.random() < 0.05 else "\n"
    return (end.join(mark.join(row) for row in rows) + end).encode("utf-8", "surrogateescape")


def _change_table(rows: list[list[str]], i: int, j: int, rng: Generator) -> None:
    choice = rng.integers(12)
    if choice < 5:
        rows[i][j : j + 1] = [_cell(rows[i][j] if j < len(rows[i]) else "", rng)]
    elif choice == 5:
        del rows[i]
    elif choice == 6:
        rows[i:i] = [list(rows[i])] * int(pick(rng, (1, 2, 500)))
    elif choice == 7:
        other = int(rng.integers(len(rows)))
        rows[i], rows[other] = rows[other], rows[i]
    elif choice == 8:
        new = _cell(rows[-1][j] if j < len(rows[-1]) else "", rng)
        for row in rows[1:]:
            row[j : j + 1] = [new]
    elif choice == 9:
        for row in rows:
            del row[j : j + 1]
    elif choice == 10:
        for row in rows:
            row[j:j] = row[j : j + 1]
    else:
        del rows[1 + int(rng.integers(3)) :]


def _cell(old: str, rng: Generator) -> str:
    try:
        number = float(old)
    except ValueError:
        return text(rng)
    choice = rng.integers(5)
    if choice == 0:
        return text(rng)
    if choice == 1:
        return repr(number * 10.0 ** int(rng.integers(-20, 21)))
    if choice == 2:
        return repr(-number)
    if choice == 3 and "." not in old and "e" not in old and abs(number) < 1e30:
        return str(int(number) + int(10 ** int(rng.integers(0, 19))) * int(pick(rng, (-1, 1))))
    return repr(number + 10.0 ** int(rng.integers(-3, 13)))
