"""Trials of unknown start and kidnapping: what counts as right, and a simulated log on which all are."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarking import trials
from benchmarking.trials import kidnapping_trials, start_trials

from factorgraph_loc.experiments.run import run
from factorgraph_loc.model.belief import Learnt
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.result import RunResult, Timings
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeStream
from factorgraph_loc.sensors.landmarks.settings import BearingRangeSettings, Landmark
from factorgraph_loc.sensors.odometry.measurement import VelocityStream
from factorgraph_loc.sensors.odometry.settings import GrowthSettings, OdometryNoise, OdometrySettings
from factors import se2
from factors.landmarks import model as bearing_range

CIRCLE = {"a": (4.0, 0.5), "b": (0.3, 4.2), "c": (-3.8, -0.4), "d": (-0.2, -4.5), "e": (3.0, 3.4)}


@pytest.fixture(scope="module")
def circle():
    """A minute on a circle of 2 m, of which half a minute is 4.5 rad; five landmarks seen twice a second with little noise."""
    rng = np.random.default_rng(1)
    t = np.arange(1201) * 0.05
    v, w = np.full(1201, 0.3), np.full(1201, 0.15)
    heading = w * t
    truth = Trajectory(t, np.column_stack((2.0 * np.sin(heading), -2.0 * np.cos(heading), se2.wrap(heading))))
    rig = Rig(
        odometry=OdometrySettings(
            noise=OdometryNoise(
                along=GrowthSettings(per_distance=0.02),
                lateral=GrowthSettings(per_distance=0.02),
                heading=GrowthSettings(per_distance=0.02),
            )
        ),
        bearing_range=BearingRangeSettings(range_sigma=0.1, bearing_sigma=0.03),
    )
    seen = np.arange(0.02, 60.0, 0.5)
    ranges, bearings = bearing_range.predict(
        rig.bearing_range.model(), truth.at(seen)[:, None], np.array(list(CIRCLE.values()))
    )
    stream = BearingRangeStream(
        np.repeat(seen, len(CIRCLE)),
        list(CIRCLE) * len(seen),
        (ranges + 0.1 * rng.standard_normal(ranges.shape)).ravel(),
        se2.wrap(bearings + 0.03 * rng.standard_normal(bearings.shape)).ravel(),
    )
    world = World(landmarks={name: Landmark(x=x, y=y) for name, (x, y) in CIRCLE.items()})
    return Log("circle", rig, world, {"odometry": VelocityStream(t, v, w), "bearing_range": stream}, truth)


def result_of(t, poses, status):
    return RunResult(
        log="straight",
        config={},
        t=t,
        poses=poses,
        covariances=np.tile(np.eye(3), (len(t), 1, 1)),
        status=status,
        final=Trajectory(t, poses),
        diagnostics=Diagnostics(),
        learnt=Learnt(),
        timings=Timings(np.empty(0), np.empty(0), 1.0, 1.0, 0.0, 1.0),
        versions={},
    )


def test_right_is_near_in_position_and_heading(log):
    """The reference of the log lies on the x axis, from 0 s to 2 s."""
    t = np.arange(5) * 0.5
    poses = log.reference.at(t) + np.array(
        ((0.0, 0.0, 0.0), (0.3, 0.39, 0.0), (0.3, 0.41, 0.0), (0.0, 0.0, 0.25), (0.0, 0.0, -0.27))
    )
    right = trials.is_right(result_of(t, poses, ("localized",) * 5), log)
    assert right.tolist() == [True, True, False, True, False]
    poses[0] = np.nan  # no estimate yet
    assert not trials.is_right(result_of(t, poses, ("localized",) * 5), log)[0]
    positions_only = replace(log, reference=replace(log.reference, has_heading=False))
    assert trials.is_right(result_of(t, poses, ("localized",) * 5), positions_only).tolist() == [
        False,
        True,
        False,
        True,
        True,
    ]


def test_in_a_gap_of_the_reference_the_one_before_counts_and_at_the_beginning_the_next(log):
    t = np.arange(20) * 0.1
    poses = log.reference.at(t)
    poses[[3, 12]] += 2.0
    known = ((log.reference.t > 0.25) & (log.reference.t < 0.65)) | (log.reference.t > 1.15)
    gappy = replace(log, reference=replace(log.reference, t=log.reference.t[known], poses=log.reference.poses[known]))
    right = trials.is_right(result_of(t, poses, ("localized",) * 20), gappy)
    # 0 to 0.2 s are judged by 0.3 s, which is wrong; 0.7 to 1.1 s by 0.6 s, which is right
    assert np.flatnonzero(~right).tolist() == [0, 1, 2, 3, 12]
    never = replace(log, reference=replace(log.reference, t=log.reference.t + 100.0))
    assert not trials.is_right(result_of(t, poses, ("localized",) * 20), never).any()


def test_it_must_stay_right_for_ten_seconds():
    t = np.arange(300) * 0.1
    right = np.ones(300, dtype=bool)
    right[150] = False  # at 15 s
    for first, holds in ((0, True), (49, True), (50, False), (150, False), (151, True), (299, True)):
        assert trials._holds(t, right, first) is holds


def test_the_third_landmark_of_the_map(log):
    assert trials._third_landmark(log, 0.0) == log.span()[1]  # it has two
    s = log.streams["bearing_range"]
    stream = replace(s, landmark=["a", "ghost", "a", "b", "b", "c", "a", "c"])
    landmarks = {**log.world.landmarks, "c": Landmark(x=0.0, y=0.0)}
    three = replace(log, world=World(landmarks=landmarks), streams={**log.streams, "bearing_range": stream})
    assert trials._third_landmark(three, 0.0) == s.t[5]
    assert trials._third_landmark(three, float(s.t[6])) == log.span()[1]
    assert trials._last_start(log) == log.span()[0]
    assert trials._last_start(three) == s.t[4]


@pytest.mark.parametrize(("estimator", "settings"), [("smoother", None), ("particle_filter", {"particles": 500})])
def test_all_starts_are_right_where_all_landmarks_are_seen(circle, estimator, settings):
    found = start_trials(circle, estimator, 3, settings)
    last = trials._last_start(circle)
    assert 55.0 < last < 60.0
    assert [trial.t for trial in found] == pytest.approx([0.0, last / 3.0, 2.0 * last / 3.0])
    assert sum(trial.right for trial in found) == 3
    assert not any(trial.false for trial in found)
    assert max(trial.seconds for trial in found) < 5.0


def test_all_kidnappings_are_recovered_from_where_all_landmarks_are_seen(circle):
    found = kidnapping_trials(circle, "smoother", 2, {"lag": 10.0})
    assert sum(trial.right for trial in found) == 2
    assert not any(trial.false for trial in found)
    assert max(trial.seconds for trial in found) < 8.0


def test_what_never_finds_its_place_is_neither_right_nor_false(circle):
    s = circle.streams["bearing_range"]
    lost = replace(circle, streams={**circle.streams, "bearing_range": replace(s, landmark=["ghost"] * len(s.t))})
    for trial in start_trials(lost, "smoother", 2):
        assert (trial.right, trial.false) == (False, False)
        assert np.isnan(trial.seconds)
    (kidnapped,) = kidnapping_trials(lost, "dead_reckoning", 1)
    assert not kidnapped.right
    assert np.isnan(kidnapped.seconds)


def test_a_wrong_claim_is_false(circle, monkeypatch):
    """The estimates of a run, turned by half a turn."""

    def elsewhere(log, config):
        result = run(log, config)
        return replace(result, poses=result.poses * np.array((-1.0, -1.0, 1.0)))

    monkeypatch.setattr(trials, "run", elsewhere)
    (start,) = start_trials(circle, "smoother", 1)
    assert (start.right, start.false) == (False, True)
    assert start.seconds < 5.0
    monkeypatch.setattr(trials, "RECOVERY_TIME", 5.0)
    (kidnapped,) = kidnapping_trials(circle, "smoother", 1)
    assert (kidnapped.right, kidnapped.false) == (False, True)
