"""Where named blocks stand in the error state of a filter, and what a run learns about them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.model.belief import Learnt, LearntPoint
from factorgraph_loc.model.settings import Estimated
from factorgraph_loc.sensors.base import Observation, Sensor, View
from factorgraph_loc.sensors.motion import MOTION, Motion
from factors.se2 import Array

POSE = 3  # components of the error state that are the pose's


@dataclass(frozen=True)
class Layout:
    """The blocks of a state after its pose, by name, in their order: ``sizes``."""

    sizes: Mapping[str, int] = field(default_factory=dict)

    @staticmethod
    def of(constants: Mapping[str, Estimated]) -> Layout:
        """The blocks of estimated constants, by name."""
        return Layout({name: len(block.names) for name, block in constants.items() if block.names})

    @cached_property
    def columns(self) -> Mapping[str, slice]:
        """The columns of each block in the error state."""
        columns, start = {}, POSE
        for name, size in self.sizes.items():
            columns[name] = slice(start, start + size)
            start += size
        return columns

    def plus(self, name: str, size: int) -> Layout:
        """With one more block, which comes last."""
        return Layout({**self.sizes, name: size})

    def values(self, rest: Array) -> dict[str, Array]:
        """The blocks of a state by name. ``rest`` (R,): the state without the pose."""
        return {name: rest[part.start - POSE : part.stop - POSE] for name, part in self.columns.items()}


def constants_of(motion: Motion, sensors: Mapping[str, Sensor]) -> dict[str, Estimated]:
    """The estimated constants of the odometry and of the sensors, by block."""
    return {MOTION: motion.constants} | {name: sensor.constants for name, sensor in sensors.items()}


def on_pose(observation: Observation, view: View) -> Observation:
    """An observation of the pose alone, with its blocks where they are estimated to be."""
    values = {name: np.asarray(view.value(name)) for name in observation.blocks}
    return observation.on_pose(values, {name: view.block_covariance(name) for name in observation.blocks})


def learnt_from(
    constants: Mapping[str, Estimated], blocks: Iterable[tuple[str, Array, Array]], points: PointMap | None = None
) -> Learnt:
    """The ``constants`` by sensor, those of landmarks, and the landmarks ``KIND/NAME``, all from ``blocks``: names, means and
    covariances.

    Blocks of points in space are left out; ``points``: those that are not in the map."""
    values: dict[str, tuple[float, float]] = {}
    landmarks: dict[str, LearntPoint] = {}
    for name, mean, covariance in blocks:
        if name in constants:
            prefix = "" if name == MOTION else f"{name}."
            rows = zip(constants[name].names, mean, np.sqrt(np.diag(covariance)), strict=True)
            values |= {prefix + label: (float(value), float(sigma)) for label, value, sigma in rows}
        elif len(mean) == 1:
            values[name.replace("/", ".")] = float(mean[0]), float(np.sqrt(covariance[0, 0]))
        elif len(mean) == 2:
            landmarks[name.partition("/")[2]] = LearntPoint(mean, covariance)
    return Learnt(values, landmarks, points)
