"""What `inspect` says about sensors and references that do not fit the odometry."""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
from drives import driven

from factorgraph_loc import BearingRangeStream, Landmark, Log, Rig, Trajectory, VelocityStream, World, YawRateStream
from factorgraph_loc.evaluation.inspect import inspect
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings
from factorgraph_loc.sensors.landmarks.summary import find_suspects
from factorgraph_loc.sensors.odometry.settings import OdometrySettings
from factorgraph_loc.text import notice
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
        assert [
            p
            for p in motion_problems(replace(log, streams=log.streams | {"bearing_range": moved}))
            if p.kind != "height"
        ] == []


def test_at_constant_speed_no_clock_can_be_off(log):
    rng = np.random.default_rng(2)
    t = np.arange(0.0, 60.0, 0.05)
    v = 0.5 + 0.01 * rng.standard_normal(len(t))
    along = Trajectory(t + 1.0, driven(se2.exp(0.05 * np.column_stack((v, 0.0 * v, 0.0 * v))[:-1])), has_heading=False)
    straight = replace(log, reference=along, streams={"odometry": VelocityStream(t, v, 0.0 * t)})
    assert not any("timestamps" in str(line) for line in motion_problems(straight))


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
    assert "the reference trajectory and the odometry do not overlap in time" in map(str, motion_problems(beside))


@pytest.mark.parametrize(
    ("factors", "what"), [((1.3, 1.0), "travels 1.30"), ((0.3, 1.0), "travels 0.30"), ((1.0, 0.8), "turns 0.80")]
)
def test_a_scale_that_is_off_is_told(log, factors, what):
    moved = log.streams["odometry"]
    scaled = replace(moved, v=moved.v / factors[0], w=moved.w / factors[1])
    off = replace(log, streams={"odometry": scaled})
    (line,) = motion_problems(off)
    assert str(line).startswith(f"the reference {what} times as much as the odometry: set odometry.scale_")
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
    assert "the reference stands still at 43.0 s, while the odometry drives" in str(lines[-1])


CORNERS = {"a": (0.0, 0.0), "b": (10.0, 0.0), "c": (10.0, 8.0), "d": (0.0, 8.0), "e": (5.0, -3.0)}
TURNED = BearingRangeSettings(
    range_sigma=0.1, bearing_sigma=0.03, x=0.2, y=-0.1, heading=0.3, bearing_bias=0.1, range_scale=1.1
)


def world_of(places: dict[str, tuple[float, float]]) -> World:
    return World(landmarks={name: Landmark(x=x, y=y) for name, (x, y) in places.items()})


