"""The list of public recordings, with origin, licence and conversion."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

LIST = Path(__file__).with_name("recordings.toml")


@dataclass(frozen=True)
class Recording:
    """A public recording.

    ``kind``, ``options``: the conversion function in :mod:`recordings_benchmark.prepare`, and its options.
    ``odometry``, ``others``: texts for the table: the origin of the odometry, and the other sensors.
    ``files``: the URL of each file by its local name. ``prior``: the start of the runs, None for that of the log. ``seconds``:
    only so much of the recording is used, None for all.
    """

    name: str
    title: str
    licence: str
    odometry: str
    others: str
    kind: str
    origin: str
    files: dict[str, str]
    prior: str | None = None
    seconds: float | None = None
    options: dict[str, Any] = field(default_factory=dict)


def listed() -> tuple[Recording, ...]:
    """Return the recordings of ``recordings.toml``."""
    content = tomllib.loads(LIST.read_text(encoding="utf-8"))
    found = []
    for entry in content["recording"]:
        source = content["source"][entry.pop("source")]
        commit, paths = entry.pop("commit", source["commit"]), entry.pop("files")
        root = f"https://raw.githubusercontent.com/{source['repository']}/{commit}"
        files = {f"{entry['name']}-{path.rsplit('/', 1)[-1]}": f"{root}/{path}" for path in paths}
        origin = f"https://github.com/{source['repository']}"
        found.append(Recording(**entry, licence=source["licence"], origin=origin, files=files))
    return tuple(found)


RECORDINGS = listed()
