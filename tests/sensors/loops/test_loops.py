"""Loops of other programs: their tables, and what estimators make of them where most are false."""

from dataclasses import replace

import numpy as np
import pytest
from drives import driven, even_noise
from mapped_hall import VELOCITIES, write_mapped

from factorgraph_loc import InputError, Log, Rig, Trajectory, VelocityStream, World, load, write_native
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.sensors.loops.measurement import Loops, LoopSettings, LoopStream
from factorgraph_loc.sensors.odometry.settings import OdometrySettings
from factorgraph_loc.sensors.tables import checked
from factors import se2

SIDE, SPEED, STEP, ROUNDS = 12.0, 0.5, 0.5, 3  # m, m/s, s
RIG = Rig(
    sensors=("odometry", "loops"),
    odometry=OdometrySettings(noise=even_noise(per_time=0.01)),
    loops=LoopSettings(sigma_place=0.3),
)


def drive(with_pose=False):
    """Rounds of a square, with loops of which six in ten join places that are not the same."""
    rng, false = np.random.default_rng(3), 0.6
    quarter = 2.0
    w = np.pi / 2.0 / quarter
    one_side = [(SPEED, 0.0)] * round(SIDE / SPEED / STEP) + [(0.0, w)] * round(quarter / STEP)
    speeds = np.array(one_side * 4 * ROUNDS)
    truth = driven(se2.exp(STEP * np.insert(speeds, 1, 0.0, axis=1)))
    t = STEP * np.arange(len(truth))
    measured = speeds + rng.normal(size=speeds.shape) * (0.01 / np.sqrt(STEP))
    measured = np.vstack((measured, np.zeros(2)))
    lap = len(one_side) * 4
    rows = []
    for i in range(lap, len(t), 4):
        rows.append((i, i - lap))
        rows += [(i, int(rng.integers(0, i))) for _ in range(round(false / (1.0 - false)))]
    later, earlier = np.array(rows).T
    told = se2.between(truth[earlier], truth[later]) + rng.normal(size=(len(rows), 3)) * (0.1, 0.1, 0.02)
    if with_pose:  # what is false looks as if it were seen from near
        wrong = later - earlier != lap
        told[wrong] = rng.normal(size=(int(wrong.sum()), 3)) * (0.3, 0.3, 0.2)
    else:
        told[:] = np.nan
    x, y, heading = np.ascontiguousarray(told.T)
    score = np.full(len(rows), np.nan)
    loops = LoopStream(t[later], t[later] - t[earlier], x, y, heading, score)
    streams = {"odometry": VelocityStream(t, *np.ascontiguousarray(measured.T)), "loops": loops}
    return Log("square", RIG, World(), streams, Trajectory(t, truth), t0_ns=10**18)


def final_error(log, estimator, **settings):
    found = run(log, RunConfig(estimator, settings, prior="0,0,0"))
    return score(found, log)["final.position_rmse"], found


def right_ones(log):
    loops = log.streams["loops"]
    here, there = (log.reference.at(np.round(at, 6)) for at in (loops.t, loops.t - loops.age))
    keep = np.hypot(*(here - there)[:, :2].T) < 0.1
    columns = {name: getattr(loops, name)[keep] for name in ("t", "age", "x", "y", "heading", "score")}
    return replace(log, streams=dict(log.streams) | {"loops": LoopStream(**columns)})


@pytest.mark.parametrize(("estimator", "with_pose"), [("smoother", False), ("batch", True)])
def test_false_loops_do_no_harm(estimator, with_pose):
    log = drive(with_pose=with_pose)
    alone, _ = final_error(replace(log, rig=RIG.model_copy(update={"sensors": ("odometry",)})), estimator)
    best, _ = final_error(right_ones(log), estimator)
    found, _ = final_error(log, estimator)
    assert best < 0.4 * alone
    assert found < 1.2 * best


