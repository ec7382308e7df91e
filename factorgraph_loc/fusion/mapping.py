"""What maps points while a graph localizes, as the graph knows it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from factorgraph_loc.fusion.graph.variables import Addition, Guess, Keyframe, Node, Values
from factorgraph_loc.maps.points import PointMap
from factors.motion import Increment
from factors.se2 import Array


@dataclass(frozen=True)
class GraphView:
    """What a mapper sees of its graph: the ``keyframes`` by number; estimates of all variables but poses, to which it adds
    (``values``, ``spreads``); the ``current`` estimate of a variable by key; which keyframes are open; the motion ``between``
    two of them; what wheels that ``slip`` do to an increment, and the robot's velocity (``twist``, (3,)) at a time, as the motion
    tells them; keys of the sensor's constants (``shared``), and the values (P,) of these."""

    keyframes: Mapping[int, Keyframe]
    values: Values
    spreads: Values
    current: Callable[[int], Array]
    is_open: Callable[[int], bool]
    between: Callable[[Keyframe, Keyframe], Increment]
    slip: Callable[[Increment], tuple[Array, float]]
    twist: Callable[[float], Array]
    shared: tuple[int, ...] = ()
    constants: Array | None = None


class Mapper:
    """Makes variables of points that a sensor sees and no map has. This base class maps nothing.

    ``sensor``: the name of the one whose measurements it takes, "" for none. ``fewest``: number of sightings that a point of the
    graph needs.
    ``horizon``: number of recent keyframes that it needs. ``rejected``: why sightings of something else are rejected.
    ``estimates``: whether points become variables. ``knows_scale``: whether their scale comes from elsewhere than the motion.
    """

    sensor: str = ""
    fewest: int = 0
    horizon: int = 0
    rejected: str = ""
    estimates: bool = False
    knows_scale: bool = True

    def is_due(self, m: Any) -> bool:
        """Whether a measurement needs a keyframe of its own."""
        return False

    def take(
        self, m: Any, keyframe: Keyframe, guess: Guess, graph: GraphView, addition: Addition, *, is_new: bool
    ) -> Guess:
        """Add the information of a measurement from the newest keyframe to an ``addition``. Returns the corrected guess of its
        pose. ``is_new``: whether the keyframe was made for it."""
        return guess

    def is_astray(self, node: Node, values: Values) -> bool:
        """Whether a node is a sighting that cannot be of its point."""
        return False

    def point(self, node: Node) -> int | None:
        """The key of the point that a node is a sighting of."""
        return None

    def leave(self, t: float) -> Sequence[int]:
        """Keys of the points that were last seen before ``t``, which the graph has no more from now on."""
        return ()

    def keep_only(self, keys: set[int]) -> None:
        """Give up all points but those with these ``keys``."""

    def forget(self, first: Keyframe) -> Sequence[int]:
        """Forget the keyframes before the ``first``, and the points that have left the graph and were not seen since.
        Returns the keys of these points."""
        return ()

    def learnt(self, values: Mapping[int, Array], spreads: Mapping[int, Array]) -> PointMap | None:
        """All points that ever were in the graph. ``values`` and ``spreads``: of the points and of the poses of keyframes."""
        return None
