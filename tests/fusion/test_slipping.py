"""Wheels that turn while the robot stands, as at a wall, in view of four radio anchors; and an anchor that is blocked."""

import numpy as np
import pytest
from drives import driven

import factorgraph_loc as fgloc
from factorgraph_loc import BearingRangeStream, Landmark, Log, Rig, Trajectory, VelocityStream, World
from factorgraph_loc.evaluation.metrics import errors
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings
from factors import se2

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
