"""Live localization: the same as a run of a log, whoever pushes; bounded in memory; and what it cannot use is counted."""

import gc
import math
import threading
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from by_hand import started

import factorgraph_loc as fgloc
from factorgraph_loc import (
    BearingRange,
    IncrementOdometry,
    InputError,
    RfidRead,
    Rig,
    RunFailedError,
    VelocityOdometry,
    YawRate,
    scan_of,
)
from factorgraph_loc.experiments.preparation import resolve_prior
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.ekf import Ekf
from factorgraph_loc.model.log import cut
from factorgraph_loc.model.measurement import columns_of
from factorgraph_loc.sensors.odometry.measurement import IncrementStream
from factors import se2

SENSORS = ("odometry", "rfid", "bearing_range")


@pytest.fixture(scope="module")
def log():
    """A drive through an office, in which not each tag of the map is read; the last measurement comes after the last tick."""
    changes = {"drive": {"duration": 20.0}, "world": {"tags": 12, "landmarks": 6}}
    log = fgloc.simulate("office", 3, changes=changes)
    streams = cut(log, 0.0, 19.97).streams
    columns = {k: np.append(v, 19.97 if k == "t" else 0.0) for k, v in columns_of(streams["odometry"]).items()}
    return replace(log, streams={**streams, "odometry": replace(streams["odometry"], **columns)})


@pytest.mark.parametrize(
    ("name", "sensors", "settings", "prior"),
    [
        ("smoother", ("odometry", "rfid"), {"lag": 8.0}, None),
        ("smoother", ("odometry", "bearing_range"), {"lag": 5.0}, None),
        ("smoother", ("odometry", "rfid"), {}, "unknown"),
        ("ekf", ("odometry", "bearing_range"), {}, None),
        ("ekf", ("odometry", "bearing_range"), {}, "position"),
        ("particle_filter", ("odometry", "rfid"), {"particles": 500}, None),
        ("switching", SENSORS, {"particles": 500}, None),
        ("batch", ("odometry", "bearing_range"), {}, None),
    ],
)
def test_estimates_are_those_of_a_run(log, name, sensors, settings, prior):
    lag = {"lag": 10.0} if name == "smoother" else {}
    if prior == "position":
        x, y, _ = log.reference.poses[0].tolist()
        prior = f"{x},{y}"
    expected = run(log, RunConfig(name, lag | settings, sensors, prior))
    localizer = started(log, name, prior, settings=settings, sensors=sensors)
    ticks, found = iter([*expected.t, math.inf]), []
    tick = next(ticks)
    for m in log.measurements(sensors):
        while tick < m.t:
            found.append(localizer.estimate(tick))
            tick = next(ticks)
        localizer.push(m)
    while tick < math.inf:
        found.append(localizer.estimate(tick))
        tick = next(ticks)
    assert [e.t for e in found] == expected.t.tolist()
    assert tuple(e.status for e in found) == expected.status
    assert np.array_equal([e.pose for e in found], expected.poses, equal_nan=True)
    assert np.array_equal([e.covariance for e in found], expected.covariances, equal_nan=True)
    assert np.array_equal(localizer.trajectory().t, expected.final.t)
    assert np.array_equal(localizer.trajectory().poses, expected.final.poses)
    assert localizer.diagnostics().doubted == expected.diagnostics.doubted


def test_many_threads_push_while_others_pull(log):
    localizer = started(log, sensors=SENSORS, settings={"max_delay": 2.0})
    reference, failed, pulled = log.reference, [], []
    done = threading.Event()
    # who is ahead waits for the others, as sensors would by themselves
    steps = np.arange(0.0, log.span()[1] + 0.5, 0.5)
    barrier = threading.Barrier(len(SENSORS), timeout=60.0)

    def push(sensor):
        try:
            rows = iter([*log.streams[sensor].measurements(0.0), None])
            m = next(rows)
            for end in steps:
                barrier.wait()
                while m is not None and m.t <= end:
                    localizer.push(m)
                    m = next(rows)
        except Exception as error:  # told below, in the thread of the test
            failed.append(error)
            barrier.abort()

    def pull():
        try:
            while not done.is_set():
                pulled.append(localizer.estimate())
                localizer.belief()
                localizer.diagnostics()
                done.wait(0.002)
        except Exception as error:
            failed.append(error)

    pushers = [threading.Thread(target=push, args=(sensor,)) for sensor in SENSORS]
    pullers = [threading.Thread(target=pull) for _ in range(2)]
    for thread in (*pushers, *pullers):
        thread.start()
    for thread in pushers:
        thread.join(60.0)
    done.set()
    for thread in pullers:
        thread.join(60.0)
    assert not failed
    assert len(pulled) > 20
    last = localizer.estimate()
    assert localizer.diagnostics().late == {}
    truth = reference.poses[np.searchsorted(reference.t, last.t) - 1]
    assert np.hypot(*(last.pose - truth)[:2]) < 0.3
    # a puller's estimates never go back in time, but those of two of them are mixed here
    assert all(np.isfinite(e.pose).all() for e in pulled if e.status != "unlocalized")


