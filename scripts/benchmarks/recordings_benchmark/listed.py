"""The list of recordings: origin, licence, and conversion."""

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
    """A file of a public repository at a commit; ``name``: its local name."""

    repository: str
    commit: str
    path: str
    name: str


@dataclass(frozen=True)
class Recording:
    """``kind``: conversion function of :mod:`recordings_benchmark.prepare`, with its ``options``. ``prior``: of logs without a
    start; ``seconds``: maximum duration. ``odometry``, ``others``: origin of the odometry, and the other sensors, as texts for
    the table."""

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
    """Commands to download the files into the present folder."""
    files = [file for recording in recordings for file in recording.files]
    return [f"curl -L -o {file.name} {RAW}/{file.repository}/{file.commit}/{file.path}" for file in files]


RECORDINGS = listed()
