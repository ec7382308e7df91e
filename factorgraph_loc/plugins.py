"""Sensors, estimators, readers and mappers by name: ours, which :mod:`factorgraph_loc.builtin` lists, and those of other packages.

Each is named by its place, and imported when it is first used. Another package adds its own by entry points of the groups
``factorgraph_loc.sensors``, ``factorgraph_loc.estimators``, ``factorgraph_loc.readers`` and ``factorgraph_loc.mappers``.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from factorgraph_loc.errors import InputError
from factorgraph_loc.text import plain, told

Place = str  # "package.module:name", or "package.module"


def load(place: Place) -> Any:
    """What stands at a place. ImportError or AttributeError if it is not there."""
    module, _, name = place.partition(":")
    found = importlib.import_module(module)
    return getattr(found, name) if name else found


MOVED: dict[str, Callable[..., Any]] = {}  # what methods of a rig were in version 0.1.0, as functions of the rig


class Group(Mapping[str, Any]):
    """Things of one kind by name, ours first; each is loaded when it is asked for.

    ``kind``: what they are called; ``own``: the places of ours; ``needs``: attributes that one has. InputError if another package's
    cannot be loaded, lacks one of them, or has a name that is taken.
    """

    def __init__(self, kind: str, *needs: str) -> None:
        self.kind, self.needs = kind, needs
        self.own: dict[str, Place] = {}
        self._others: dict[str, tuple[Place, str]] | None = None  # with the name of the package

    def forget(self) -> None:
        """Look once more for what other packages bring, when that is asked for next."""
        self._others = None

    def place(self, name: str) -> Place:
        """Where one stands; KeyError if there is none of that name."""
        return self.own[name] if name in self.own else self._installed()[name][0]

    def _installed(self) -> dict[str, tuple[Place, str]]:
        if self._others is None:
            from importlib.metadata import entry_points  # noqa: PLC0415 - most commands need ours alone

            found: dict[str, tuple[Place, str]] = {}
            for entry in entry_points(group=f"factorgraph_loc.{self.kind}"):
                package = entry.dist.name if entry.dist else "another package"
                if entry.name in self.own or entry.name in found:
                    owner = "this project" if entry.name in self.own else found[entry.name][1]
                    raise InputError(f"{self.kind}: {package} brings {plain(entry.name)}, which {owner} has already")
                found[entry.name] = entry.value, package
            self._others = found
        return self._others

    def __getitem__(self, name: str) -> Any:
        if name in self.own:
            return load(self.own[name])
        place, package = self._installed()[name]
        what = f"{self.kind}: {plain(name)} of {package}"
        try:
            found = load(place)
        except Exception as error:  # whatever the code of others raises
            raise InputError(f"{what} cannot be loaded from {place}: {told(error)}") from error
        if missing := [needed for needed in self.needs if not hasattr(found, needed)]:
            raise InputError(f"{what} has no {missing[0]}, expected one that the docs describe")
        return found

    def __iter__(self) -> Iterator[str]:
        yield from (*self.own, *self._installed())

    def __len__(self) -> int:
        return len(self.own) + len(self._installed())


SENSORS = Group("sensors", "channels", "settings", "layers")
ESTIMATORS = Group("estimators", "process", "estimate")
READERS = Group("readers", "Options", "read")
MAPPERS = Group("mappers")
