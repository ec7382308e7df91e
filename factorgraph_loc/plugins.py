"""Registries of sensors, estimators, readers and mappers by name. An object is imported when it is first used.

The module :mod:`factorgraph_loc.builtin` registers the objects of this project. Other packages register objects by
entry points of the groups ``factorgraph_loc.sensors``, ``factorgraph_loc.estimators``, ``factorgraph_loc.readers`` and
``factorgraph_loc.mappers``. This module also has the other names that commands accept, because it is fast to import.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from typing import Any

from factorgraph_loc.errors import InputError
from factorgraph_loc.text import error_text, plain

Place = str  # "package.module:name", or "package.module"


def load(place: Place) -> Any:
    """Import and return the object with the import path ``place``, such as "package.module:name".

    Raises ImportError or AttributeError if it does not exist.
    """
    module, _, name = place.partition(":")
    loaded = importlib.import_module(module)
    return getattr(loaded, name) if name else loaded


class Group(Mapping[str, Any]):
    """A registry of plug-ins of one kind. ``group[name]`` imports the plug-in of that name and returns it.

    ``kind``: name of the kind, such as "sensors". ``own``: import paths of the built-in plug-ins by name. ``needs``:
    names of the attributes that a plug-in must have. Getting a plug-in of another package raises InputError if it
    cannot be imported or lacks an attribute. Names that are already registered raise InputError too.
    """

    def __init__(self, kind: str, *needs: str) -> None:
        self.kind, self.needs = kind, needs
        self.own: dict[str, Place] = {}
        self._others: dict[str, tuple[Place, str]] | None = None  # plug-ins of other packages: import path and package

    def place(self, name: str) -> Place:
        """Return the import path of a plug-in, such as "package.module". Raises KeyError if ``name`` is unknown."""
        return self.own[name] if name in self.own else self._installed()[name][0]

    def _installed(self) -> dict[str, tuple[Place, str]]:
        """Return (import path, name of the package) of each plug-in of other packages, by the name of the plug-in."""
        if self._others is None:
            from importlib.metadata import entry_points  # noqa: PLC0415 - most commands need built-in ones only

            installed: dict[str, tuple[Place, str]] = {}
            for entry in entry_points(group=f"factorgraph_loc.{self.kind}"):
                package = entry.dist.name if entry.dist else "another package"
                if entry.name in self.own or entry.name in installed:
                    owner = "this project" if entry.name in self.own else installed[entry.name][1]
                    raise InputError(
                        f"{self.kind}: {package} registers {plain(entry.name)}, which {owner} already registers"
                    )
                installed[entry.name] = entry.value, package
            self._others = installed
        return self._others

    def __getitem__(self, name: str) -> Any:
        if name in self.own:
            return load(self.own[name])
        place, package = self._installed()[name]
        what = f"{self.kind}: {plain(name)} of {package}"
        try:
            loaded = load(place)
        except Exception as error:  # code of another package may raise anything
            raise InputError(f"{what} cannot be loaded from {place}: {error_text(error)}") from error
        if missing := [needed for needed in self.needs if not hasattr(loaded, needed)]:
            raise InputError(f"{what} has no {missing[0]}, which the interface requires")
        return loaded

    def __contains__(self, name: object) -> bool:
        """True if ``name`` is registered. The plug-in is not imported."""
        return name in self.own or name in self._installed()

    def __iter__(self) -> Iterator[str]:
        yield from (*self.own, *self._installed())

    def __len__(self) -> int:
        return len(self.own) + len(self._installed())


SENSORS = Group("sensors", "channels", "settings", "layers")
ESTIMATORS = Group("estimators", "process", "estimate")
READERS = Group("readers", "Options", "read")
MAPPERS = Group("mappers")

FEATURES = ("colour", "sift", "orb")  # kinds of point features of images
MAP_ESTIMATORS = ("batch", "smoother", "ekf")  # estimators that can estimate landmarks
ACTIVE_ESTIMATORS = ("active_mcl", "particle_filter", "smoother")  # estimators of `fgloc active`
PRESETS = {  # simulated worlds, with their descriptions
    "office": "Rooms on both sides of a corridor, doors, furniture; tags on walls and furniture.",
    "sparse": "The world of office with fewer tags.",
    "bursty": "The world of office; each antenna loses each tag a fifth of the time, for 2 s on average.",
    "gates": "The world of office without tags in the map; antennas at its doors read two tags on the robot.",
    "corridor": "One corridor that is the same from both ends; tags at equal distances on both sides.",
    "warehouse": "Rows of shelves with tags.",
    "symmetric": "Corridors in the shape of an H with a half-turn symmetry; three tags hang in them.",
}
POLICIES = {  # policies of `fgloc active`, with the path that each chooses
    "information": "The path with the largest expected reduction of entropy minus the cost.",
    "paper_literal": "As information, but with the sign as printed in the paper, which prefers the least informative path.",
    "random": "A random arc, short straight path or turn in place, driven to its end.",
    "patrol": "Straight on until a wall is near, then the direction with most free space; back if nothing else is free.",
    "nearest_tags": "The path towards the nearest tags, on average over the belief.",
}
