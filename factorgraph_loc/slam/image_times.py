"""Where the robot was when images were taken, if the time offset of the camera is estimated.

The pose of a keyframe is that at the stamp of its image. Until the image is taken the robot moves on, as fast as the odometry says
at the stamp.
"""

import numpy as np

from factorgraph_loc.fusion.graph.variables import Guess, Keyframe
from factorgraph_loc.fusion.mapping import GraphView
from factorgraph_loc.model.settings import Estimated
from factors import se2
from factors.camera.model import TIME_OFFSET
from factors.se2 import Array


class ImageTimes:
    """The velocities (3,) of the robot at keyframes by their number (``twists``), none if the offset is not ``estimated``."""

    def __init__(self, estimated: Estimated) -> None:
        self._place = estimated.indices.index(TIME_OFFSET) if TIME_OFFSET in estimated.indices else None
        self.twists: dict[int, Array] = {}

    def add(self, keyframe: Keyframe, graph: GraphView) -> None:
        """Add a keyframe whose odometry is still kept."""
        if self._place is not None:
            self.twists[keyframe.index] = graph.twist(keyframe.t)

    def at_image(self, keyframe: int, guess: Guess, graph: GraphView) -> Guess:
        """The pose of a keyframe when its image was taken, and its covariance with that of the offset."""
        return self._moved(keyframe, guess, graph, 1.0)

    def at_stamp(self, keyframe: int, guess: Guess, graph: GraphView) -> Guess:
        """The inverse of :meth:`at_image`."""
        return self._moved(keyframe, guess, graph, -1.0)

    def pose(self, keyframe: int, graph: GraphView) -> Array:
        """The current pose (3,) of a keyframe of the graph when its image was taken."""
        pose = graph.current(graph.keyframes[keyframe].key)
        return self._moved(keyframe, (pose, np.zeros((3, 3))), graph, 1.0)[0]

    def _moved(self, keyframe: int, guess: Guess, graph: GraphView, sign: float) -> Guess:
        if self._place is None or graph.constants is None or keyframe not in self.twists:
            return guess
        twist = self.twists[keyframe]
        variance = graph.spreads[graph.shared[0]][self._place, self._place]
        later = se2.exp(sign * float(graph.constants[self._place]) * twist)
        return se2.compose(guess[0], later), guess[1] + sign * variance * np.outer(twist, twist)
