"""The recordings by name: where their files are, under which licence, and what they become."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

LIST = Path(__file__).with_name("recordings.toml")
RAW = "https://raw.githubusercontent.com"


@dataclass(frozen=True)
class File:
    """A file of a public repository at a commit; ``name``: what it is called here."""

    repository: str
    commit: str
    path: str
    name: str


@dataclass(frozen=True)
class Recording:
    """``kind``: how it is read, a function of :mod:`recordings_benchmark.prepare`, with its ``options``. ``prior``: where a log
    without a start begins; ``seconds``: how much of a long one is taken. ``odometry``, ``others``: where it is from, and the other
    sensors, in the words of the table."""

    name: str
    title: str
    licence: str
    odometry: str
    others: str
    kind: str
    files: tuple[File, ...]
    prior: str | None = None
    seconds: float | None = None
    options: dict[str, Any] = field(default_factory=dict)


def listed() -> tuple[Recording, ...]:
    """Those of ``recordings.toml``."""
    content = tomllib.loads(LIST.read_text(encoding="utf-8"))
    sources = content["source"]
    found = []
    for entry in content["recording"]:
        source = sources[entry.pop("source")]
        commit = entry.pop("commit", source["commit"])
        files = [
            File(source["repository"], commit, path, entry["name"] + "-" + path.rsplit("/", 1)[-1])
            for path in entry.pop("files")
        ]
        found.append(Recording(**entry, licence=source["licence"], files=tuple(files)))
    return tuple(found)


def commands(recordings: Sequence[Recording]) -> list[str]:
    """What fetches the files of recordings into the present folder."""
    files = [file for recording in recordings for file in recording.files]
    return [f"curl -L -o {file.name} {RAW}/{file.repository}/{file.commit}/{file.path}" for file in files]


RECORDINGS = listed()