@pytest.mark.parametrize(
    ("name", "sensors", "settings"),
    [
        ("smoother", ("odometry", "bearing_range"), {"lag": 3.0}),
        ("ekf", ("odometry", "bearing_range"), {}),
        ("particle_filter", ("odometry", "bearing_range"), {"particles": 25}),
    ],
)
def test_memory_does_not_grow_with_the_drive(log, monkeypatch, name, sensors, settings):
    """Eight rounds of a circle, 20 s each: as much is kept after the last one as after the fourth."""
    monkeypatch.setattr("factorgraph_loc.live.localizer.ROWS_KEPT", 50)
    localizer = fgloc.Localizer(log.rig, log.world, name, sensors=sensors, settings=settings, history=10.0)
    pose, landmarks = np.array((2.0, 2.0, 0.0)), tuple(log.world.landmarks)[:3]
    places = np.array([log.world.position(landmark) for landmark in landmarks])
    step = np.array((0.5, 0.0, 2.0 * math.pi / 20.0))
    localizer.initialize(pose, t=0.0)
    kept = []
    gc.freeze()  # what was there is not searched each time
    tracemalloc.start()
    try:
        for t in range(1, 161):
            pose = se2.compose(pose, step)
            localizer.push(IncrementOdometry(t, *step))
            off = places - pose[:2]
            bearing = se2.wrap(np.arctan2(off[:, 1], off[:, 0]) - pose[2])
            localizer.push(BearingRange(t, landmarks, np.hypot(*off.T), bearing))
            localizer.estimate()
            if t % 80 == 0:
                gc.collect()
                kept.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
        gc.unfreeze()
    assert kept[-1] < 1.25 * kept[0]
    assert 100 <= len(localizer.trajectory()) < 350
    assert np.hypot(*(localizer.estimate().pose - pose)[:2]) < 0.3


def test_what_is_late_is_put_in_or_counted(log):
    localizer = fgloc.Localizer(log.rig, log.world, "ekf")
    localizer.initialize((2.0, 2.0, 0.0), t=0.0)
    for i in range(21):
        localizer.push(IncrementOdometry(0.1 * i, 0.05, 0.0, 0.0))
        if i % 5 == 0:
            localizer.estimate()
    before = localizer.estimate()
    name, landmark = next(iter(log.world.landmarks.items()))
    distance, bearing = np.array((math.hypot(landmark.x - 2.75, landmark.y - 2.0) - 0.1,)), np.array((math.nan,))
    localizer.push(BearingRange(1.6, (name,), distance, bearing))
    after = localizer.estimate()
    assert after.t == before.t
    assert not np.array_equal(after.pose, before.pose)
    localizer.push(BearingRange(1.3, (name,), distance, bearing))
    assert localizer.diagnostics().late == {"bearing_range": 1}
    assert "late: 1 bearing_range" in str(localizer.diagnostics()).splitlines()
    assert np.array_equal(localizer.estimate().pose, after.pose)


def test_its_life(log):
    localizer = fgloc.Localizer(log.rig, log.world, "ekf")
    assert localizer.estimate().status == "unlocalized"
    assert math.isnan(localizer.estimate(3.0).t)
    assert len(localizer.trajectory()) == 0
    with pytest.raises(
        InputError, match=r"^VelocityOdometry at 1.000 s came before initialize\(\): call initialize\(\) first$"
    ):
        localizer.push(VelocityOdometry(1.0, 0.1, 0.0))
    localizer.initialize((1.0, 2.0, 0.5))
    assert localizer.estimate().status == "unlocalized"
    localizer.push(IncrementOdometry(100.0, 0.0, 0.0, 0.0))
    assert localizer.estimate().pose == pytest.approx((1.0, 2.0, 0.5))
    assert localizer.estimate().covariance[0, 0] == pytest.approx(0.05**2)
    localizer.push(IncrementOdometry(101.0, 1.0, 0.0, 0.0))
    assert localizer.estimate().t == 101.0
    assert localizer.estimate().pose[:2] == pytest.approx((1.0 + math.cos(0.5), 2.0 + math.sin(0.5)), abs=0.02)
    localizer.initialize((5.0, 5.0, 0.0), np.diag((0.01, 0.01, 0.01)), 50.0)
    localizer.push(IncrementOdometry(49.0, 0.5, 0.0, 0.0))
    localizer.push(BearingRange(49.5, ("l0",), np.array((1.0,)), np.array((0.0,))))
    assert localizer.estimate().status == "unlocalized"
    localizer.push(IncrementOdometry(50.0, 0.5, 0.0, 0.0))
    assert localizer.estimate().pose == pytest.approx((5.0, 5.0, 0.0))
    assert localizer.diagnostics().ignored["before the start"] == 1


