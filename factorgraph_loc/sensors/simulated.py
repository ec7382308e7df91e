"""The interface between simulated drives and sensor packages."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from factorgraph_loc.model.measurement import Measurement, Stream
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factors.se2 import Array


@dataclass(frozen=True, eq=False)
class Ride:
    """A drive through a world: the ``truth`` from t = 0, the ``rig`` given to estimators, and the true ``world``.

    ``settings``: of the simulation, with the sections of the sensors. ``rng``, ``rng_of_world``: random generators by name, from
    the seeds of the log and of the world. ``recorded``: recorded reads to resample, or None.
    """

    settings: Any
    rig: Rig
    world: World
    truth: Trajectory
    rng: Callable[[str], np.random.Generator]
    rng_of_world: Callable[[str], np.random.Generator]
    recorded: Any = None

    def times(self, rate: float) -> Array:
        """Times (N,) of a sensor with ``rate`` [Hz], starting after one period."""
        return times(rate, self.truth)


@dataclass(frozen=True)
class Simulated:
    """The streams of a sensor's channels. ``layers``: of the surveyed world, if it differs from the true one; ``metadata`` and
    ``warnings`` of the log."""

    streams: Mapping[str, Stream] = field(default_factory=dict)
    layers: Mapping[str, Any] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


class LiveSensor(Protocol):
    """A simulated sensor of an active robot with ``rate`` [Hz]. ``decides``: whether the robot checks after each measurement if it
    is localized."""

    channel: str
    rate: float
    decides: bool

    def measure(self, t: float, pose: Array) -> Measurement:
        """The measurement at ``t`` [s] from pose (3,)."""


def times(rate: float, truth: Trajectory) -> Array:
    """Times (N,) of a sensor on a drive, starting after one period."""
    count = int(float(truth.t[-1]) * rate + 1e-9)
    return np.asarray(np.minimum(np.arange(1, count + 1) / rate, truth.t[-1]))
