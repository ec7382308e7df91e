"""The layout of a filter's error state, which consists of the pose and named blocks, and the report of estimated blocks.

A block is a vector of the state, such as the estimated constants of one sensor or the position of one landmark.
"""

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

POSE = 3  # number of components of the pose, which are the first components of the error state


@dataclass(frozen=True)
class Layout:
    """The order of the variables in an error state: the pose (3 components), then one block per sensor or landmark.
    ``sizes``: the number of components of each block, by name, in the order of the blocks."""

    sizes: Mapping[str, int] = field(default_factory=dict)

    @staticmethod
    def of(constants: Mapping[str, Estimated]) -> Layout:
        """Return the layout for the estimated ``constants`` of sensors, one block per sensor. Sensors without estimated
        constants get no block."""
        return Layout({name: len(block.names) for name, block in constants.items() if block.names})

    @cached_property
    def columns(self) -> Mapping[str, slice]:
        """The indices of each block in the error state, as a slice per name."""
        columns, start = {}, POSE
        for name, size in self.sizes.items():
            columns[name] = slice(start, start + size)
            start += size
        return columns

    def plus(self, name: str, size: int) -> Layout:
        """Return the layout with one more block at the end. ``name``: the name of the sensor or landmark. ``size``: the
        number of components of the block."""
        return Layout({**self.sizes, name: size})

    def values(self, rest: Array) -> dict[str, Array]:
        """Return {name of a block: its part of ``rest``}. ``rest`` (R,): the state without the pose."""
        return {name: rest[part.start - POSE : part.stop - POSE] for name, part in self.columns.items()}


def constants_of(motion: Motion, sensors: Mapping[str, Sensor]) -> dict[str, Estimated]:
    """Return the estimated constants of the odometry (``motion``) and of each sensor, by name."""
    return {MOTION: motion.constants} | {name: sensor.constants for name, sensor in sensors.items()}


def on_pose(observation: Observation, view: View) -> Observation:
    """Return ``observation`` as a function of the pose only. Sensor constants and landmarks are fixed at their
    estimates, and their covariances are added to the noise. ``view``: gives access to the estimates."""
    values = {name: np.asarray(view.value(name)) for name in observation.blocks}
    return observation.on_pose(values, {name: view.block_covariance(name) for name in observation.blocks})


def learnt_from(
    constants: Mapping[str, Estimated], blocks: Iterable[tuple[str, Array, Array]], points: PointMap | None = None
) -> Learnt:
    """Return a report of estimated constants and landmarks.

    ``constants``: the estimated constants of each sensor. ``blocks``: for each sensor or landmark, its name, mean and
    covariance. A landmark has a position (2 components) or a constant (1 component), and is called ``KIND/NAME``.
    Larger blocks are points in space and are left out. ``points``: a map of estimated points, or None.
    """
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