def test_foreign_tags_antennas_and_sensors_are_counted(log):
    localizer = started(log, sensors=("odometry", "rfid"))
    antenna = next(iter(log.rig.rfid.all_antennas()))
    localizer.push(IncrementOdometry(0.2, 0.0, 0.0, 0.0))
    localizer.push(scan_of(0.3, [antenna], [RfidRead(antenna, "a passer-by's badge", t=0.25, rssi=-60.0)]))
    localizer.push(scan_of(0.4, ["on another robot"], []))
    localizer.push(YawRate(0.5, 0.1))
    ignored = localizer.diagnostics().ignored
    assert ignored["tag not in the map"] == 1
    assert ignored["antenna that the rig lacks"] == 1
    assert ignored["imu is not among the sensors"] == 1


def test_offsets_of_the_clocks_are_added(log):
    rig = log.rig.model_copy(update={"bearing_range": log.rig.bearing_range.model_copy(update={"time_offset": -0.2})})
    shifted, plain = started(replace(log, rig=rig), "ekf"), started(log, "ekf")
    seen = next(iter(log.streams["bearing_range"].measurements(0.0)))
    for localizer, t in ((shifted, 2.2), (plain, 2.0)):
        localizer.push(IncrementOdometry(1.9, 0.1, 0.0, 0.1))
        localizer.push(replace(seen, t=t))
    assert shifted.estimate().t == pytest.approx(2.0)
    assert shifted.estimate().pose == pytest.approx(plain.estimate().pose)


@pytest.mark.parametrize("name", ["dead_reckoning", "ekf", "smoother"])
@pytest.mark.parametrize("pulled", [False, True])
def test_increments_of_one_stamp_follow_one_another(log, name, pulled):
    localizer = fgloc.Localizer(Rig(), log.world, name)
    localizer.initialize((0.0, 0.0, 0.0), t=0.0)
    for t, dx in ((0.0, 0.0), (1.0, 1.0), (1.0, 1.0), (2.0, 1.0)):
        localizer.push(IncrementOdometry(t, dx, 0.0, 0.0))
        if pulled:
            localizer.estimate()
    assert localizer.estimate().pose == pytest.approx((3.0, 0.0, 0.0))


def test_an_estimator_that_fails_stays_lost_until_it_begins_anew(log, monkeypatch):
    localizer = started(log, "ekf", sensors=("odometry",))
    localizer.push(VelocityOdometry(0.0, 0.5, 0.0))
    known = localizer.estimate(0.5).pose

    def fail(*_):
        raise np.linalg.LinAlgError("Singular matrix")

    with monkeypatch.context() as patch:
        patch.setattr(Ekf, "process", fail)
        with pytest.raises(RunFailedError) as told:
            localizer.push(VelocityOdometry(0.05, 0.5, 0.0))
    assert str(told.value) == "ekf: tick at 0.000 s: Singular matrix"
    asked = (
        localizer.estimate,
        localizer.belief,
        localizer.trajectory,
        localizer.learnt,
        lambda: localizer.push(VelocityOdometry(0.2, 0.5, 0.0)),
    )
    for ask in asked:
        with pytest.raises(RunFailedError) as again:
            ask()
        assert str(again.value) == str(told.value)
    assert localizer.diagnostics().late == {}
    start, _ = resolve_prior(log, None)
    localizer.initialize(start.pose, start.covariance, start.t)
    localizer.push(VelocityOdometry(0.0, 0.5, 0.0))
    assert localizer.estimate(0.5).pose == pytest.approx(known)


def test_an_estimate_that_cannot_be_is_not_told_and_loses_nothing(log, monkeypatch):
    localizer = started(log, "ekf", sensors=("odometry",))
    localizer.push(VelocityOdometry(0.0, 0.5, 0.0))
    whole = Ekf.estimate

    def broken(self, t=None):
        found = whole(self, t)
        return replace(found, covariance=-found.covariance)

    with monkeypatch.context() as patch:
        patch.setattr(Ekf, "estimate", broken)
        for _ in range(2):
            with pytest.raises(
                RunFailedError, match=r"^ekf: the estimate at 0\.500 s .*the covariance is not positive"
            ):
                localizer.estimate(0.5)
    localizer.push(VelocityOdometry(0.1, 0.5, 0.0))
    assert np.all(np.isfinite(localizer.estimate(0.5).pose))


def test_a_long_pause_holds_no_ticks(log):
    localizer = started(log, "ekf", prior="0,0,0", sensors=("odometry",), history=1e6)
    stamps = np.array([0.0, 0.25, 30.0, 100.0, 3000.0, 3000.5])
    for t in stamps:
        localizer.push(IncrementOdometry(t, 0.0, 0.0, 0.0))
    odometry = IncrementStream(stamps, *np.zeros((3, len(stamps))))
    expected = run(replace(log, streams={"odometry": odometry}), RunConfig("ekf", prior="0,0,0", sensors=("odometry",)))
    assert localizer.trajectory().t.tolist() == expected.final.t.tolist()[:-1]
    assert np.diff(expected.final.t).max() > 2800.0
