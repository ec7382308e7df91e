"""The background of trajectory plots: map and reference of a log, reduced in size for storage beside results."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, Field

from factorgraph_loc.evaluation.pairing import pauses
from factorgraph_loc.files.models import write_text
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.interfaces import Marks, marks
from factors.se2 import Array

_POSES = 1500  # of the reference, in total
_POINTS = 1500  # of a map of points


@dataclass(frozen=True)
class Scene:
    """Map and reference in the world frame [m].

    ``walls`` (W, 4) as x1, y1, x2, y2; ``layers`` of the map (N, 2), such as landmarks, tags and points; ``reference``: pieces
    (N, 2) between long gaps. ``t0_ns``: the log's start, absolute."""

    walls: Array
    layers: Mapping[str, Array]
    reference: tuple[Array, ...]
    t0_ns: int = 0

    @classmethod
    def of(cls, log: Log) -> Scene:
        """The scene of a log, with objects where estimators assume them."""
        return cls(
            walls=np.array(log.world.walls, dtype=float).reshape(-1, 4),
            layers={one.layer: _thinned(one) for one in marks(log)},
            reference=_pieces(log),
            t0_ns=log.t0_ns,
        )

    def content(self) -> dict[str, Any]:
        """The scene as plain values, to a millimetre."""
        return {
            "walls": _plain(self.walls),
            **{name: _plain(places) for name, places in self.layers.items()},
            "reference": [_plain(piece) for piece in self.reference],
        }

    def write(self, path: Path) -> None:
        """Write a JSON file atomically."""
        write_text(path, json.dumps(self.content() | {"t0_ns": self.t0_ns}, separators=(",", ":")) + "\n")

    @classmethod
    def read(cls, path: Path) -> Scene:
        """Read the file of :meth:`write`. Raises OSError or ValueError if it is missing or damaged."""
        found = _SceneFile.model_validate_json(path.read_bytes())
        return cls(
            walls=np.array(found.walls).reshape(-1, 4),
            layers={name: np.array(one).reshape(-1, 2) for name, one in (found.__pydantic_extra__ or {}).items()},
            reference=tuple(np.array(piece).reshape(-1, 2) for piece in found.reference),
            t0_ns=found.t0_ns,
        )


class _SceneFile(BaseModel, extra="allow", allow_inf_nan=False):
    """The stored file: coordinates [m], also of each layer of the map."""

    __pydantic_extra__: dict[str, list[tuple[float, float]]]
    walls: list[tuple[float, float, float, float]]
    reference: list[list[tuple[float, float]]]
    t0_ns: Annotated[int, Field(ge=-(2**63), lt=2**63)]


def _thinned(one: Marks) -> Array:
    places = one.positions[:, :2]
    return places[:: len(places) // _POINTS + 1] if one.dense else places


def _pieces(log: Log) -> tuple[Array, ...]:
    if log.reference is None or not len(log.reference):
        return ()
    t, places = log.reference.t, log.reference.poses[:, :2]
    step = len(t) // _POSES + 1
    return tuple(
        piece[np.unique(np.append(np.arange(0, len(piece), step), len(piece) - 1))]
        for piece in np.split(places, pauses(t))
    )


def _plain(values: Array) -> list[list[float]]:
    return [[round(v, 3) for v in row] for row in values.tolist()]