def circling_log(*, bearings: bool = True, outliers: float = 0.0) -> Log:
    """A robot on a circle that sees all landmarks twice a second for two minutes; noise as the rig says."""
    rng = np.random.default_rng(4)
    t = np.arange(0.0, 120.0, 0.05)
    heading = t / 8.0
    poses = np.stack((5.0 + 3.0 * np.sin(heading), 4.0 - 3.0 * np.cos(heading), heading), axis=-1)
    seen = np.repeat(np.arange(0, len(t), 10), len(CORNERS))
    points = np.tile(list(CORNERS.values()), (len(seen) // len(CORNERS), 1))
    ranges, directions = bearing_range.predict(TURNED.model(), poses[seen], points)
    ranges = ranges + rng.normal(0.0, TURNED.range_sigma, len(seen))
    directions = directions + rng.normal(0.0, TURNED.bearing_sigma, len(seen))
    gross = rng.random(len(seen)) < outliers
    ranges[gross] = rng.uniform(0.0, 20.0, gross.sum())
    if not bearings:
        directions = np.full(len(seen), np.nan)
    names = list(CORNERS) * (len(seen) // len(CORNERS))
    return Log(
        name="circle",
        rig=Rig(bearing_range=TURNED),
        world=world_of(CORNERS),
        streams={
            "odometry": VelocityStream(t, np.full(len(t), 0.375), np.full(len(t), 0.125)),
            "bearing_range": BearingRangeStream(t[seen], names, ranges, directions),
        },
        reference=Trajectory(t, poses),
    )


@pytest.mark.parametrize("bearings", [True, False])
@pytest.mark.parametrize("outliers", [0.0, 0.1])
def test_a_right_map_has_no_suspects(bearings: bool, outliers: float) -> None:
    assert find_suspects(circling_log(bearings=bearings, outliers=outliers)) == ()


@pytest.mark.parametrize("bearings", [True, False])
@pytest.mark.parametrize("outliers", [0.0, 0.1])
def test_swapped_landmarks_are_named_and_no_other(bearings: bool, outliers: float) -> None:
    places = CORNERS | {"b": CORNERS["d"], "d": CORNERS["b"]}
    log = dataclasses.replace(circling_log(bearings=bearings, outliers=outliers), world=world_of(places))
    assert {(s.landmark, s.swapped_with) for s in find_suspects(log)} == {("b", "d"), ("d", "b")}
    assert [p.fields["other"] for p in inspect(log).problems if p.kind == "misplaced_landmark"] == ["d", "b"]


@pytest.mark.parametrize("bearings", [True, False])
def test_a_misplaced_landmark_is_named_with_its_offset(bearings: bool) -> None:
    log = dataclasses.replace(circling_log(bearings=bearings), world=world_of(CORNERS | {"c": (11.0, 6.5)}))
    (suspect,) = find_suspects(log)
    assert (suspect.landmark, suspect.swapped_with) == ("c", None)
    np.testing.assert_allclose(suspect.offset, (-1.0, 1.5), atol=0.1)


def test_nothing_is_suspected_without_a_reference_or_with_few_sightings() -> None:
    swapped = world_of(CORNERS | {"b": CORNERS["d"], "d": CORNERS["b"]})
    log = dataclasses.replace(circling_log(), world=swapped)
    assert find_suspects(dataclasses.replace(log, reference=None)) == ()
    stream = log.streams["bearing_range"]
    assert isinstance(stream, BearingRangeStream)
    few = BearingRangeStream(stream.t[:40], stream.landmark[:40], stream.range[:40], stream.bearing[:40])
    assert find_suspects(dataclasses.replace(log, streams={"bearing_range": few})) == ()


def test_bearings_are_not_used_where_the_reference_has_no_heading() -> None:
    log = circling_log()
    assert log.reference is not None
    senseless = log.reference.poses * (1.0, 1.0, 0.0)
    log = dataclasses.replace(log, reference=Trajectory(log.reference.t, senseless, has_heading=False))
    assert find_suspects(log) == ()


def test_gaps_unseen_and_unknown_landmarks_and_missing_streams_are_named() -> None:
    log = circling_log()
    stream = log.streams["bearing_range"]
    assert isinstance(stream, BearingRangeStream)
    places = {name: place for name, place in CORNERS.items() if name != "a"} | {"z": (1.0, 1.0)}
    late = dataclasses.replace(stream, t=np.where(stream.t > 60.0, stream.t + 30.0, stream.t))
    found = inspect(
        dataclasses.replace(
            log, streams={"bearing_range": late}, world=world_of(places), warnings=(notice("mended", "mended"),)
        )
    )
    assert found.found["unseen"] == ("z",)
    assert found.found["unknown"] == {"a": 240}
    assert found.streams["bearing_range"].gaps == ((60.0, pytest.approx(30.5)),)
    assert found.streams["bearing_range"].rate == pytest.approx(2.0)
    text = "\n".join(map(str, found.problems))
    for part in (
        "mended",
        "no odometry",
        "bearing_range: a gap above 5 s, the longest 30.5 s at t = 60.000 s",
        "landmark z of the map is never seen",
        "landmark a is not",
    ):
        assert part in text
