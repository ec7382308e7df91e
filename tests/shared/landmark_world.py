"""A robot that drives a loop among landmarks, with noise as its rig says, and one whose constants are not those of its rig."""

from dataclasses import replace

import changed_logs
import numpy as np
from drives import driven, slipped

from factorgraph_loc import BearingRangeStream, Landmark, Log, Rig, Trajectory, VelocityStream, World
from factorgraph_loc.model.log import cut, join
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings, BearingRangeUncertainty
from factorgraph_loc.sensors.odometry.settings import (
    GrowthSettings,
    OdometryNoise,
    OdometrySettings,
    OdometryUncertainty,
)
from factors import se2
from factors.landmarks import model as bearing_range

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
# what the constants are, as changes from the rig's; the rig states twice as much as standard deviation
TRUTH = {
    "scale_distance": 0.06,
    "heading_rate_bias": 0.02,
    "bearing_range.x": 0.25,
    "bearing_range.y": -0.2,
    "bearing_range.bearing_bias": 0.05,
    "bearing_range.range_scale": 0.06,
    # the model takes the robot's velocity as constant for that long, which it is not where turns begin and end
    "bearing_range.time_offset": 0.1,
}
DEPTH = {"bearing_range.depth_axis": 0.08, "bearing_range.x": 0.25}


def _loop(t):
    """Speeds on a square with round corners: 10 s straight, 5 s in a quarter turn, all at 0.3 m/s."""
    return np.full(len(t), 0.3), np.where(t % 15.0 < 10.0, 0.0, np.pi / 10.0)


def simulate(seed=1, seconds=60.0, rate=4.0, speeds=_loop) -> Log:
    """A log; ``rate`` [Hz] is that of the landmarks.

    ``speeds(t)`` gives v [m/s] and w [rad/s] at times (N,), which the wheels report. The robot slips off what they report by the
    noise of the rig, step by step.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds / ODOMETRY_STEP) + 1) * ODOMETRY_STEP
    v, w = speeds(t)
    truth = Trajectory(t, driven(slipped(v, w, ODOMETRY_STEP, RIG.odometry.noise, rng)[:-1]))
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


def miscalibrated(log, truth, *, depth=False):
    """The log of a robot whose constants differ by ``truth`` from those of its rig.

    A sensor of depths sees 60 degrees to each side.
    """
    rng = np.random.default_rng(0)
    odometry = log.streams["odometry"]
    v = odometry.v / (1.0 + truth.get("scale_distance", 0.0))
    w = odometry.w + truth.get("heading_rate_bias", 0.0)
    changes = np.array([truth.get(f"bearing_range.{name}", 0.0) for name in bearing_range.PARAMETERS])
    kind = {"range_kind": "depth"} if depth else {}
    settings = log.rig.bearing_range.model_copy(update=kind)
    model = bearing_range.recalibrated(settings.model(), changes)

    offset = truth.get("bearing_range.time_offset", 0.0)
    t = np.unique(log.streams["bearing_range"].t)
    t = t[t + offset <= log.reference.t[-1]]
    poses, points = log.reference.at(t + offset)[:, None], log.world.positions()
    distance = np.hypot(*(points - poses[..., :2]).transpose(2, 0, 1))
    ranges, bearings = bearing_range.predict(model, poses, points)
    visible = (distance < 5.0) & ((np.abs(bearings) < np.pi / 3.0) if depth else True)
    ranges = ranges + settings.range_sigma * rng.standard_normal(ranges.shape)
    bearings = se2.wrap(bearings + settings.bearing_sigma * rng.standard_normal(ranges.shape))
    rows, columns = np.nonzero(visible)
    names = np.array(list(log.world.landmarks))[columns].tolist()
    seen = BearingRangeStream(t[rows], names, ranges[rows, columns], bearings[rows, columns])

    sigmas = {name: 2.0 * abs(value) for name, value in truth.items()}
    of_sensor = {name.partition(".")[2]: s for name, s in sigmas.items() if "." in name}
    of_odometry = {name: s for name, s in sigmas.items() if "." not in name}
    rig = log.rig.model_copy(
        update={
            "odometry": log.rig.odometry.model_copy(update={"uncertainty": OdometryUncertainty(**of_odometry)}),
            "bearing_range": settings.model_copy(update={"uncertainty": BearingRangeUncertainty(**of_sensor)}),
        }
    )
    return replace(log, rig=rig, streams={"odometry": replace(odometry, v=v, w=w), "bearing_range": seen})


def kidnapped():
    """A log in which the robot is carried after 10 s to where another run is at 25 s."""
    return join(cut(simulate(seconds=20.0), 0.0, 10.0), cut(simulate(seed=3, seconds=37.0), 25.0, 37.0))


def with_sightings(log, keep=None, **columns):
    """The log with other columns of its sightings, or without some rows."""
    log = changed_logs.with_stream(log, "bearing_range", **columns)
    return log if keep is None else changed_logs.rows(log, "bearing_range", np.flatnonzero(keep))


def swapped(log, one, other):
    """The log with two landmarks of its map in each other's place."""
    landmarks = dict(log.world.landmarks)
    landmarks[one], landmarks[other] = landmarks[other], landmarks[one]
    return replace(log, world=log.world.model_copy(update={"landmarks": landmarks}))
