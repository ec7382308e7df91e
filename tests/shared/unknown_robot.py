"""A robot whose constants are known: it reports what its wheels and its sensor, wrong in a known way, make of a true path."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from changed_logs import with_stream
from drives import driven

from factorgraph_loc import BearingRangeStream, Landmark, Log, Rig, Trajectory, VelocityStream, World
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings
from factors import se2

STEP = 0.05  # s
WORLD = World(
    landmarks={
        f"{i}": Landmark(x=x, y=y)
        for i, (x, y) in enumerate([(-3.0, -3.0), (3.0, -3.0), (4.0, 4.0), (-4.0, 3.0), (0.0, 6.0), (6.0, 0.0)])
    }
)
UNKNOWING = Rig(name="unknown", bearing_range=BearingRangeSettings(range_sigma=0.2))


@dataclass(frozen=True)
class Robot:
    """The truth; noise of the path per sqrt(m) or sqrt(rad), scatter of sightings in m and rad."""

    scale_distance: float = 1.0
    scale_rotation: float = 1.0
    speed_bias: float = 0.0
    direction: float = 0.0
    delay: float = 0.0
    along: float = 0.01
    heading: float = 0.01
    x: float = 0.0
    y: float = 0.0
    bearing_bias: float = 0.0
    range_scale: float = 1.0
    depth: bool = False
    time_offset: float = 0.0
    range_sigma: float = 0.03
    bearing_sigma: float = 0.01
    outliers: float = 0.0


@pytest.fixture(scope="session")
def simulate() -> Callable[..., Log]:
    """``simulate(seed=1, seconds=300.0, scale_distance=0.95, ...)``: a log with a rig that knows nothing of the robot."""

    def make(seed=1, seconds=300.0, **truth) -> Log:
        robot = Robot(**truth)
        rng = np.random.default_rng(seed)
        t = np.arange(round(seconds / STEP)) * STEP
        # speeds change often, and the robot stands for a third of each minute
        pieces = rng.uniform((0.1, -0.7), (0.6, 0.7), (len(t) // 40 + 1, 2))
        v, w = np.repeat(pieces, 40, axis=0)[: len(t)].T * (t % 60.0 < 40.0)
        late = round(robot.delay / STEP)
        moved_v, moved_w = (np.concatenate((np.zeros(late), u))[: len(t)] for u in (v, w))
        noise = rng.standard_normal((len(t), 3)) * np.sqrt(
            np.column_stack((robot.along**2 * moved_v, 0.0 * t, robot.heading**2 * np.abs(moved_w))) * STEP
        )
        twists = (
            np.column_stack((moved_v * np.cos(robot.direction), moved_v * np.sin(robot.direction), moved_w)) * STEP
            + noise
        )
        truth = Trajectory(t, driven(se2.exp(twists[:-1])))
        odometry = VelocityStream(t, v / robot.scale_distance + robot.speed_bias, w / robot.scale_rotation)
        streams = {"odometry": odometry, "bearing_range": _sightings(truth, robot, rng)}
        return Log(f"simulated-{seed}", UNKNOWING, WORLD, streams, truth)

    return make


def _sightings(truth: Trajectory, robot: Robot, rng: np.random.Generator) -> BearingRangeStream:
    t = np.arange(1.0, truth.t[-1] - 1.0, 0.25)
    sensors = se2.compose(truth.at(t), np.array((robot.x, robot.y, 0.0)))
    names = np.tile(list(WORLD.landmarks), len(t))
    local = se2.transform_to(sensors[:, None], WORLD.positions()[None]).reshape(-1, 2)
    count = len(local)
    ranges = robot.range_scale * (local[:, 0] if robot.depth else np.hypot(*local.T))
    ranges += robot.range_sigma * rng.standard_normal(count)
    bearings = np.arctan2(local[:, 1], local[:, 0]) + robot.bearing_bias
    bearings += robot.bearing_sigma * rng.standard_normal(count)
    bad = rng.random(count) < robot.outliers
    ranges[bad] = rng.uniform(0.3, 15.0, np.sum(bad))
    bearings[bad] = rng.uniform(-np.pi, np.pi, np.sum(bad))
    stamps = np.repeat(t, len(WORLD.landmarks)) - robot.time_offset
    seen = local[:, 0] > 0.5 * np.abs(local[:, 1]) if robot.depth else np.ones(count, dtype=bool)
    return BearingRangeStream(stamps[seen], names[seen].tolist(), ranges[seen], se2.wrap(bearings[seen]))


@pytest.fixture
def headless() -> Callable[[Log], Log]:
    """The log with a reference whose headings mean nothing, and ranges alone."""

    def make(log: Log) -> Log:
        seen = log.streams["bearing_range"]
        log = with_stream(log, "bearing_range", bearing=np.full_like(seen.bearing, np.nan))
        return replace(log, reference=replace(log.reference, has_heading=False))

    return make
