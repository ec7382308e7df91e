"""Visual odometry in a graph: relative-motion factors between the keyframes of consecutive images.

No pixel counts twice: the factors do not use tracks of map points, of points in the graph, or of points that wait for their
triangulation.
"""

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.fusion.graph.graph import Keyframe, Node
from factorgraph_loc.vision.frame_motion import frame_motion
from factors.camera.model import CameraModel
from factors.camera.visual_odometry import SHARED, VisualOdometryFactor
from factors.motion import Increment
from factors.se2 import Array

# m, rad, s: between images that are paired. For a motion that is short relative to the pixel noise, the estimated direction is
# biased towards the viewing direction, which accumulates over many short motions
LEAST_WAY, LEAST_TURN, LEAST_TIME = 0.25, 0.3, 1.5
MAX_TIME = 2.0


@dataclass(frozen=True)
class _Frame:
    keyframe: Keyframe
    pixels: dict[Hashable, Array]


class FramePairs:
    """Keeps the last image and makes a factor of it and the next one."""

    def __init__(self, model: CameraModel) -> None:
        self._model = model
        self._last: _Frame | None = None

    def previous(self, keyframe: Keyframe, keyframes: Mapping[int, Keyframe]) -> Keyframe | None:
        """The keyframe of the last image, if it is still one of ``keyframes`` and not much older than ``keyframe``."""
        if self._last is None:
            return None
        previous = self._last.keyframe
        if not 0.0 < keyframe.t - previous.t <= MAX_TIME:
            return None
        return previous if keyframes.get(previous.index) is previous else None

    def take(
        self, keyframe: Keyframe, names: Sequence[Hashable], pixels: Array, predicted: Increment | None
    ) -> Node | None:
        """Store the ``pixels`` (K, 2) of a keyframe, by ``names`` of tracks, and return the factor with the previous image.

        ``predicted``: the motion from that image's keyframe. None if there is no previous image, or the tracks do not determine
        the motion.
        """
        last, frame = self._last, _Frame(keyframe, dict(zip(names, pixels, strict=True)))
        if last is None or predicted is None:
            self._last = frame
            return None
        x, y, turn = predicted.delta
        if math.hypot(x, y) < LEAST_WAY and abs(turn) < LEAST_TURN and predicted.duration < LEAST_TIME:
            return None
        self._last = frame
        common = [name for name in frame.pixels if name in last.pixels]
        first = np.array([last.pixels[name] for name in common]).reshape(-1, 2)
        second = np.array([frame.pixels[name] for name in common]).reshape(-1, 2)
        motion = frame_motion(self._model, first, second, predicted, np.random.default_rng(0))
        if motion is None:
            return None
        factor = VisualOdometryFactor(motion.delta, SHARED * motion.information)
        return Node((last.keyframe.key, keyframe.key), factor, 3)
