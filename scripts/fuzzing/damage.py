"""Damage to a folder of files: to bytes, to contents, or to the files themselves."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from numpy.random import Generator

from fuzzing import binaries, texts
from fuzzing.absurd import pick

Damage = Callable[[bytes, Generator], bytes]
LARGEST = 20_000_000  # bytes of a damaged file


@dataclass(frozen=True)
class Special:
    """A replacement for a file: ``kind`` is missing, folder, link, loop or fifo."""

    kind: str
    target: str = ""


SPECIAL = (
    *(Special("missing"), Special("folder"), Special("loop"), Special("fifo")),
    *(
        Special("link", target)
        for target in ("/etc/passwd", "/dev/null", "/dev/zero", "/proc/self/environ", "nowhere", ".")
    ),
)
BY_SUFFIX: dict[str, tuple[Damage, ...]] = {
    ".toml": (texts.toml, texts.toml, texts.words),
    ".json": (texts.json_lines, texts.json_lines, texts.words),
    ".jsonl": (texts.json_lines, texts.json_lines, texts.words),
    ".yaml": (texts.words,),
    **dict.fromkeys((".csv", ".txt", ".tum", ".dat"), (texts.table, texts.table, texts.words)),
    ".parquet": (binaries.parquet,),
    ".npz": (binaries.npz,),
    ".mat": (binaries.matlab,),
    **dict.fromkeys((".png", ".pgm"), (binaries.picture,)),
    ".bag": (binaries.messages(".bag"),),
    ".mcap": (binaries.messages(".mcap"),),
    ".db3": (binaries.sqlite, binaries.messages(".db3")),
}
# libraries that open these may end the process, or panic, for damaged files
OF_WHOLE_FILES = (binaries.matlab, binaries.parquet)
Content = bytes | Special


def damaged(files: Mapping[str, bytes], rng: Generator) -> dict[str, Content]:
    """Replacements for some of ``files``, mostly for one of them."""
    out: dict[str, Content] = {}
    for _ in range(int(pick(rng, (1, 1, 1, 1, 1, 1, 2, 2, 3, 6)))):
        name = pick(rng, sorted(files))
        if rng.random() < 0.06:
            out[name] = pick(rng, SPECIAL)
            continue
        old = out.get(name, files[name])
        if isinstance(old, Special):
            continue
        kinds = BY_SUFFIX.get(Path(name).suffix, (binaries.raw,))
        change = pick(rng, kinds) if rng.random() < 0.7 else binaries.raw
        if change in OF_WHOLE_FILES and name in out:
            change = binaries.raw
        if rng.random() < 0.02:
            out[name] = b""
            continue
        try:
            out[name] = change(old, rng)[:LARGEST]
        except Exception:  # damaged already, or a value that the format's writer refuses
            out[name] = binaries.raw(old, rng)
    return out


def write(folder: Path, files: Mapping[str, Content]) -> None:
    """Write files into ``folder``, which is recreated."""
    shutil.rmtree(folder, ignore_errors=True)
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(content, bytes):
            path.write_bytes(content)
        elif content.kind == "folder":
            path.mkdir()
        elif content.kind == "fifo":
            os.mkfifo(path)
        elif content.kind == "loop":
            path.symlink_to(path.name)
        elif content.kind == "link":
            path.symlink_to(content.target)


def read(folder: Path) -> dict[str, bytes]:
    """All files below ``folder`` by relative path."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
