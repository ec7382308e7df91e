"""What the packages of sensors are told of a simulated drive, and what they make of it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.stream import Stream
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factors.se2 import Array


@dataclass(frozen=True, eq=False)
class Ride:
    """A drive through a world: the ``truth`` from t = 0 on, the ``rig`` that estimators are told, and the true ``world``.

    ``settings``: of the simulation, with the sections that sensors register. ``rng``, ``rng_of_world``: generators by the name of
    what is drawn, of the log's seed and of the world's. ``recorded``: looks of recorded antennas that reads are drawn from, or
    None.
    """

    settings: Any
    rig: Rig
    world: World
    truth: Trajectory
    rng: Callable[[str], np.random.Generator]
    rng_of_world: Callable[[str], np.random.Generator]
    recorded: Any = None

    def times(self, rate: float) -> Array:
        """Times (N,) of a sensor that measures ``rate`` times per second, the first after one period."""
        return times(rate, self.truth)


@dataclass(frozen=True)
class Simulated:
    """What a sensor's channels would have reported, by their names. ``layers``: of the world as it is surveyed, where that differs
    from the true one; ``metadata`` and ``warnings`` of the log."""

    streams: Mapping[str, Stream] = field(default_factory=dict)
    layers: Mapping[str, Any] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


class LiveSensor(Protocol):
    """A simulated sensor of a robot that chooses where to drive: it measures ``rate`` times per second. ``decides``: whether the
    robot asks itself after each measurement whether it knows its place by now; of one that does not it waits for another's."""

    channel: str
    rate: float
    decides: bool

    def measure(self, t: float, pose: Array) -> Measurement:
        """What it reports at ``t`` [s] from a pose (3,)."""


def times(rate: float, truth: Trajectory) -> Array:
    """Times (N,) of a sensor on a drive, the first after one period."""
    count = int(float(truth.t[-1]) * rate + 1e-9)
    return np.asarray(np.minimum(np.arange(1, count + 1) / rate, truth.t[-1]))
