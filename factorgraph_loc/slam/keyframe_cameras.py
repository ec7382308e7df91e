"""Camera poses of the keyframes of a graph, for points that are triangulated from them.

The pose of a keyframe is that at the stamp of its image. If the time offset of the camera is estimated, the image was taken
later. The robot then moves on with the odometry's velocity at the stamp.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from factorgraph_loc.fusion.graph.graph import Graph, Guess, Keyframe
from factorgraph_loc.model.settings import Estimated
from factorgraph_loc.slam.local_bundle import bundled
from factorgraph_loc.slam.new_points import KeyframeCamera, PointSighting
from factors import se2
from factors.camera.model import TIME_OFFSET, CameraModel
from factors.graph import tilt_key
from factors.se2 import Array

ANCHORED, SLACK = 4, 2.0  # points of the graph that determine a keyframe to so many pixels
HORIZON, BUNDLE = 60, 8  # keyframes for which sightings are kept, and keyframes that are adjusted together

Waiting = Mapping[Hashable, Sequence[PointSighting]]


class KeyframeCameras:
    """``twists``: velocities (3,) of the robot at keyframes by their number, none if the time offset of the camera is not among
    the ``estimated`` constants. ``anchored``: keyframes that points of the graph determine.
    """

    def __init__(self, model: CameraModel, estimated: Estimated) -> None:
        self._model = model
        self._offset = estimated.indices.index(TIME_OFFSET) if TIME_OFFSET in estimated.indices else None
        self.twists: dict[int, Array] = {}
        self.anchored: dict[int, bool] = {}

    def add(self, keyframe: Keyframe, graph: Graph) -> None:
        """Add a keyframe whose odometry is still kept."""
        if self._offset is not None:
            self.twists[keyframe.index] = graph.motion.twist(keyframe.t)

    def anchor(self, keyframe: Keyframe, points: int) -> None:
        """Store how many ``points`` of the graph a keyframe sees."""
        self.anchored[keyframe.index] = points >= ANCHORED

    def forget(self, first: int) -> None:
        """Forget the keyframes with numbers below ``first``."""
        self.twists = {number: twist for number, twist in self.twists.items() if number >= first}
        self.anchored = {number: anchored for number, anchored in self.anchored.items() if number >= first}

    def at_image(self, keyframe: int, guess: Guess, graph: Graph) -> Guess:
        """The pose of a keyframe when its image was taken, and its covariance with that of the offset."""
        return self._moved(keyframe, guess, graph, 1.0)

    def at_stamp(self, keyframe: int, guess: Guess, graph: Graph) -> Guess:
        """The inverse of :meth:`at_image`."""
        return self._moved(keyframe, guess, graph, -1.0)

    def pose(self, keyframe: int, graph: Graph) -> Array:
        """The current pose (3,) of a keyframe of the graph when its image was taken."""
        pose = graph.current(graph.keyframes[keyframe].key)
        return self._moved(keyframe, (pose, np.zeros((3, 3))), graph, 1.0)[0]

    def _moved(self, keyframe: int, guess: Guess, graph: Graph, sign: float) -> Guess:
        constants = graph.mapped_constants
        if self._offset is None or constants is None or keyframe not in self.twists:
            return guess
        twist = self.twists[keyframe]
        variance = graph.covariances[constants][self._offset, self._offset]
        later = se2.exp(sign * float(graph.values[constants][self._offset]) * twist)
        carried = se2.adjoint(se2.inverse(later))
        covariance = carried @ guess[1] @ carried.T + sign * variance * np.outer(twist, twist)
        return se2.compose(guess[0], later), covariance

    def cameras(
        self, newest: Keyframe, pose: Array, names: Iterable[Hashable], waiting: Waiting, graph: Graph
    ) -> dict[int, KeyframeCamera]:
        """The camera poses, by number, of the keyframes that see the ``waiting`` points ``names``.

        Each has the pixel errors that it causes in the ``newest`` keyframe, which is at ``pose`` (3,). Relative poses come from
        points of the graph if these determine both keyframes, otherwise from odometry.
        """
        slacks = self._slacks(newest, graph)
        cameras = {newest.index: self._camera(pose, newest.index, slacks, graph)}
        for i in {sighting.keyframe for name in names for sighting in waiting[name]}:
            if i not in cameras and i in slacks and graph.is_open(i):
                cameras[i] = self._camera(self.pose(i, graph), i, slacks, graph)
        return cameras

    def bundled(
        self, newest: Keyframe, pose: Array, waiting: Waiting, tilt: float, graph: Graph
    ) -> tuple[dict[int, KeyframeCamera], Array] | None:
        """The camera poses of the last keyframes by number, adjusted with the points ``waiting`` there, and the adjusted ``pose``
        (3,) of the ``newest`` one. None if that is anchored, or if the points do not determine it.

        ``tilt``: standard deviation [rad] of the floor.
        """
        if self.anchored[newest.index]:
            return None
        last = [index for index in sorted(self._slacks(newest, graph))[-BUNDLE:] if graph.is_open(index)]
        poses = [pose if i == newest.index else self.pose(i, graph) for i in last]
        result = bundled(replace(self._model, tilt=tilt), [graph.keyframes[i] for i in last], poses, waiting)
        if result is None:
            return None
        adjusted = zip(last[-len(result) :], result, strict=True)
        return {i: KeyframeCamera.of(self._model, p, SLACK, leaning) for i, (p, leaning) in adjusted}, result[-1][0]

    def _camera(self, pose: Array, keyframe: int, slacks: Mapping[int, float], graph: Graph) -> KeyframeCamera:
        return KeyframeCamera.of(self._model, pose, slacks[keyframe], graph.values[tilt_key(keyframe)])

    def _slacks(self, newest: Keyframe, graph: Graph) -> dict[int, float]:
        """The pixel error of the last keyframes relative to the newest."""
        slacks: dict[int, float] = {}
        to_anchor = since = 0.0  # variance of the rotation from the newest to the first anchored keyframe, and since
        reached = False
        for index in range(newest.index, max(-1, newest.index - HORIZON), -1):
            if self.anchored.get(index, False):
                reached, since = True, 0.0
            slacks[index] = math.hypot(SLACK, self._model.fx * math.sqrt(to_anchor + since))
            step = graph.keyframes[index].from_previous
            if step is None:
                break
            variance = float(step.covariance[2, 2])
            to_anchor, since = (to_anchor, since + variance) if reached else (to_anchor + variance, since)
        return slacks
