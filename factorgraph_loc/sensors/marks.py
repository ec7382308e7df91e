"""What is drawn of a sensor: map elements, and the times of their detection."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.registry import functions
from factors.se2 import Array


@dataclass(frozen=True, eq=False)
class Marks:
    """A ``layer`` of the map: ``names`` (K) of its elements and ``positions`` (K, 3) [m].

    ``t`` (N,) [s of the log], ``seen`` (N) names: detections. ``marker``, ``size``, ``order``: matplotlib style, lowest order
    first. ``dense``: whether there are too many elements to label.
    """

    layer: str
    names: Sequence[str]
    positions: Array
    t: Array = field(default_factory=lambda: np.empty(0))
    seen: Sequence[str] = ()
    marker: str = "d"
    size: float = 6.0
    order: float = 3.0
    dense: bool = False


def marks(log: Log) -> list[Marks]:
    """The marks of all sensors for a log and its map."""
    return [draw(log) for _, draw in functions("draw")]
