"""Estimators that do not know the heading, or the place, and find it again."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import camera_world
import numpy as np
import pytest
from by_hand import made
from landmark_world import simulate, with_sightings

from factorgraph_loc import IncrementOdometry, IncrementStream, InputError, Log, RfidScan, Rig, Tick, Trajectory
from factorgraph_loc.evaluation.metrics import errors, score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.belief import PosePrior
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.log import cut, join
from factorgraph_loc.sensors.known_position import KnownPosition
from factorgraph_loc.sensors.motion import Motion
from factorgraph_loc.simulation import preset
from factorgraph_loc.simulation import simulate as simulated
from factors import se2

CONFIGS = {
    "ekf": RunConfig("ekf"),
    "particle_filter": RunConfig("particle_filter", {"particles": 1500}),
    "smoother": RunConfig("smoother"),
}
TURN = 2.2  # rad: the heading of the start, which nobody would guess
UNLIKELY = 21.1  # of a squared error of three dimensions: exceeded once in 10,000 times


@pytest.fixture(scope="module")
def log():
    """The simulated log in a world that is turned about the start."""
    made = simulate(seconds=30.0)
    turn = np.array((0.0, 0.0, TURN))
    reference = made.reference
    landmarks = {
        name: mark.model_copy(update=dict(zip("xy", se2.transform_from(turn, np.array((mark.x, mark.y))), strict=True)))
        for name, mark in made.world.landmarks.items()
    }
    return replace(
        made,
        world=made.world.model_copy(update={"landmarks": landmarks}),
        reference=Trajectory(reference.t, se2.compose(turn, reference.poses)),
    )


def position(log):
    x, y, _ = log.reference.poses[0]
    return f"{x},{y}"


def check(log, result, within):
    """It finds the heading in time, claims nothing before that, knows how near it is then, and tells the whole way in the end."""
    final = errors(result.final, log.reference)
    assert result.final.t[0] <= result.t[0] + 1e-9
    assert len(result.final) == len(result.t)
    assert np.nanmax(final.position) < 0.4
    assert np.nanmax(np.abs(final.heading)) < 0.3
    first = result.status.index("localized")
    assert result.t[first] - result.t[0] < within
    assert set(result.status[:first]) <= {"unlocalized", "ambiguous"}
    assert set(result.status[first:]) == {"localized"}
    difference = result.poses - log.reference.at(result.t, max_gap=0.2)
    difference[:, 2] = se2.wrap(difference[:, 2])
    assert np.nanmax(np.hypot(*difference[first:, :2].T)) < 0.4
    first += int(np.argmax(np.isfinite(difference[first:, 0])))
    assert difference[first] @ np.linalg.solve(result.covariances[first], difference[first]) < UNLIKELY


@cache
def seen_from_afar():
    told = {"drive": {"duration": 14.0}, "world": {"tags": 25, "landmarks": 20, "points": 60}}
    return simulated(preset("office", told), 2)


@pytest.mark.parametrize("name", ["ekf", "particle_filter"])
def test_sightings_that_fit_no_heading_leave_the_start_as_it_was_told(name):
    """The robot is 9 m away: at times no heading explains what is seen from there, and the robot claims none."""
    log = seen_from_afar()
    result = run(log, replace(CONFIGS[name], prior="10,6", sensors=("odometry", "bearing_range")))
    assert "localized" not in result.status
    assert np.all(np.isfinite(result.poses))


def test_a_camera_that_sees_the_robot_elsewhere_is_not_believed():
    log = camera_world.simulate(seconds=3.0)
    x, y, _ = log.reference.poses[0]
    result = run(log, RunConfig("smoother", prior=f"{x + 2.0},{y}"))
    assert "localized" not in result.status


def test_before_anything_is_seen_the_position_is_known_as_far_as_it_can_be(log):
    late = cut(log, 0.0, 20.0)
    late = with_sightings(late, late.streams["bearing_range"].t > 8.0)
    for name in ("ekf", "smoother", "particle_filter"):
        result = run(late, replace(CONFIGS[name], prior=position(log)))
        assert result.status[0] == "ambiguous"
        truth = late.reference.at(result.t, max_gap=0.2)
        for i in (
            (10, 60) if name != "particle_filter" else ()
        ):  # after 1 s, and 6 s; the filter tells its heaviest place
            error = result.poses[i] - truth[i]
            error[2] = se2.wrap_scalar(error[2])
            assert error @ np.linalg.solve(result.covariances[i], error) < UNLIKELY
        check(late, result, 14.0)


def test_the_start_as_a_constraint():
    """Loss, gradient and density of present poses are those of where they began, and draws have the moments that it states."""
    motion = Motion(Rig(), ("odometry",), Diagnostics())
    for t, x, y, turn in ((0.0, 0.0, 0.0, 0.0), (1.0, 0.5, 0.1, 0.7), (2.0, 0.4, -0.1, 0.3)):
        motion.add(IncrementOdometry(t, x, y, turn))
    position, covariance = np.array((1.0, -2.0)), np.array(((0.04, 0.01), (0.01, 0.09)))
    start = KnownPosition(PosePrior.at_position(0.0, position, covariance), motion)
    now = motion.state(2.0)
    moved = motion.relative(start.odometry, now)
    poses = start.candidates(now)
    np.testing.assert_allclose(start.loss(poses, now), 0.0, atol=1e-12)
    np.testing.assert_allclose(se2.compose(poses, se2.inverse(moved.delta))[:, :2], np.tile(position, (72, 1)))

    rng = np.random.default_rng(1)
    poses = se2.compose(poses[:5], se2.exp(rng.normal(0.0, 0.1, (5, 3))))
    information, gradient = start.normal_equations(poses, now)
    for k, step in enumerate(1e-6 * np.eye(3)):
        ahead, behind = (start.loss(se2.compose(poses, se2.exp(s)), now) for s in (step, -step))
        # the covariance turns with the pose, which the gradient leaves out
        np.testing.assert_allclose(gradient[:, k], (ahead - behind) / 2e-6, atol=0.02 * np.abs(gradient).max())
    np.testing.assert_allclose(information, information.transpose(0, 2, 1), atol=1e-9)

    drawn = start.drawn(rng, 20_000, now)
    mode = start.mode(now)
    # of 20,000 draws the mean is off by 1 % of the standard deviation, the variance by 1 %
    np.testing.assert_allclose(drawn[:, :2].mean(axis=0), mode.pose[:2], atol=0.03)
    np.testing.assert_allclose(np.cov(drawn[:, :2].T), mode.covariance[:2, :2], atol=0.03)
    spread = np.cov((se2.compose(drawn, se2.inverse(moved.delta))[:, :2] - position).T)
    assert spread.trace() > covariance.trace()


@pytest.fixture(scope="module")
def drive():
    return simulate(seconds=20.0)


def test_a_lost_track_is_ambiguous_until_its_place_is_found(drive):
    """The new place is told by one landmark for a while: seen well enough to doubt the old one, not to find the new one."""
    elsewhere = cut(simulate(seed=3, seconds=45.0), 25.0, 45.0)
    s = elsewhere.streams["bearing_range"]
    alone = with_sightings(elsewhere, (np.array(s.landmark) == s.landmark[0]) | (s.t > 33.0))
    carried = join(cut(drive, 0.0, 10.0), alone)
    result = run(carried, RunConfig("smoother"))
    status = np.array(result.status)
    (t,) = [event.t for event in result.diagnostics.events]
    assert 18.0 < t < 22.0
    assert np.all(status[(result.t > 13.0) & (result.t < t)] == "ambiguous")
    assert np.all(status[result.t > t + 0.1] == "localized")
    final = errors(result.final, carried.reference)
    assert np.nanmax(final.position[final.t > t]) < 0.2


@pytest.mark.parametrize("name", ["smoother", "batch"])
def test_one_landmark_does_not_tell_the_place(name, drive):
    """The start stays open, and everything is still there when the others come."""
    s = drive.streams["bearing_range"]
    lone = with_sightings(drive, np.array(s.landmark) == "b")
    result = run(cut(lone, 0.0, 8.0), RunConfig(name, prior="unknown"))
    assert result.diagnostics.events == []
    assert len(result.final) == 0
    assert "localized" not in result.status
    assert result.causal() is None
    (warning,) = result.warnings
    assert warning.kind == "never_localized"
    if name != "batch":
        ambiguous = np.array(result.status) == "ambiguous"
        assert result.status == ("unlocalized",) * int(np.argmax(ambiguous)) + ("ambiguous",) * int(ambiguous.sum())
        assert np.all(np.isfinite(result.poses[ambiguous]))
        distance_of_b = np.hypot(*(result.poses[ambiguous, :2] - drive.world.position("b")).T)
        truth = np.hypot(*(drive.reference.at(result.t[ambiguous])[:, :2] - drive.world.position("b")).T)
        assert np.abs(distance_of_b - truth).max() < 0.5

    late = with_sightings(drive, (np.array(s.landmark) == "b") | (s.t > 8.0))
    result = run(late, RunConfig(name, prior="unknown"))
    assert result.final.t[0] < 0.3
    assert errors(result.final, drive.reference).position.max() < 0.3


def test_landmarks_that_are_to_be_estimated_cannot_tell_the_place(drive):
    with pytest.raises(InputError, match="cannot start from an unknown pose"):
        run(drive, RunConfig("smoother", {"landmarks": "unknown"}, prior="unknown"))


DURATION = 80.0


def office(faults: Mapping[str, Any] | None = None, seed: int = 1, **changes: Any) -> Log:
    settings = {"drive": {"duration": DURATION}, "faults": dict(faults or {}), **changes}
    return simulated(preset("office", settings), seed)


def test_landmarks_of_a_track_that_was_lost_are_forgotten() -> None:
    """The odometry jumps by 8 m; tags tell it once, and landmarks that were put to where they seemed to be do not lead back."""
    seen = {"max_range": 6.0, "rate": 5.0}
    log = office({}, 3, drive={"duration": 26.0}, world={"tags": 60, "landmarks": 30}, sightings=seen)
    odometry = log.streams["odometry"]
    assert isinstance(odometry, IncrementStream)
    way = odometry.dx + 8.0 * (np.arange(len(odometry.t)) == np.searchsorted(odometry.t, 20.0))
    carried = replace(log, streams={**log.streams, "odometry": replace(odometry, dx=way)})
    sensors = ("odometry", "rfid", "bearing_range")
    result = run(carried, RunConfig("smoother", {"landmarks": "unknown"}, sensors=sensors))
    (lost,) = [event for event in result.diagnostics.events if event.kind == "lost"]
    assert abs(lost.fields["since"] - 20.0) < 0.05
    assert score(result, log)["final.position_rmse"] < 0.15


def test_a_robot_that_is_carried_far() -> None:
    """The way that it is carried tells nothing of the odometry's constants, and these nothing of that way."""
    hall = {"world": {"width": 60.0, "depth": 36.0, "tags": 180}, "drive": {"duration": 20.0}}
    world = preset("warehouse", hall).model_copy(update={"world_seed": 1})
    carried = join(cut(simulated(world, 10), 0.0, 12.0), cut(simulated(world, 11), 0.0, 14.0))
    result = run(carried, RunConfig("smoother"))
    (lost,) = result.diagnostics.events
    assert lost.kind == "lost"
    causal = errors(result.causal(), carried.reference)
    assert np.nanmax(causal.position[causal.t > lost.t]) < 0.6
    assert np.nanmax(errors(result.final, carried.reference).position) < 0.5


