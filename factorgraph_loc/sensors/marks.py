"""What is drawn of a sensor: the things of the map that it finds, and when it reads or sees them."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.registry import functions
from factors.se2 import Array


@dataclass(frozen=True, eq=False)
class Marks:
    """A ``layer`` of the map: ``names`` (K) of its things and ``positions`` (K, 3) [m], where estimators take them to be.

    ``t`` (N,) [s of the log], ``seen`` (N) names: what is read or seen when. ``marker``, ``size``, ``order``: how matplotlib draws
    them, the lowest order first. ``dense``: there are too many to tell one from the other, as of the points of images.
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
    """What all sensors draw of a log and its map."""
    return [draw(log) for _, draw in functions("draw")]
