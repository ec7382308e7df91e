"""A small log with all kinds of sensors, and two runs of it in folders, as `fgloc run` writes them."""

import cv2
import numpy as np
import polars as pl
import pytest
from by_hand import reads
from drives import driven

from factorgraph_loc import ImageStream, IncrementStream, Log, Rig, SightingStream, Tag, Trajectory, World
from factorgraph_loc.experiments.output import write_run
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings, BearingRangeStream, Landmark
from factors import se2

T0_NS = 1_700_000_000_000_000_000
STEPS = 60  # of 0.1 s


@pytest.fixture(scope="session")
def log(tmp_path_factory):
    """A robot on an arc for 6 s; it sees two landmarks, reads two tags, one at 1.0 s, and takes three images."""
    t = np.arange(STEPS + 1) * 0.1
    steps = np.tile((0.05, 0.0, 0.01), (STEPS, 1))
    poses = driven(steps)
    marks = {"door": (2.0, 1.0), "post": (1.0, -2.0)}
    rows = [(i, name) for i in range(5, STEPS, 10) for name in marks]
    local = np.array([se2.transform_to(poses[i], np.array(marks[name])) for i, name in rows])
    bearing_range = BearingRangeStream(
        np.array([t[i] for i, _ in rows]),
        [name for _, name in rows],
        np.hypot(*local.T),
        np.arctan2(local[:, 1], local[:, 0]),
    )
    read = [(1.0, "A", 0.0), (2.0, "A", 0.2), (2.0, "B", 0.0), (3.0, "", 0.0)]
    rfid = reads(*((stamp, 0, "1", epc, age) for stamp, epc, age in read))
    folder = tmp_path_factory.mktemp("pictures")
    files = [folder / f"{i}.png" for i in range(3)]
    for i, file in enumerate(files):
        cv2.imwrite(str(file), np.full((24, 32, 3), 80 * i, dtype=np.uint8))
    sightings = SightingStream(
        np.array((0.5, 0.5, 1.5)), ["p", "q", "p"], np.array((1.0, 2.0, 3.0)), np.array((4.0, 5.0, 6.0))
    )
    return Log(
        "arc",
        Rig(
            sensors=("odometry", "bearing_range"),
            bearing_range=BearingRangeSettings(range_sigma=0.1),
            camera=CameraSettings(width=32, height=24, fx=30, fy=30, cx=16, cy=12, z=0.5),
        ),
        World(
            landmarks={name: Landmark(x=x, y=y) for name, (x, y) in marks.items()},
            tags={"A": Tag(x=0.5, y=1.0, z=1.2), "B": Tag(x=1.5, y=1.0, z=0.4)},
            walls=((-1.0, -3.0, 4.0, -3.0),),
        ),
        {
            "odometry": IncrementStream(t, *np.vstack((np.zeros(3), steps)).T),
            "bearing_range": bearing_range,
            "rfid": rfid,
            "camera": ImageStream(np.array((0.5, 1.5, 2.5)), files),
            "sightings": sightings,
        },
        Trajectory(t, poses),
        t0_ns=T0_NS,
    )


@pytest.fixture(scope="session")
def results(log, tmp_path_factory):
    """A folder as of `fgloc compare`, whose keys are the names of the estimators, with runs of the ekf and of dead reckoning."""
    out = tmp_path_factory.mktemp("results")
    for estimator in ("ekf", "dead_reckoning"):
        result = run(log, RunConfig(estimator))
        result.diagnostics.event(1.25, "jump", "a jump")
        write_run(result, log, out / "store" / estimator[:2] / estimator)
    pl.DataFrame({"key": ["dead_reckoning", "ekf"], "status": ["ok", "ok"]}).write_parquet(out / "results.parquet")
    return out
