"""What registered sensors add to a rig and to a world: sections and layers by name, each with its class.

Classes and functions are named by their places, ``package.module:name``, and loaded when they are first used.
"""

from __future__ import annotations

from dataclasses import dataclass

from factorgraph_loc.plugins import Place


@dataclass(frozen=True)
class Section:
    """A section of a rig. ``kind``: its class, a :class:`~factorgraph_loc.files.models.FileModel`; ``always``: whether a rig that
    does not say it has the default one."""

    kind: Place
    always: bool = False


@dataclass(frozen=True)
class Layer:
    """A layer of a world, things by name. ``kind``: the class of one, a :class:`~factorgraph_loc.files.models.FileModel`."""

    kind: Place
