"""Paths that match a glob pattern, with a bound on the files visited."""

import fnmatch
import os
import re
from collections.abc import Iterator
from pathlib import Path

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import DEEPEST
from factorgraph_loc.text import quoted

VISITED = 100_000  # maximum number of files and folders visited for a pattern
ANY_DEPTH = "**"
_MAGIC = re.compile(r"[*?[]")


def is_pattern(name: str) -> bool:
    return _MAGIC.search(name) is not None


def matching(pattern: str, folder: Path, source: object) -> list[Path]:
    """The sorted paths that match ``pattern`` relative to ``folder``: ``*``, ``?`` and ``[...]`` within a name, ``**`` for any
    folders except links. Raises InputError for an invalid pattern, or one that visits more than :data:`VISITED` files and
    folders."""
    path = Path(pattern)
    parts = path.parts[1:] if path.anchor else path.parts
    if len(parts) > DEEPEST:
        raise InputError(f"{source}: {quoted(pattern)} has {len(parts)} parts, expected at most {DEEPEST}")
    if wrong := [part for part in parts if ANY_DEPTH in part and part != ANY_DEPTH]:
        raise InputError(f"{source}: {quoted(pattern)} has {quoted(wrong[0])}, expected {ANY_DEPTH} to be a whole part")
    walk = _Walk(f"{source}: {quoted(pattern)} visits more than {VISITED:,} files and folders, expected a narrower one")
    found = {Path(path.anchor) if path.anchor else folder}
    for part in parts:
        found = {one for base in found for one in walk.step(base, part)}
    return sorted(one for one in found if os.path.lexists(one))


class _Walk:
    def __init__(self, too_many: str) -> None:
        self._too_many = too_many
        self._visited = 0

    def step(self, base: Path, part: str) -> Iterator[Path]:
        """The paths that match one part of a pattern."""
        if part == ANY_DEPTH:
            waiting = [base]
            while waiting:
                here = waiting.pop()
                yield here
                waiting += [Path(entry.path) for entry in self._entries(here) if entry.is_dir(follow_symlinks=False)]
        elif is_pattern(part):
            fits = re.compile(fnmatch.translate(part)).match
            yield from (Path(entry.path) for entry in self._entries(base) if fits(entry.name))
        else:
            self._count()
            yield base / part

    def _entries(self, folder: Path) -> list[os.DirEntry[str]]:
        """The entries of a folder; none if it is not a readable folder."""
        found = []
        try:
            with os.scandir(folder) as entries:
                for entry in entries:
                    self._count()
                    found.append(entry)
        except OSError:
            return found
        return found

    def _count(self) -> None:
        self._visited += 1
        if self._visited > VISITED:
            raise InputError(self._too_many)
