"""A simulated robot that follows paths by its own odometry and reports measurements, and its proximity sensor.

The proximity sensor measures the free length up to the next wall in several directions. The measured lengths of one
reading are not independent, because the grid of free space and the shape of the walls cause common errors. The
likelihood is therefore tempered (:data:`TEMPERING`).
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from factorgraph_loc.maps.free_space import FreeSpace
from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.model.sections import kind_of
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.planning.paths import DIRECTIONS, Path, arc, free_steps
from factorgraph_loc.planning.settings import ActiveSettings
from factorgraph_loc.sensors.interfaces import LiveSensor
from factorgraph_loc.sensors.odometry import simulation as wheels
from factorgraph_loc.sensors.odometry.measurement import IncrementOdometry
from factorgraph_loc.sensors.registry import functions
from factorgraph_loc.simulation.settings import SimulationSettings
from factorgraph_loc.simulation.simulate import generator
from factors import se2
from factors.se2 import Array

SIGMA = 0.3  # m: standard deviation of a measured length
UNEXPECTED = 0.05  # constant likelihood of an outlier, relative to the peak of the Gaussian of correct lengths
TEMPERING = 0.25  # exponent of the likelihood
# names of the random generators; append only, because the order determines the random sequences
DRAWS = ("constants", "steps", "rfid", "lengths", "landmarks")
PERIOD = 1.0 / wheels.RATE  # s between two odometry measurements, and between two control steps
BETWEEN = 5  # collision checks between two poses of a path


class ProximitySensor:
    """A sensor of the distances to the next wall in D directions around the robot, up to its range ``sight`` [m].

    D is :data:`~factorgraph_loc.planning.paths.DIRECTIONS`, 12. ``space``: the free space between walls.
    """

    def __init__(self, space: FreeSpace, sight: float) -> None:
        self.space = space
        self._rays = [arc(2.0 * math.pi * k / DIRECTIONS, 0.0, sight) for k in range(DIRECTIONS)]
        self._sight = sight

    def expected(self, poses: Array) -> Array:
        """Return the lengths (M, D) [m] free of walls in D directions at ``poses`` (M, 3): measurements without
        noise."""
        steps = free_steps(self.space, poses, self._rays)
        return np.stack([ray.metres[at] for ray, at in zip(self._rays, steps, strict=True)], axis=1)

    def read(self, pose: Array, rng: np.random.Generator) -> Array:
        """Return a simulated measurement at the true ``pose`` (3,): the lengths (D,) [m] free of walls in D
        directions."""
        true = self.expected(pose[None])[0]
        return np.asarray(np.clip(true + SIGMA * rng.standard_normal(len(true)), 0.0, self._sight))

    def log_likelihood(self, poses: Array, lengths: Array) -> Array:
        """Return the log-likelihood (M,) of the measured ``lengths`` (D,) at ``poses`` (M, 3), up to a constant.

        The likelihood of a length is a Gaussian plus a constant for outliers (Thrun, Burgard, Fox, "Probabilistic
        Robotics", 2005, section 6.3.1). It is not normalised.
        """
        errors = (self.expected(poses) - lengths) / SIGMA
        return np.asarray(TEMPERING * np.log((1.0 - UNEXPECTED) * np.exp(-0.5 * errors**2) + UNEXPECTED).sum(axis=1))


class SimulatedRobot:
    """A simulated robot that follows paths, and reports odometry and measurements.

    Its odometry has the errors of :func:`~factorgraph_loc.sensors.odometry.simulation.wheel_odometry`. The robot
    controls its motion by the reported odometry, so that its true motion differs from the path. Motion and sensors use
    separate random sequences. Two robots with the same seed therefore have the same noise as long as they drive the
    same path.
    """

    def __init__(
        self,
        world: World,
        space: FreeSpace,
        simulation: SimulationSettings,
        start: Array,
        settings: ActiveSettings,
        rng: np.random.Generator,
    ) -> None:
        self.pose = np.array(start, dtype=float)
        self.t = 0.0
        self.metres = 0.0
        self._settings = settings
        self._space = space
        self.proximity = ProximitySensor(space, settings.sight)
        of = partial(generator, rng.bit_generator.seed_seq, names=DRAWS)
        made = [
            (name, on_robot(world, simulation.rig.alone(name), simulation, of(name)))
            for name, on_robot in functions("on_robot", simulation.rig)
        ]
        self.sensors: dict[str, LiveSensor] = {name: sensor for name, sensor in made if sensor is not None}
        named = [(name if kind_of(name) != name else sensor.channel, sensor) for name, sensor in self.sensors.items()]
        self._order = sorted(named, key=lambda entry: not entry[1].decides)  # by channel
        self._measured = [0] * len(self._order)
        self._noise, self._lengths = of("steps"), of("lengths")
        self._scale, self._drift, self._scale_of_turns = of("constants").normal(
            0.0, (wheels.SCALE_SIGMA, wheels.DRIFT_SIGMA, wheels.SCALE_SIGMA)
        )
        self._truth = [(0.0, *self.pose.tolist())]

    def trajectory(self) -> Trajectory:
        """Return the true trajectory since the start."""
        rows = np.array(self._truth)
        return Trajectory(rows[:, 0], rows[:, 1:])

    @property
    def channels(self) -> tuple[str, ...]:
        """The names of the channels (measurement streams) of the robot."""
        return (IncrementOdometry.sensor, *(channel for channel, _ in self._order))

    @property
    def decisive(self) -> tuple[str, ...]:
        """The channels of the main sensors. After their measurements the run checks whether the robot is localized."""
        any_decides = self._order[0][1].decides
        return tuple(channel for channel, sensor in self._order if sensor.decides or not any_decides)

    def begin(self) -> Iterator[Measurement]:
        """Yield the measurements before the first motion: one of odometry at rest, and one of each other sensor."""
        yield IncrementOdometry(0.0, 0.0, 0.0, 0.0)
        yield from self._measure()

    def free_ahead(self, paths: Sequence[Path]) -> Array:
        """Return the free length (C,) [m] of each of C paths, at most the range of the proximity sensor."""
        # check as often as the control does: the corner of a wall may be between two poses of a path
        steps = free_steps(self._space, self.pose[None], paths, BETWEEN)[:, 0]
        lengths = np.array([path.metres[step] for path, step in zip(paths, steps.tolist(), strict=True)])
        return np.asarray(np.minimum(lengths, self._settings.sight))

    def read_proximity(self) -> Array:
        """Return the free lengths (D,) [m] that the proximity sensor measures at the current pose."""
        return self.proximity.read(self.pose, self._lengths)

    def drive(self, path: Array, metres: float) -> Iterator[Measurement]:
        """Follow a path for at most ``metres`` [m], and stop before a wall. Yields the measurements.

        ``path`` (S, 3): poses in the frame of the robot at the start of the path.
        """
        for reported in self._reported_motions(path, metres):
            n1, n2, n3 = self._noise.standard_normal(3)
            root = math.sqrt(math.hypot(reported[0], reported[1]))
            dx = (reported[0] - wheels.ALONG * root * n1) / (1.0 + self._scale)
            dy = (reported[1] - wheels.LATERAL * root * n2) / (1.0 + self._scale)
            drifted = self._drift * math.hypot(dx, dy) + wheels.HEADING * root * n3
            moved = np.array((dx, dy, (reported[2] - drifted) / (1.0 + self._scale_of_turns)))
            pose = se2.compose(self.pose, moved)
            if root > 0.0 and not self._is_free(pose):
                return
            self.pose, self.metres = pose, self.metres + math.hypot(dx, dy)
            yield from self._passed(reported)

    def wait(self, seconds: float) -> Iterator[Measurement]:
        """Stand still for ``seconds`` [s], rounded to control periods. Yields the measurements in this time."""
        for _ in range(max(1, round(seconds / PERIOD))):
            yield from self._passed(np.zeros(3))

    def _passed(self, reported: Array) -> Iterator[Measurement]:
        """Advance the time by one control period, and yield its measurements. ``reported`` (3,): the motion by
        odometry."""
        self.t = round(self.t + PERIOD, 6)
        self._truth.append((self.t, *self.pose.tolist()))
        yield IncrementOdometry(self.t, float(reported[0]), float(reported[1]), float(reported[2]))
        yield from self._measure()

    def _measure(self) -> Iterator[Measurement]:
        """Yield the measurements that are due at the current time, of all sensors."""
        for i, (channel, sensor) in enumerate(self._order):
            if self.t * sensor.rate >= self._measured[i] - 1e-6:
                self._measured[i] += 1
                m = sensor.measure(self.t, self.pose)
                yield m if kind_of(channel) == channel else replace(m, source=channel)  # type: ignore[type-var]

    def _reported_motions(self, path: Array, metres: float) -> Array:
        """Return the motions (N, 3) in N control periods that follow ``path`` for at most ``metres`` [m]. Odometry
        reports exactly these motions. Each is in the frame of the robot before the motion."""
        twists = se2.log(se2.between(path[:-1], path[1:]))
        lengths = np.hypot(twists[:, 0], twists[:, 1])
        seconds = np.maximum(lengths / self._settings.speed, np.abs(twists[:, 2]) / self._settings.turn_rate)
        keep = (seconds > 1e-9) & (np.cumsum(lengths) - lengths < metres - 1e-9)
        if not keep.any():
            return np.empty((0, 3))
        poses = np.concatenate((path[:1], path[1:][keep]))
        driven = Trajectory(np.concatenate((np.zeros(1), np.cumsum(seconds[keep]))), poses)
        times = np.append(np.arange(0.0, driven.t[-1] - 1e-6, PERIOD), driven.t[-1])
        at = driven.at(times)
        return se2.between(at[:-1], at[1:])

    def _is_free(self, target: Array) -> bool:
        """True if the grid cell of ``target`` (3,) is free. If the robot itself is too close to a wall, the target must
        only be as far from walls as the robot."""
        ahead = Path(np.stack((np.zeros(3), se2.between(self.pose, target))), "step")
        return bool(free_steps(self._space, self.pose[None], [ahead])[0, 0])
