"""Every estimator on a simulated run with what goes wrong on real ones."""

from dataclasses import replace
from functools import cache

import camera_world
import numpy as np
import pytest
from changed_logs import rows
from drives import driven, even_noise
from landmark_world import simulate, with_sightings

import factorgraph_loc as fgloc
from factorgraph_loc import BearingRangeStream, Landmark, Log, Rig, Trajectory, VelocityStream, World, load
from factorgraph_loc.evaluation.metrics import errors, score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings
from factorgraph_loc.sensors.odometry.settings import OdometryNoise, OdometrySettings
from factors import se2

CONFIGS = {
    "ekf": RunConfig("ekf"),
    "particle_filter": RunConfig("particle_filter", {"particles": 500}),
    "smoother": RunConfig("smoother"),
    "smoother_lag": RunConfig("smoother", {"lag": 5.0}),
    "batch": RunConfig("batch"),
}
DEAD_RECKONING = RunConfig("dead_reckoning")
EXACT = ("ekf", "smoother", "smoother_lag", "batch")  # no random numbers


@pytest.fixture(scope="module")
def log():
    return simulate(seconds=30.0)


@pytest.fixture(scope="module")
def clean(log):
    """``clean(name)``: the result on the undisturbed log, computed once."""
    return cache(lambda name: run(log, DEAD_RECKONING if name == "dead_reckoning" else CONFIGS[name]))


def distance(a, b):
    """Largest distance [m] between two trajectories or results."""
    return np.hypot(*(a.poses - b.poses)[:, :2].T).max()


@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize("how", ["not asked for", "no rows"])
def test_no_landmarks_is_dead_reckoning(name, how, log, clean):
    if how == "no rows":
        blind = with_sightings(log, t=np.empty(0), landmark=[], range=np.empty(0), bearing=np.empty(0))
        result = run(blind, CONFIGS[name])
    else:
        result = run(log, replace(CONFIGS[name], sensors=("odometry",)))
    expected = clean("dead_reckoning")
    n = len(result.t)
    assert n > 290
    np.testing.assert_allclose(se2.between(expected.poses[:n], result.poses), 0.0, atol=1e-6)
    np.testing.assert_allclose(se2.between(expected.final.poses[:n], result.final.poses), 0.0, atol=1e-6)


@pytest.fixture(scope="module")
def frequent():
    return simulate(rate=8.0, seconds=15.0)


@pytest.mark.parametrize("name", EXACT)
def test_too_late_rows_are_dropped(name, frequent):
    """All rows of every tenth stamp arrive 1 s late."""
    stream = frequent.streams["bearing_range"]
    stamps = np.unique(stream.t)
    chosen = stamps[:-20:10]
    slow = np.isin(stream.t, chosen)
    arrived = np.argsort(stream.t + slow, kind="stable")
    result = run(rows(frequent, "bearing_range", arrived), CONFIGS[name])
    assert result.diagnostics.late == {"bearing_range": int(slow.sum())}
    expected = run(with_sightings(frequent, ~slow), CONFIGS[name])
    assert distance(result, expected) < 1e-9
    assert distance(result.final, expected.final) < 1e-9


@pytest.mark.parametrize("name", ["ekf", "smoother"])
def test_neither_range_nor_bearing_is_ignored(name, log):
    stream = log.streams["bearing_range"]
    empty = np.arange(len(stream.t)) % 7 == 3
    holed = with_sightings(
        log, range=np.where(empty, np.nan, stream.range), bearing=np.where(empty, np.nan, stream.bearing)
    )
    result = run(holed, CONFIGS[name])
    expected = run(with_sightings(log, ~empty), CONFIGS[name])
    assert sum(result.diagnostics.ignored.values()) == empty.sum()
    assert distance(result.final, expected.final) == 0.0


PERFECT = even_noise()
DRIVEN = 30.0  # s


def wheels(noise, stood):
    """Half a minute at 0.4 m/s, then at rest for ``stood`` seconds; nothing but wheels."""
    t = np.arange(0.0, DRIVEN + stood, 0.1)
    moves = t < DRIVEN
    stream = VelocityStream(t, np.where(moves, 0.4, 0.0), np.where(moves, 0.05, 0.0))
    rig = Rig(sensors=("odometry",), odometry=OdometrySettings(noise=noise))
    return Log("wheels", rig, World(), {"odometry": stream}, None)


