"""Sources of the logs of an experiment: small objects that can be sent to other processes, which load the logs.

Numerical libraries are imported only when a log is loaded, so that an experiment with stored results starts quickly.
"""

from __future__ import annotations

import itertools
import json
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.bounded import foreign, kind
from factorgraph_loc.files.data_root import RUN_FILE, find_data_root, named_path
from factorgraph_loc.files.models import read_toml
from factorgraph_loc.files.shipped import manifests
from factorgraph_loc.files.yaml import read_yaml
from factorgraph_loc.text import quoted

if TYPE_CHECKING:
    from factorgraph_loc.model.log import Log

_MAGIC = re.compile(r"[*?[]")
NAMING = {
    ".toml": read_toml,
    ".yaml": read_yaml,
    ".yml": read_yaml,
}  # readers of files that contain paths of other files


def is_pattern(name: str) -> bool:
    """True if a name is a glob, with ``*``, ``?`` or ``[``."""
    return _MAGIC.search(name) is not None


def matching(pattern: str, folder: Path, source: object) -> list[Path]:
    """Return the sorted paths that match a glob. ``folder``: start of a relative glob. ``source``: name for messages.

    Raises InputError for an invalid glob.
    """
    path = Path(pattern)
    root = Path(path.anchor) if path.anchor else folder
    with foreign(source, f"{quoted(pattern)} is not a pattern of paths"):
        return sorted(root.glob(str(path.relative_to(path.anchor))))


def _fixed_part(pattern: str) -> str:
    """Return the leading folders of a glob that contain no ``*``, ``?`` or ``[``."""
    parts = itertools.takewhile(lambda part: not is_pattern(part), Path(pattern).parts)
    return str(Path(*parts))


class LogSource(ABC):
    """A description of how to load a log. A file may contain several logs; ``number`` is the index of the log."""

    number: int = 0

    @abstractmethod
    def load_all(self) -> list[Log]:
        """Return all logs of the source. Raises InputError if they cannot be read or simulated."""

    @abstractmethod
    def files(self) -> dict[str, Path]:
        """Return {name: path} of the files of the log. A name does not depend on the folder of the datasets or of the
        log."""

    @abstractmethod
    def identity(self) -> dict[str, Any]:
        """Return {name: value} of everything that determines the log, except for the content of its files."""

    def load(self) -> Log:
        """Return the log with the index ``number``."""
        return self.load_all()[self.number]


@dataclass(frozen=True)
class RecordedSource(LogSource):
    """A recorded log.

    ``log``: a path, or a name that ``fgloc datasets`` lists. ``number``: index of the log if there are several.
    ``reader``: name of the reader, None to find it by the file. ``options``: options of the reader as JSON. ``rig``,
    ``world``: files to use instead of those of the log. ``data_root``: folder of the datasets, None for the environment
    variable FGLOC_DATA.
    """

    log: str
    number: int = 0
    reader: str | None = None
    options: str = "{}"
    rig: str | None = None
    world: str | None = None
    data_root: str | None = None

    def load_all(self) -> list[Log]:
        from factorgraph_loc.io.readers import load  # noqa: PLC0415

        rig, world, root = (None if name is None else Path(name) for name in (self.rig, self.world, self.data_root))
        options = json.loads(self.options)
        return load(self.log, data_root=root, reader=self.reader, options=options, rig=rig, world=world)

    def files(self) -> dict[str, Path]:
        given = {"rig": self.rig, "world": self.world}
        named = [(f"{what}/{name}", file) for what, path in given.items() for name, file in _of_toml(path)]
        return dict(named) | dict(self._data())

    def identity(self) -> dict[str, Any]:
        path = Path(self.log)
        name = path.stem if path.is_file() else path.name
        return {"log": name, "number": self.number, "reader": self.reader, "options": json.loads(self.options)}

    def _data(self) -> Iterator[tuple[str, Path]]:
        """Yield (name, path) of each file of the log, except for ``self.rig`` and ``self.world``."""
        path = Path(self.log)
        if self.log in manifests():
            path = manifests()[self.log]
        run = path / RUN_FILE if path.is_dir() else path
        if run.name == RUN_FILE and run.is_file():  # a file of the native format, or a manifest
            path = run if "reader" in read_toml(run) else run.parent
        if path.is_dir():
            yield from _of_folder(path)
            return
        if self.reader is not None or path.suffix != ".toml":
            yield path.name, path
            return
        yield from _of_toml(str(path))
        content = read_toml(path)
        for what, given in (("rig", self.rig), ("world", self.world)):
            if given is None and isinstance(content.get(what), str):
                file = named_path(path.parent, content[what], path, self.data_root)
                if not _is_below(file, path.parent):
                    yield from ((f"{what}/{name}", part) for name, part in _of_toml(str(file)))
        if content.get("path") is None:  # the data are part of a library, whose version is part of the key
            return
        summed = content.get("checksums")
        for name in list(summed) if isinstance(summed, dict) and summed else [str(content["path"])]:
            data = named_path(path.parent, name, path, self.data_root)
            if not kind(data):
                find_data_root(self.data_root, path)
            yield from _of_folder(data) if data.is_dir() else [(name, data)]


