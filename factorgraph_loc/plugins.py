"""Registries of sensors, estimators, readers and mappers by name, loaded lazily.

Those of this project are listed in :mod:`factorgraph_loc.builtin`. Other packages register theirs by entry points of the groups
``factorgraph_loc.sensors``, ``factorgraph_loc.estimators``, ``factorgraph_loc.readers`` and ``factorgraph_loc.mappers``. Further
names that commands offer are here too, because this module is imported fast.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from typing import Any

from factorgraph_loc.errors import InputError
from factorgraph_loc.text import error_text, plain

Place = str  # "package.module:name", or "package.module"


def load(place: Place) -> Any:
    """Import the object at ``place``. ImportError or AttributeError if it does not exist."""
    module, _, name = place.partition(":")
    loaded = importlib.import_module(module)
    return getattr(loaded, name) if name else loaded


class Group(Mapping[str, Any]):
    """A registry of one kind of plug-in: name to loaded object, built-in ones first.

    ``kind``: the kind's name; ``own``: places of the built-in ones; ``needs``: attributes that each must have. InputError if an
    object of another package cannot be loaded, lacks a required attribute, or has a name that is taken.
    """

    def __init__(self, kind: str, *needs: str) -> None:
        self.kind, self.needs = kind, needs
        self.own: dict[str, Place] = {}
        self._others: dict[str, tuple[Place, str]] | None = None  # place and name of the package

    def place(self, name: str) -> Place:
        """The place of a name; KeyError if it is unknown."""
        return self.own[name] if name in self.own else self._installed()[name][0]

    def _installed(self) -> dict[str, tuple[Place, str]]:
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
        """Whether a name is registered; nothing is loaded."""
        return name in self.own or name in self._installed()

    def __iter__(self) -> Iterator[str]:
        yield from (*self.own, *self._installed())

    def __len__(self) -> int:
        return len(self.own) + len(self._installed())


SENSORS = Group("sensors", "channels", "settings", "layers")
ESTIMATORS = Group("estimators", "process", "estimate")
READERS = Group("readers", "Options", "read")
MAPPERS = Group("mappers")

FEATURES = ("colour", "sift", "orb")  # of images
MAP_ESTIMATORS = ("batch", "smoother", "ekf")  # those that estimate landmarks
ACTIVE_ESTIMATORS = ("active_mcl", "particle_filter", "smoother")  # of robots that plan their paths
PRESETS = {  # of simulations, each with its world
    "office": "Rooms on both sides of a corridor, doors, furniture; tags on walls and furniture.",
    "sparse": "The same with fewer tags.",
    "bursty": "The same as office; each antenna loses each tag for 2 s on average, a fifth of the time.",
    "corridor": "One corridor, the same from both ends; tags evenly on both sides.",
    "warehouse": "Rows of shelves with tags.",
    "symmetric": "Corridors in the shape of an H with a half-turn symmetry; three tags hang in them.",
}
POLICIES = {  # of active robots, each with the path that it chooses
    "information": "The largest expected reduction of entropy minus the cost.",
    "paper_literal": "The same with the sign as printed in the paper.",
    "random": "Any of the arcs, short straight paths and turns in place, to its end.",
    "patrol": "Straight on until a wall is near, then where most is free; back only if nothing else is free.",
    "nearest_tags": "Towards the nearest tags, on average over the belief.",
}
