"""The little of YAML that calibration and map files need: keys with a number, a text or a list of numbers, in blocks.

What it does not know (anchors, several documents, texts over lines) is an error, not a guess.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import read_text

_ENTRY = re.compile(r"^(?P<indent> *)(?P<key>[\w./-]+) *:(?: +(?P<value>.*)|)$")


def read_flat_yaml(path: Path) -> dict[str, Any]:
    """Values by key; keys within a block are joined by dots, ``T_BS.data``.

    InputError names file and row of what is not understood."""
    out: dict[str, Any] = {}
    blocks: list[tuple[int, str]] = []  # indents and keys of the blocks that a line is in
    open_list: tuple[str, int, str] | None = None
    for row, raw in enumerate(read_text(path).splitlines(), start=1):
        line = re.sub(r"(^|\s)#.*$", "", raw).rstrip()
        if open_list is not None:
            key, begun, text = open_list
            open_list = (key, begun, f"{text} {line.strip()}")
            if "]" in line:
                out[key] = _list(path, begun, key, open_list[2])
                open_list = None
            continue
        if not line.strip() or line.startswith(("%YAML", "---", "...")):
            continue
        if blocks and line.lstrip().startswith("- "):
            out.setdefault(".".join(name for _, name in blocks), []).append(_scalar(line.lstrip()[2:].strip()))
            continue
        entry = _ENTRY.match(line)
        if entry is None:
            raise bad_field(path, "line", line.strip(), "key: value", row=row)
        indent = len(entry["indent"])
        while blocks and blocks[-1][0] >= indent:
            blocks.pop()
        key = ".".join([*(name for _, name in blocks), entry["key"]])
        value = re.sub(r"^!!\S+ *", "", (entry["value"] or "").strip())  # the type that OpenCV writes
        if not value:
            blocks.append((indent, entry["key"]))
        elif value.startswith("[") and "]" not in value:
            open_list = (key, row, value)
        else:
            out[key] = _list(path, row, key, value) if value.startswith("[") else _scalar(value)
    if open_list is not None:
        raise InputError(f"{path}:{open_list[1]}: the list {open_list[0]} has no end")
    return out


def _list(path: Path, row: int, key: str, text: str) -> list[Any]:
    if not text.endswith("]") or text.count("[") > 1:
        raise bad_field(path, key, text, "a list of numbers, [1, 2, 3]", row=row)
    return [_scalar(part.strip()) for part in text[1:-1].split(",") if part.strip()]


def _scalar(text: str) -> Any:
    """A number where it is one, else the text without quotes."""
    if len(text) >= 2 and text[0] == text[-1] and text[0] in "\"'":
        return text[1:-1]
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