def test_filters_and_a_window_count_what_they_cannot_use():
    log = drive()
    count = len(log.streams["loops"].t)
    for estimator, settings in (("ekf", {}), ("particle_filter", {"particles": 50}), ("smoother", {"lag": 5.0})):
        ignored = final_error(log, estimator, **settings)[1].diagnostics.ignored["loops: the earlier pose is not kept"]
        assert ignored > (0.9 * count if estimator == "smoother" else count - 1)


def test_scores_below_the_rigs_are_not_used():
    log = drive()
    loops = replace(log.streams["loops"], score=np.full(len(log.streams["loops"].t), 0.2))
    log = replace(
        log,
        rig=log.rig.model_copy(update={"loops": LoopSettings(least_score=0.3)}),
        streams=dict(log.streams) | {"loops": loops},
    )
    found = final_error(log, "smoother")[1]
    assert found.diagnostics.ignored == {"loops: lower score than the rig's least_score": len(loops.t)}


@pytest.mark.parametrize("format", ["csv", "parquet"])
def test_a_log_with_loops_is_read_as_it_was_written(tmp_path, format):
    log = drive(with_pose=True)
    write_native(log, tmp_path / "log", format)
    read, written = load(tmp_path / "log")[0].streams["loops"], log.streams["loops"]
    for name in ("t", "age", "x", "y", "heading", "score"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name))


def folder_with(tmp_path, text):
    write_native(replace(drive(), streams={"odometry": drive().streams["odometry"]}), tmp_path / "log")
    (tmp_path / "log/loops.csv").write_text(text)
    return tmp_path / "log"


def test_a_table_with_two_stamps(tmp_path):
    t = 10**18
    folder = folder_with(tmp_path, f"t_ns,before_ns\n{t + 5 * 10**9},{t + 2 * 10**9}\n{t + 5 * 10**9},{t + 10**9}\n")
    loops = load(folder)[0].streams["loops"]
    np.testing.assert_allclose(loops.t, (5.0, 5.0))
    np.testing.assert_allclose(loops.age, (3.0, 4.0))
    assert np.isnan(loops.x).all()
    assert np.isnan(loops.score).all()


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("t_ns,before_ns\n1000000005000000000,1000000006000000000\n", "before_ns"),
        ("t_ns,age,x,y,heading\n1000000005000000000,2.0,1.0,,0.0\n", "x, y and heading, or none"),
        ("t_ns,age,score\n1000000005000000000,2.0,1.5\n", "score"),
        ("t_ns,age\n1000000005000000000,-2.0\n", "age"),
    ],
)
def test_a_row_that_is_no_loop_is_named(tmp_path, rows, message):
    with pytest.raises(InputError, match=message):
        load(folder_with(tmp_path, rows))


FOUND = """
[options.loops]
file = "found.csv"
header = false
separator = " "
columns = { t = "2", before_ns = "3", score = "4" }
units = { t = "s", before_ns = "s" }
where = { 1 = "loop" }
clock_offset = -100.0
"""


def test_a_mapped_table_with_two_stamps_in_seconds_and_another_clock(tmp_path):
    rows = "loop 105.0 102.5 0.8\nother 1 2 3\nloop 108.0 101.0 0.4\n"
    wheels = "t,v,w\n0.0,0.5,0.0\n9.0,0.0,0.0\n"
    manifest = write_mapped(tmp_path, VELOCITIES + FOUND, wheels=wheels, found=rows)
    loops = load(manifest, data_root=tmp_path)[0].streams["loops"]
    np.testing.assert_allclose(loops.t, (5.0, 8.0))
    np.testing.assert_allclose(loops.age, (2.5, 7.0))
    np.testing.assert_allclose(loops.score, (0.8, 0.4))


def test_pushed_loops_are_checked():
    one = np.ones(1)
    assert checked(Loops(1.0, one, np.nan * one, np.nan * one, np.nan * one, one)).count == 1
    with pytest.raises(InputError, match="the relative pose of a loop is incomplete"):
        checked(Loops(1.0, one, one, np.nan * one, one, one))
    with pytest.raises(InputError, match="score"):
        checked(Loops(1.0, one, one, one, one, 2.0 * one))
