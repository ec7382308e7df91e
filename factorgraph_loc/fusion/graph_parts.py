"""What a graph estimator is made of: its settings, keyframes, what a measurement adds, and the trajectory between keyframes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from pydantic import Field, PlainSerializer, ValidatorFunctionWrapHandler, WrapValidator

from factorgraph_loc.files.models import FileModel
from factorgraph_loc.fusion.variables import Node, Values, pose_key
from factorgraph_loc.model.setup import MapUse
from factorgraph_loc.model.trajectory import Trajectory
from factors import se2
from factors.motion import ChainState, Increment, propagate
from factors.se2 import Array


class GraphSettings(FileModel):
    """Settings of every graph estimator, in seconds; see the module. ``max_delay``: how late a measurement may come.
    ``keyframe_interval``: by default 0.09 s, and 0.5 s where landmarks are estimated, which makes each update far dearer.

    ``self_calibration``: constants to which the rig gives an uncertainty are variables. ``landmarks``: see
    :class:`~factorgraph_loc.sensors.landmarks.sensor.KnownLandmarks`. ``visual_odometry``: what is followed from image to image,
    but is no point of map or graph, tells the motion between them (:mod:`~factorgraph_loc.slam.frame_pairs`).
    """

    keyframe_interval: Annotated[float, Field(ge=0.0, le=10.0)] | None = None
    keyframe_max_interval: Annotated[float, Field(ge=0.01, le=60.0)] = 1.0
    max_delay: Annotated[float, Field(ge=0.0, le=4.0)] = 0.5
    self_calibration: bool = True
    landmarks: MapUse = "known"
    visual_odometry: bool = False


def _lag(value: Any, bounded: ValidatorFunctionWrapHandler) -> Any:
    return math.inf if value in ("all", math.inf) else bounded(value)


def _written(lag: float | None) -> float | str | None:
    return "all" if lag == math.inf else lag


class SmootherSettings(GraphSettings):
    """``lag`` [s]: length of a window, behind which poses are final. By default causal estimates come from a window of 10 s and
    the final trajectory from the whole problem, solved at the end; ``all`` (infinity in Python) keeps the full history solved all
    the time, as is always done where landmarks or points are estimated. ``relinearize_*``: how far a variable may move (m and rad;
    for the odometry's constants in their units) before its factors are linearised anew, and after how many updates that is
    checked. ``smooth`` off: the final trajectory repeats the causal one."""

    lag: Annotated[float | None, Field(ge=0.1, le=3600.0), WrapValidator(_lag), PlainSerializer(_written)] = None
    relinearize_threshold: Annotated[float, Field(ge=1e-6, le=1.0)] = 0.05
    relinearize_skip: Annotated[int, Field(ge=1, le=100)] = 10
    smooth: bool = True


@dataclass
class Keyframe:
    """A pose variable of the graph: its time, the odometry there, and the sightings and scans that hang on it."""

    index: int
    t: float
    odometry: ChainState
    from_previous: Increment | None
    nodes: list[Node] = field(default_factory=list)

    @property
    def key(self) -> int:
        return pose_key(self.index)


Guess = tuple[Array, Array]  # a pose (3,) and its body-frame covariance (3, 3)


@dataclass
class Addition:
    """What a measurement adds to the graph: factors, and new variables with their guesses."""

    nodes: list[Node] = field(default_factory=list)
    values: Values = field(default_factory=dict)


@dataclass(frozen=True)
class TickAt:
    """A stamp at which the trajectory is wanted, and the motion to it from the keyframe before, as the odometry reports it."""

    t: float
    keyframe: int
    since: Increment


def between_keyframes(
    ticks: Sequence[TickAt], steps: Sequence[Increment], poses: Array, covariances: Array
) -> Trajectory:
    """The trajectory at ``ticks`` from M keyframes: ``poses`` (M, 3), body-frame ``covariances`` (M, 3, 3), M-1 ``steps`` between.

    A tick between two keyframes follows the odometry from the earlier one; what then misses the later one is spread in
    proportion to time. The covariance goes linearly from one to the other, plus that of a bridge pinned at both ends.
    """
    newest: dict[float, TickAt] = {tick.t: tick for tick in ticks}
    kept = [newest[t] for t in sorted(newest)]
    at = np.empty((len(kept), 3))
    spread = np.empty((len(kept), 3, 3))
    for i, tick in enumerate(kept):
        k = tick.keyframe
        at[i] = se2.compose(poses[k], tick.since.delta)
        spread[i] = propagate(covariances[k], tick.since)
        if k < len(steps):
            whole = steps[k]
            share = tick.since.duration / whole.duration
            missed = se2.log(se2.between(se2.compose(poses[k], whole.delta), poses[k + 1]))
            at[i] = se2.compose(at[i], se2.exp(share * missed))
            bridge = share * (1.0 - share) * whole.covariance
            spread[i] = (1.0 - share) * covariances[k] + share * covariances[k + 1] + bridge
    return Trajectory(np.array([tick.t for tick in kept]), at, se2.body_to_world(at, spread))
