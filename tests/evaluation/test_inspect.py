"""What `inspect` says about a log: gaps, landmarks that do not match the map, landmarks that are misplaced or swapped."""

import dataclasses

import numpy as np
import pytest

from factorgraph_loc import BearingRangeStream, Landmark, Log, Rig, Trajectory, VelocityStream, World
from factorgraph_loc.evaluation.inspect import inspect
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings
from factorgraph_loc.sensors.landmarks.summary import find_suspects
from factorgraph_loc.text import notice
from factors.landmarks import model as bearing_range

PLACES = {"a": (0.0, 0.0), "b": (10.0, 0.0), "c": (10.0, 8.0), "d": (0.0, 8.0), "e": (5.0, -3.0)}
SETTINGS = BearingRangeSettings(
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
    seen = np.repeat(np.arange(0, len(t), 10), len(PLACES))
    points = np.tile(list(PLACES.values()), (len(seen) // len(PLACES), 1))
    ranges, directions = bearing_range.predict(SETTINGS.model(), poses[seen], points)
    ranges = ranges + rng.normal(0.0, SETTINGS.range_sigma, len(seen))
    directions = directions + rng.normal(0.0, SETTINGS.bearing_sigma, len(seen))
    gross = rng.random(len(seen)) < outliers
    ranges[gross] = rng.uniform(0.0, 20.0, gross.sum())
    if not bearings:
        directions = np.full(len(seen), np.nan)
    names = list(PLACES) * (len(seen) // len(PLACES))
    return Log(
        name="circle",
        rig=Rig(bearing_range=SETTINGS),
        world=world_of(PLACES),
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
    places = PLACES | {"b": PLACES["d"], "d": PLACES["b"]}
    log = dataclasses.replace(circling_log(bearings=bearings, outliers=outliers), world=world_of(places))
    assert {(s.landmark, s.swapped_with) for s in find_suspects(log)} == {("b", "d"), ("d", "b")}
    assert [p.fields["other"] for p in inspect(log).problems if p.kind == "misplaced_landmark"] == ["d", "b"]


@pytest.mark.parametrize("bearings", [True, False])
def test_a_misplaced_landmark_is_named_with_its_offset(bearings: bool) -> None:
    log = dataclasses.replace(circling_log(bearings=bearings), world=world_of(PLACES | {"c": (11.0, 6.5)}))
    (suspect,) = find_suspects(log)
    assert (suspect.landmark, suspect.swapped_with) == ("c", None)
    np.testing.assert_allclose(suspect.offset, (-1.0, 1.5), atol=0.1)


def test_nothing_is_suspected_without_a_reference_or_with_few_sightings() -> None:
    swapped = world_of(PLACES | {"b": PLACES["d"], "d": PLACES["b"]})
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
    places = {name: place for name, place in PLACES.items() if name != "a"} | {"z": (1.0, 1.0)}
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