def test_belief_while_it_seeks_has_particles_that_move_with_the_odometry() -> None:
    log = office()
    sensors = ("odometry", "rfid")
    smoother = made("smoother", log.rig, log.world, sensors, 1)
    assert smoother.belief().particles is None
    scans = 0
    for m in log.measurements(sensors):
        smoother.process(m)
        scans += isinstance(m, RfidScan)
        if scans == 2:
            break
    end = m.t + 2.0
    smoother.process(IncrementOdometry(end, 0.0, 0.0, 0.0))
    for t in np.arange(m.t + 0.1, end + 0.05, 0.1):  # the search goes on in slices
        smoother.process(Tick(t))
    first = smoother.belief()
    assert first.particles is not None
    assert first.weights is not None
    assert np.isclose(first.weights.sum(), 1.0)
    middle = first.modes[0].pose
    near = np.hypot(*(first.particles - middle)[:, :2].T) < 3.0
    assert first.weights[near].sum() > 0.3 * first.modes[0].weight
    smoother.process(IncrementOdometry(end + 0.4, 0.2, 0.0, 0.0))
    smoother.process(Tick(end + 0.4))
    moved = smoother.belief().particles
    assert moved is not None
    assert np.allclose(np.hypot(*(moved - first.particles)[:, :2].T), 0.2, atol=0.02)
