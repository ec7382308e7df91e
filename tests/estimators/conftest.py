"""A simulated run whose noise is that of its rig."""

from collections.abc import Callable

import numpy as np
import pytest

from factorgraph_loc.log import BearingRangeStream, Log, VelocityStream
from factorgraph_loc.rig import BearingRangeSettings, GrowthSettings, OdometryNoise, OdometrySettings, Rig
from factorgraph_loc.trajectory import Trajectory
from factorgraph_loc.world import Landmark, World
from factors import se2

ODOMETRY_STEP = 0.05  # s
RANGE_SIGMA, BEARING_SIGMA, SIGHT = 0.1, 0.03, 5.0
WORLD = World(
    landmarks={
        "a": Landmark(x=-1.5, y=-1.0),
        "b": Landmark(x=1.5, y=-1.6),
        "c": Landmark(x=5.2, y=-0.8),
        "d": Landmark(x=6.0, y=2.3),
        "e": Landmark(x=5.0, y=6.1),
        "f": Landmark(x=1.4, y=6.6),
        "g": Landmark(x=-2.0, y=5.5),
        "h": Landmark(x=1.8, y=2.6),
    }
)
RIG = Rig(
    odometry=OdometrySettings(
        noise=OdometryNoise(
            along=GrowthSettings(per_distance=0.05),
            lateral=GrowthSettings(per_distance=0.03),
            heading=GrowthSettings(per_distance=0.08, per_rotation=0.05),
        )
    ),
    bearing_range=BearingRangeSettings(range_sigma=RANGE_SIGMA, bearing_sigma=BEARING_SIGMA, robust=3.0),
)


def _loop(t):
    """Speeds on a square with round corners: 10 s straight, 5 s in a quarter turn, all at 0.3 m/s."""
    return np.full(len(t), 0.3), np.where(t % 15.0 < 10.0, 0.0, np.pi / 10.0)


@pytest.fixture(scope="session")
def simulate() -> Callable[..., Log]:
    """``simulate(seed=1, seconds=60.0, rate=4.0, speeds=...)``: a log; ``rate`` [Hz] is that of the landmarks.

    ``speeds(t)`` gives v [m/s] and w [rad/s] at times (N,), which the wheels report. The robot slips off what they report by the
    noise of the rig, step by step.
    """

    def make(seed=1, seconds=60.0, rate=4.0, speeds=_loop) -> Log:
        rng = np.random.default_rng(seed)
        t = np.arange(round(seconds / ODOMETRY_STEP) + 1) * ODOMETRY_STEP
        v, w = speeds(t)
        reported = se2.exp(np.column_stack((v, 0.0 * v, w)) * ODOMETRY_STEP)
        noise = RIG.odometry.noise
        distance, rotation = np.abs(v) * ODOMETRY_STEP, np.abs(w) * ODOMETRY_STEP
        variance = [
            [g.model().variance(d, r, ODOMETRY_STEP) for g in (noise.along, noise.lateral, noise.heading)]
            for d, r in zip(distance, rotation, strict=True)
        ]
        steps = se2.compose(reported, se2.exp(rng.standard_normal((len(t), 3)) * np.sqrt(variance)))
        poses = np.zeros((len(t), 3))
        for i in range(1, len(t)):
            poses[i] = se2.compose(poses[i - 1], steps[i - 1])
        truth = Trajectory(t, poses)
        return Log(
            name="simulated",
            rig=RIG,
            world=WORLD,
            streams={
                "odometry": VelocityStream(t, v, w),
                "bearing_range": _sightings(truth, np.arange(0.13, seconds, 1.0 / rate), rng),
            },
            reference=truth,
        )

    return make


def _sightings(truth, t, rng):
    names = np.array(list(WORLD.landmarks))
    poses = truth.at(t)
    dx, dy = (WORLD.positions()[None] - poses[:, None, :2]).transpose(2, 0, 1)
    distance = np.hypot(dx, dy)
    measured = distance + RANGE_SIGMA * rng.standard_normal(distance.shape)
    bearing = np.arctan2(dy, dx) - poses[:, 2:] + BEARING_SIGMA * rng.standard_normal(distance.shape)
    rows, columns = np.nonzero(distance < SIGHT)
    return BearingRangeStream(
        t[rows], names[columns].tolist(), measured[rows, columns], se2.wrap(bearing[rows, columns])
    )
