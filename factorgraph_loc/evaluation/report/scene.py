"""The background of trajectory plots: map and reference of a log, reduced in size and stored with the results."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field

from factorgraph_loc.evaluation.pairing import pauses
from factorgraph_loc.files.models import write_text
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.interfaces import Marks, marks
from factors.se2 import Array

_POSES = 1500  # of the reference, in total
_POINTS = 1500  # of a map of points

Place = tuple[float, float]


class Scene(BaseModel, frozen=True, allow_inf_nan=False):
    """Map and reference in the world frame [m].

    ``walls`` as x1, y1, x2, y2; ``layers`` of the map, such as landmarks, tags and points; ``reference``: pieces between long
    gaps. ``t0_ns``: the log's start, absolute."""

    walls: list[tuple[float, float, float, float]]
    layers: dict[str, list[Place]]
    reference: list[list[Place]]
    t0_ns: int = Field(0, ge=-(2**63), lt=2**63)

    @classmethod
    def of(cls, log: Log) -> Scene:
        """The scene of a log to a millimetre, with objects where estimators assume them."""
        return cls(
            walls=_plain(np.array(log.world.walls, dtype=float).reshape(-1, 4)),
            layers={layer.layer: _plain(_thinned(layer)) for layer in marks(log)},
            reference=[_plain(piece) for piece in _pieces(log)],
            t0_ns=log.t0_ns,
        )

    def write(self, path: Path) -> None:
        """Write a JSON file atomically."""
        write_text(path, self.model_dump_json() + "\n")

    @classmethod
    def read(cls, path: Path) -> Scene:
        """Read the file of :meth:`write`. Raises OSError or ValueError if it is missing or damaged."""
        return cls.model_validate_json(path.read_bytes())


def _thinned(layer: Marks) -> Array:
    places = layer.positions[:, :2]
    return places[:: len(places) // _POINTS + 1] if layer.dense else places


def _pieces(log: Log) -> tuple[Array, ...]:
    if log.reference is None or not len(log.reference):
        return ()
    t, places = log.reference.t, log.reference.poses[:, :2]
    step = len(t) // _POSES + 1
    return tuple(
        piece[np.unique(np.append(np.arange(0, len(piece), step), len(piece) - 1))]
        for piece in np.split(places, pauses(t))
    )


def _plain(values: Array) -> list[Any]:
    return [tuple(round(v, 3) for v in row) for row in values.tolist()]