@dataclass(frozen=True)
class SimulatedSource(LogSource):
    """A simulated log. ``preset``: name of a preset, or path of a TOML file. ``settings``: changed settings as JSON.
    ``seed``: seed of all random numbers."""

    preset: str
    settings: str = "{}"
    seed: int = 0

    def load_all(self) -> list[Log]:
        from factorgraph_loc.simulation import named_settings, simulate  # noqa: PLC0415

        return [simulate(named_settings(self.preset, json.loads(self.settings)), self.seed)]

    def files(self) -> dict[str, Path]:
        return dict(_of_toml(self.preset)) if self.preset.endswith(".toml") else {}

    def identity(self) -> dict[str, Any]:
        return {"simulated": Path(self.preset).name, "settings": json.loads(self.settings), "seed": self.seed}


@dataclass(frozen=True)
class GivenSource(LogSource):
    """A ``log`` in memory. ``digest``: hash of its content."""

    log: Log = field(compare=False)
    digest: str

    def load_all(self) -> list[Log]:
        return [self.log]

    def files(self) -> dict[str, Path]:
        return {}

    def identity(self) -> dict[str, Any]:
        return {"given": self.digest}


def recorded_sources(name: str, folder: Path, **options: Any) -> list[RecordedSource]:
    """Return the sources of the logs that an experiment file refers to by ``name``.

    ``name``: a name that ``fgloc datasets`` lists, a path relative to ``folder``, or a glob of names or paths.
    ``options``: values of other fields of :class:`RecordedSource`, such as ``rig``. Raises InputError if a glob matches
    no log, or if a path leads out of ``folder`` and of the data folder.
    """
    known = manifests()
    if name in known:
        return [RecordedSource(name, **options)]
    data_root = options.get("data_root")
    if not is_pattern(name):
        # if nothing has this name or path, the reader raises an error later, which proposes a similar name
        path = named_path(folder, name, "logs", data_root)
        return [RecordedSource(str(path) if kind(path) or kind(Path(name)) else name, **options)]
    names = [candidate for candidate in known if fnmatchcase(candidate, name)]
    named_path(folder, _fixed_part(name), "logs", data_root)
    paths = [named_path(folder, str(path.absolute()), "logs", data_root) for path in matching(name, folder, "logs")]
    names += [str(path) for path in paths if options.get("reader") or _is_log(path)]
    if not names:
        raise InputError(
            f"no log matches {quoted(name)}: neither a name that `fgloc datasets` lists, nor a path from {folder}"
        )
    return [RecordedSource(candidate, **options) for candidate in names]


def _is_log(path: Path) -> bool:
    """True if a path is a dataset manifest, or a log in the native format."""
    if path.is_dir():
        return (path / RUN_FILE).is_file()
    return path.name == RUN_FILE or (
        path.suffix == ".toml" and not path.name.endswith((".rig.toml", ".world.toml")) and "reader" in read_toml(path)
    )


def _of_folder(folder: Path) -> Iterator[tuple[str, Path]]:
    """Yield (name, path) of each file in a folder and its subfolders."""
    for file in sorted(folder.rglob("*")):
        if file.is_file():
            yield f"{folder.name}/{file.relative_to(folder).as_posix()}", file


def _of_toml(path: str | None) -> Iterator[tuple[str, Path]]:
    """Yield (name, path) of a file of settings, and of all files that it names directly or indirectly."""
    if path is None:
        return
    folder = Path(path).parent
    waiting, met = [Path(path)], set()
    while waiting:
        file = waiting.pop()
        if file in met:
            continue
        met.add(file)
        yield file.relative_to(folder).as_posix(), file
        if file.suffix in NAMING and file.is_file():
            named = (
                file.parent / text for text in _texts(NAMING[file.suffix](file)) if text and len(text.encode()) < 200
            )
            waiting += [p for p in named if p.is_relative_to(folder) and p.is_file() and _is_below(p, folder)]


def _is_below(path: Path, folder: Path) -> bool:
    """True if an existing path lies below ``folder``, after links are resolved."""
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))


def _texts(content: Any) -> Iterator[str]:
    """Yield all texts in nested tables and lists."""
    if isinstance(content, str):
        yield content
    elif isinstance(content, Mapping):
        for value in content.values():
            yield from _texts(value)
    elif isinstance(content, list):
        for value in content:
            yield from _texts(value)
