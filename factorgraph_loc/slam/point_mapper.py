"""The mapper of a factor graph that estimates points from images during a run."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping

from factorgraph_loc.fusion.graph.graph import Addition, Graph, Guess, Keyframe, Mapper, Node
from factorgraph_loc.fusion.graph.settings import GraphSettings
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.sensors.base import Sensor
from factorgraph_loc.sensors.camera.measurement import Pixels
from factorgraph_loc.sensors.camera.sensor import CameraSensor
from factorgraph_loc.slam.keyframe_cameras import HORIZON
from factorgraph_loc.slam.moving_things import MovingThings
from factorgraph_loc.slam.new_points import FEWEST
from factorgraph_loc.slam.unknown_points import UnknownPoints
from factors.camera.model import CameraModel
from factors.camera.point import PointFactor
from factors.graph import Values, gather

KEYFRAME_INTERVAL = 0.5  # s: longest time between two images that become keyframes
LEAST_COMMON = 0.3  # an image becomes a keyframe if it shares a smaller fraction of its features with the last keyframe


class PointMapper(UnknownPoints):
    """Adds the points of images to a factor graph as variables. It decides which images become keyframes."""

    fewest, horizon, estimates = FEWEST, HORIZON, True
    rejected = "camera: point is far from its estimated position"

    def __init__(self, camera: CameraSensor, model: CameraModel, diagnostics: Diagnostics) -> None:
        super().__init__(model, diagnostics, camera.constants)
        self._camera, self.sensor = camera, camera.name
        self.knows_scale = len(camera.points.map) > 0
        self._things = MovingThings(model)
        self._taken = -math.inf
        self._tracks: set[Hashable] = set()  # feature tracks of the last keyframe, without tracks on moving objects

    def is_due(self, m: Pixels) -> bool:
        return m.t - self._taken >= KEYFRAME_INTERVAL or self._has_lost_features(m)

    def _has_lost_features(self, m: Pixels) -> bool:
        """Return True if the image ``m`` has too few feature tracks in common with the image of the last keyframe."""
        if m.frame is None or not self._tracks:
            return False
        tracks = set(m.frame.tracks.tolist()) - self._things.moving
        return len(tracks & self._tracks) < LEAST_COMMON * len(tracks)

    def take(self, m: Pixels, keyframe: Keyframe, guess: Guess, graph: Graph, addition: Addition) -> Guess:
        points = self._camera.points
        if m.frame is None:
            names: list[Hashable] = list(m.names)
            used = {i for i, name in enumerate(m.names) if name in points.map.index}
        else:
            names, used = m.frame.tracks.tolist(), set(points.used.tolist())
        self._things.learn(keyframe, names, m.pixels, graph)
        moving = self._things.moving
        used |= {i for i, name in enumerate(names) if name in moving}
        self._taken = m.t
        if m.frame is not None:
            self._tracks = set(names) - moving
        rows = [i for i in range(len(names)) if i not in used]
        return self.take_rows(m, rows, keyframe, guess, graph, addition, self._things)

    def is_astray(self, node: Node, values: Values) -> bool:
        factor = node.factor
        if not isinstance(factor, PointFactor) or any(key not in values for key in node.keys):
            return False
        return factor.is_astray(gather(values, node.keys))

    def point(self, node: Node) -> int | None:
        return node.keys[-1] if isinstance(node.factor, PointFactor) else None


def bind(sensors: Mapping[str, Sensor], diagnostics: Diagnostics, settings: GraphSettings) -> Mapper:
    """Return the object that adds points to a graph. It adds none if no camera is among ``sensors`` (by name), or if
    the map is known."""
    camera = next((sensor for sensor in sensors.values() if isinstance(sensor, CameraSensor)), None)
    if camera is None or settings.landmarks == "known":
        return Mapper()
    return PointMapper(camera, camera.points.model, diagnostics)
