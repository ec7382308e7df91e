"""What `inspect` says about sensors and references that do not fit the odometry."""

from dataclasses import replace

import numpy as np
import pytest
from drives import driven

from factorgraph_loc import BearingRangeStream, Landmark, Log, Rig, Trajectory, VelocityStream, World, YawRateStream
from factorgraph_loc.evaluation.inspect import inspect
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings
from factorgraph_loc.sensors.odometry.settings import OdometrySettings
from factors import se2
from factors.landmarks import model as bearing_range

SETTINGS = BearingRangeSettings(range_sigma=0.1, bearing_sigma=0.03)
PLACES = {"a": (0.0, 0.0), "b": (6.0, 1.0), "c": (3.0, 7.0)}


@pytest.fixture
def log():
    """Two minutes of a robot that turns to and fro, stops and goes, with a gyro and sightings; all have noise."""
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 120.0, 0.05)
    v = np.where(t % 20.0 < 14.0, 0.4 + 0.1 * np.sin(t), 0.0)
    w = 0.4 * np.sin(0.7 * t) * (v > 0.0)
    poses = driven(se2.exp(0.05 * np.column_stack((v, 0.0 * v, w))[:-1]))
    seen = np.repeat(np.arange(0, len(t), 5), len(PLACES))
    marks = np.tile(list(PLACES.values()), (len(seen) // len(PLACES), 1))
    ranges, bearings = bearing_range.predict(SETTINGS.model(), poses[seen], marks)
    ranges, bearings = ranges + 0.1 * rng.standard_normal(len(seen)), bearings + 0.03 * rng.standard_normal(len(seen))
    return Log(
        name="drive",
        rig=Rig(bearing_range=SETTINGS),
        world=World(landmarks={name: Landmark(x=x, y=y) for name, (x, y) in PLACES.items()}),
        streams={
            "odometry": VelocityStream(t, v, w + 0.02 * rng.standard_normal(len(t)) * (v > 0.0)),
            "imu": YawRateStream(t, w + 0.02 * rng.standard_normal(len(t)) + 0.01),
            "bearing_range": BearingRangeStream(t[seen], list(PLACES) * (len(seen) // len(PLACES)), ranges, bearings),
        },
        reference=Trajectory(t[::2], poses[::2]),
    )


def later(log, **shifts):
    """The log with streams that are stamped later, by name."""
    streams = {k: replace(s, t=s.t + shifts.get(k, 0.0)) for k, s in log.streams.items()}
    return replace(log, streams=streams)


def motion_problems(log):
    """What the odometry's and the landmarks' packages say of a log."""
    sensors = inspect(log).sensors
    return [*sensors["odometry"].problems, *sensors["landmarks"].problems]


def test_a_log_that_fits_has_no_problems(log):
    assert motion_problems(log) == []


@pytest.mark.parametrize("shift", [-1.5, 0.2, 2.0])
@pytest.mark.parametrize("sensor", ["imu", "bearing_range"])
def test_a_clock_that_is_off_is_told_with_what_mends_it(log, sensor, shift):
    off = later(log, **{sensor: shift})
    (line,) = motion_problems(off)
    assert str(line).startswith("the gyro" if sensor == "imu" else sensor)
    assert f"{abs(shift):.2f} s {'later' if shift > 0 else 'earlier'}" in str(line)
    assert f"{sensor}.time_offset = {-shift:+.2f}" in str(line)
    assert line in inspect(off).problems


def test_a_mounting_that_is_off_is_no_clock(log):
    """A sensor .3 m ahead of its place in the rig, or high above the floor, is not stamped earlier or later."""
    sightings = log.streams["bearing_range"]
    places = np.array([PLACES[name] for name in sightings.landmark])
    for forward, height in ((0.3, 0.0), (0.0, 2.3)):
        ahead = replace(SETTINGS.model(), mounting=(forward, 0.0, 0.0))
        ranges, bearings = bearing_range.predict(ahead, log.reference.at(sightings.t), places)
        moved = replace(sightings, range=np.hypot(ranges, height), bearing=bearings)
        assert motion_problems(replace(log, streams=log.streams | {"bearing_range": moved})) == []


def test_at_constant_speed_no_clock_can_be_off(log):
    rng = np.random.default_rng(2)
    t = np.arange(0.0, 60.0, 0.05)
    v = 0.5 + 0.01 * rng.standard_normal(len(t))
    along = Trajectory(t + 1.0, driven(se2.exp(0.05 * np.column_stack((v, 0.0 * v, 0.0 * v))[:-1])), has_heading=False)
    straight = replace(log, reference=along, streams={"odometry": VelocityStream(t, v, 0.0 * t)})
    assert not any("stamped" in line for line in motion_problems(straight))


@pytest.mark.parametrize("has_heading", [True, False])
@pytest.mark.parametrize("shift", [-0.3, 1.0])
def test_a_reference_by_another_clock_is_told(log, shift, has_heading):
    reference = Trajectory(log.reference.t + shift, log.reference.poses, has_heading=has_heading)
    alone = replace(log, reference=reference, streams={"odometry": log.streams["odometry"]})
    (line,) = motion_problems(alone)
    assert f"odometry.time_offset = {shift:+.2f}" in str(line)
    mended = replace(alone, rig=Rig(odometry=OdometrySettings(time_offset=shift)))
    assert motion_problems(mended) == []


def test_headings_that_run_clockwise_are_told(log):
    reference = Trajectory(log.reference.t, log.reference.poses * (1.0, 1.0, -1.0))
    lines = motion_problems(replace(log, reference=reference, streams={"odometry": log.streams["odometry"]}))
    assert [(line.kind, line.fields) for line in lines] == [("opposite_turns", {"source": "the reference"})]


@pytest.mark.parametrize(
    ("sensor", "line"),
    [
        ("imu", "the gyro turns 57 times as much as the odometry: is it in degrees?"),
        ("odometry", "the odometry turns 57 times as much as the gyro: is it in degrees?"),
    ],
)
def test_turn_rates_in_degrees_are_told(log, sensor, line):
    stream = log.streams[sensor]
    streams = log.streams | {sensor: replace(stream, w=np.rad2deg(stream.w))}
    assert line in map(str, motion_problems(replace(log, streams=streams)))


def test_a_reference_that_is_shorter_than_the_log_is_told(log):
    part = replace(log, reference=Trajectory(log.reference.t[200:500], log.reference.poses[200:500]))
    assert "the reference covers 20.0 to 49.9 s of the odometry's 0.0 to 120.0 s" in map(str, motion_problems(part))
    beside = replace(log, reference=Trajectory(log.reference.t + 1000.0, log.reference.poses))
    assert "the reference has no pose while there is odometry" in map(str, motion_problems(beside))


@pytest.mark.parametrize(
    ("factors", "what"), [((1.3, 1.0), "travels 1.30"), ((0.3, 1.0), "travels 0.30"), ((1.0, 0.8), "turns 0.80")]
)
def test_a_scale_that_is_off_is_told(log, factors, what):
    moved = log.streams["odometry"]
    scaled = replace(moved, v=moved.v / factors[0], w=moved.w / factors[1])
    off = replace(log, streams={"odometry": scaled})
    (line,) = motion_problems(off)
    assert str(line).startswith(f"the reference {what} times as much as the odometry (scale_")
    scales = OdometrySettings(scale_distance=factors[0], scale_rotation=factors[1])
    assert motion_problems(replace(off, rig=Rig(odometry=scales))) == []


def test_the_scales_of_a_log_that_fits_are_one(log):
    found = inspect(log).found
    assert found["odometry.travels_ratio"] == pytest.approx(1.0, abs=0.01)
    assert found["odometry.turns_ratio"] == pytest.approx(1.0, abs=0.01)


def test_a_reference_that_stands_still_meanwhile_is_told(log):
    poses = log.reference.poses.copy()
    poses[(log.reference.t > 43.0) & (log.reference.t < 53.0), :] = poses[430]
    lines = motion_problems(replace(log, reference=Trajectory(log.reference.t, poses)))
    assert "the reference stands still at 43.0 s, where the odometry drives" in str(lines[-1])
