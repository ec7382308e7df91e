"""A cart in a physics engine that is not ours: its wheels slip on an uneven floor, and what it films on two days is blurred.

It is no real robot. The recording is made once, by record_physics, and is read by its manifest as that of a stranger.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
from benchmarking.ensemble import run_errors
from benchmarking.report import Report
from matplotlib import pyplot as plt
from scipy.spatial.transform import Rotation

import factorgraph_loc as fgloc
from camera_benchmark.options import CameraOptions
from camera_benchmark.report import NOTHING, accuracy_cells
from factorgraph_loc.evaluation.pairing import free_map_figures
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.io.readers import load
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.result import RunResult
from factorgraph_loc.vision.feature_cache import VARIABLE

DURATION = 180.0  # s
RECORD = Path(__file__).parents[1] / "record_physics"
MONDAY, TUESDAY = "monday", "tuesday"
DRAWN_RIG, RIG = "cart.rig.toml", "learnt.rig.toml"
MAP, OWN = "monday.world.toml", "own"
OWN_MAP = f"{OWN}/map.world.toml"
WHEELS, NO_MAP = ("odometry",), {"landmarks": "unknown"}
HEADS = (
    "map",
    "drive",
    "estimator",
    "causal [m]",
    "[deg]",
    "final [m]",
    "[deg]",
    "ANEES causal / final",
    "aligned final [m]",
)


@dataclass(frozen=True)
class Job:
    """A run on the drive of a ``day``; ``rig`` and ``world`` are files of the folder, no ``world`` is no map."""

    folder: Path
    day: str
    rig: str
    world: str
    config: RunConfig

    def log(self) -> Log:
        world = self.folder / self.world if self.world else None
        (log,) = load(str(self.folder / f"{self.day}.toml"), rig=self.folder / self.rig, world=world)
        return log


def section(options: CameraOptions) -> Report:
    report = Report("physics", options)
    folder = (options.drives / "physics").resolve()
    os.environ[VARIABLE] = str(options.drives.resolve() / "features")
    if not (folder / f"{TUESDAY}.toml").exists():
        seconds = str(options.seconds(DURATION))
        subprocess.run([sys.executable, str(RECORD), str(folder), "--seconds", seconds], check=True)
    learn(folder)
    jobs = [
        *(
            Job(folder, day, rig, "", RunConfig("dead_reckoning", sensors=WHEELS))
            for rig in (DRAWN_RIG, RIG)
            for day in (MONDAY, TUESDAY)
        ),
        *(
            Job(folder, TUESDAY, RIG, MAP, RunConfig(name))
            for name in ("ekf", "particle_filter", "smoother", "monoslam")
        ),
        *(
            Job(folder, day, RIG, "", RunConfig(name, NO_MAP))
            for day in (MONDAY, TUESDAY)
            for name in ("smoother", "monoslam")
        ),
        *(Job(folder, TUESDAY, RIG, OWN_MAP, RunConfig(name)) for name in ("smoother", "monoslam")),
    ]
    outcomes = report.collect(attempt, jobs, [f"{job.config.estimator}, {job.day}, {job.world}" for job in jobs])
    describe(report, folder)
    rows = []
    for i, job in enumerate(jobs):
        if i in outcomes:
            rows.append((WORLDS[job.world, job.rig], job.day, job.config.estimator, *cells(outcomes[i], job.log())))
    report.table(HEADS, rows)
    draw({i: outcomes[i] for i in outcomes}, jobs, options)
    return report


WORLDS = {
    ("", DRAWN_RIG): "none, wheels as drawn",
    ("", RIG): "none",
    (MAP, RIG): "of Monday",
    (OWN_MAP, RIG): "of Monday, without its reference",
}


def learn(folder: Path) -> None:
    """The wheels and two maps from Monday, in ``folder``, if they are not there."""
    monday = str(folder / f"{MONDAY}.toml")
    if not (folder / RIG).exists():
        fgloc.calibrate([monday], folder / RIG)
    if not (folder / MAP).exists():
        fgloc.build_map(monday, folder / MAP, rig=folder / RIG)
    if not (folder / OWN_MAP).exists():
        fgloc.run(monday, "smoother", settings=NO_MAP, rig=folder / RIG, out=folder / OWN, overwrite=True)


def attempt(job: Job) -> RunResult:
    return run(job.log(), job.config)


def describe(report: Report, folder: Path) -> None:
    """Lengths, tilts and slip of the drives, from the files; and what was learnt from Monday."""
    for day in (MONDAY, TUESDAY):
        poses = np.loadtxt(folder / day / "mocap.txt")
        tilts = np.degrees(Rotation.from_quat(poses[:, 4:]).as_euler("ZYX")[:, 1:])
        length = np.hypot(*np.diff(poses[::10, 1:3], axis=0).T).sum()
        images = len(list((folder / day / "images").glob("*.jpg")))
        report.say(
            f"{day.capitalize()}: {poses[-1, 0] - poses[0, 0]:.0f} s, {length:.0f} m, {images} images; pitch "
            f"{tilts[:, 0].mean():.1f} ± {tilts[:, 0].std():.1f} degrees, roll {tilts[:, 1].mean():.1f} ± {tilts[:, 1].std():.1f}, "
            f"at most {np.abs(tilts).max():.1f}; height ± {100 * poses[:, 3].std():.1f} cm."
        )
    learnt = fgloc.read_rig(folder / RIG).odometry
    points = [len(fgloc.read_world(folder / name).points or ()) for name in (MAP, OWN_MAP)]
    report.say(
        f"Learnt from Monday: scale of distances {learnt.scale_distance:.3f}, of rotations {learnt.scale_rotation:.3f}, drift of "
        f"the heading {learnt.heading_drift:.4f} rad/m; maps of {points[0]} points with its reference and {points[1]} without. "
        "*Aligned*: after the trajectory is laid on the reference."
    )


def cells(result: RunResult, log: Log) -> list[str]:
    found = accuracy_cells([run_errors(result, log)])
    aligned = free_map_figures(result.final, {}, log)["aligned.position_rmse"]
    return [*found[:4], found[5], NOTHING if aligned is None else f"{aligned:.4f}"]


def draw(outcomes: dict[int, RunResult], jobs: list[Job], options: CameraOptions) -> None:
    """What the camera sees on both days, and trajectories on Tuesday."""
    mpl.use("Agg")
    figure, axes = plt.subplot_mosaic("ac;bc", figsize=(9.5, 4.6), width_ratios=(0.75, 1.0), layout="constrained")
    folder = jobs[0].folder
    for name, day in (("a", MONDAY), ("b", TUESDAY)):
        picture = cv2.imread(str(folder / day / "images" / "00100.jpg"))
        assert picture is not None
        axes[name].imshow(picture[..., ::-1])
        axes[name].set(title=day.capitalize(), xticks=[], yticks=[])
    log = jobs[0].log() if jobs[0].day == TUESDAY else jobs[1].log()
    assert log.reference is not None
    axes["c"].plot(*log.reference.poses[:, :2].T, color="0.75", lw=4.0, label="reference, Tuesday")
    for i, result in outcomes.items():
        job = jobs[i]
        if (
            job.day == TUESDAY
            and job.rig == RIG
            and job.config.estimator in ("dead_reckoning", "smoother")
            and len(result.final)
        ):
            label = f"{job.config.estimator}, map {WORLDS[job.world, job.rig]}"
            axes["c"].plot(*result.final.poses[:, :2].T, lw=1.0, label=label)
    axes["c"].set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axes["c"].legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.12))
    out = options.out / "physics"
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "physics.png", dpi=110)
    plt.close(figure)