@pytest.mark.parametrize(
    ("estimator", "noise"),
    [
        ("dead_reckoning", OdometryNoise()),
        ("ekf", PERFECT),
        ("smoother", PERFECT),
        ("batch", OdometryNoise()),
        ("smoother", camera_world.NOISE),
        ("particle_filter", PERFECT),
    ],
)
def test_a_robot_at_rest_is_estimated_and_hardly_diffuses(estimator, noise):
    result = run(wheels(noise, stood=20.0), RunConfig(estimator, prior="0,0,0"))
    sigmas = np.sqrt(np.diagonal(result.final.covariances, axis1=1, axis2=2))
    assert np.all(np.isfinite(sigmas))
    assert np.all(sigmas > 0.0)
    if estimator != "particle_filter":  # whose covariances are those of samples
        stopped = result.final.t > DRIVEN + 0.2
        grown = sigmas[stopped][-1] ** 2 - sigmas[stopped][0] ** 2
        # far below a millimetre and a milliradian a second, squared and added up
        np.testing.assert_array_less(np.abs(grown), 20.0 * 1.5e-6)


ANCHORS = {"a": (0.0, 0.0), "b": (12.0, 0.0), "c": (12.0, 8.0), "d": (0.0, 8.0)}
STEP, SPEED, SIGMA = 0.05, 0.5, 0.1  # s, m/s, m
BEGIN, END = 10.0, 16.0  # s of the disturbance


def drive(*, slips=False, blocked=False):
    """A circle of 25 s; ranges to the anchors in turn, ten a second."""
    rng = np.random.default_rng(3)
    t = np.arange(0.0, 25.0, STEP)
    stands = slips & (t >= BEGIN) & (t < END)
    moves = np.where(stands[:, None], 0.0, (SPEED * STEP, 0.0, 0.2 * STEP))
    poses, seen = driven(se2.exp(moves[:-1]), (4.0, 2.0, 0.3)), np.arange(0, len(t), 2)
    names = [list(ANCHORS)[i % len(ANCHORS)] for i in range(len(seen))]
    ranges = np.hypot(*(poses[seen, :2] - [ANCHORS[name] for name in names]).T) + rng.normal(0.0, SIGMA, len(seen))
    if blocked:
        ranges += 1.2 * (np.array(names) == "c") * (t[seen] >= BEGIN) * (t[seen] < END)
    wheels = SPEED + rng.normal(0.0, 0.01, len(t)), 0.2 + rng.normal(0.0, 0.01, len(t))
    streams = {
        "odometry": VelocityStream(t, *wheels),
        "bearing_range": BearingRangeStream(t[seen], names, ranges, np.full(len(seen), np.nan)),
    }
    world = World(landmarks={name: Landmark(x=x, y=y) for name, (x, y) in ANCHORS.items()})
    rig = Rig(bearing_range=BearingRangeSettings(range_sigma=SIGMA))
    return Log("wall", rig, world, streams, Trajectory(t, poses))


def off(log, estimator):
    """Errors of the causal estimates, and the events."""
    result = fgloc.run(log, estimator).result
    return errors(result.causal(), log.reference), result.diagnostics.events


@pytest.mark.parametrize("estimator", ["ekf", "smoother", "particle_filter"])
def test_ranges_that_agree_overrule_wheels_that_slip(estimator):
    slipped, events = off(drive(slips=True), estimator)
    assert slipped.position.max() < 0.8  # the wheels report 3 m
    assert slipped.position[slipped.t > END + 5.0].max() < 0.2
    assert any(event.kind == "slip" for event in events)


@pytest.mark.parametrize("estimator", ["ekf", "smoother", "particle_filter"])
def test_one_blocked_anchor_of_four_is_no_slip(estimator):
    (blocked, events), (right, _) = off(drive(blocked=True), estimator), off(drive(), estimator)
    assert blocked.position.max() < right.position.max() + 0.1
    assert not events


def test_a_late_measurement_is_compared_as_if_it_had_been_in_time():
    log = drive(slips=True)
    in_time, late = fgloc.Localizer(log.rig, log.world, "ekf"), fgloc.Localizer(log.rig, log.world, "ekf")
    rows = list(log.measurements(("odometry", "bearing_range")))
    swapped = list(rows)
    for i in range(300, len(rows) - 1, 7):
        swapped[i], swapped[i + 1] = swapped[i + 1], swapped[i]
    for localizer, measurements in ((in_time, rows), (late, swapped)):
        localizer.initialize(log.reference.poses[0], t=0.0)
        for m in measurements:
            localizer.push(m)
    np.testing.assert_allclose(late.estimate().pose, in_time.estimate().pose, atol=0.05)


def test_plaza2_is_as_accurate_as_the_reference_implementation():
    """0.333 m, 0.028 rad causal for an EKF; 0.259 m, 0.017 rad final for iSAM2; within 10 %."""
    (plaza2,) = load("plaza2")
    ekf, smoother, batch = (score(run(plaza2, RunConfig(name)), plaza2) for name in ("ekf", "smoother", "batch"))
    assert ekf["causal.position_rmse"] < 1.1 * 0.333
    assert ekf["causal.heading_rmse"] < 1.1 * 0.028
    assert smoother["final.position_rmse"] < 1.1 * 0.259
    assert smoother["final.heading_rmse"] < 1.1 * 0.017
    assert smoother["final.position_rmse"] == pytest.approx(batch["final.position_rmse"], rel=0.02)
