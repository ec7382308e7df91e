"""A hand-held stereo camera among known points (real pixels): the camera model, and the estimators in space.

Needs the recorded data. The noise is that stated by the data set, without fitting.
"""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from benchmarking.report import Report
from matplotlib import pyplot as plt

from camera_benchmark.options import CameraOptions
from camera_benchmark.reprojection import common_to_images, reprojection_residuals, spread_of
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.io.readers import load
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.result import RunResult

LEFT, RIGHT, TWIST = "sightings", "sightings_right", "twist"
STEREO = (TWIST, LEFT, RIGHT)
CONFIGS = {
    "monoslam, motion alone": RunConfig("monoslam", sensors=(TWIST,)),
    "monoslam, motion and both eyes": RunConfig("monoslam", sensors=STEREO),
    "monoslam, motion and left eye": RunConfig("monoslam", sensors=(TWIST, LEFT)),
    "monoslam, both eyes, constant velocity": RunConfig("monoslam", sensors=(LEFT, RIGHT)),
    "space_smoother, motion and both eyes": RunConfig("space_smoother", sensors=STEREO),
    "space_smoother, motion and left eye": RunConfig("space_smoother", sensors=(TWIST, LEFT)),
    "space_smoother, both eyes, constant velocity": RunConfig("space_smoother", sensors=(LEFT, RIGHT)),
    "space_batch, motion and both eyes": RunConfig("space_batch", sensors=STEREO),
    "space_batch, motion and left eye": RunConfig("space_batch", sensors=(TWIST, LEFT)),
    "space_batch, both eyes, constant velocity": RunConfig("space_batch", sensors=(LEFT, RIGHT)),
}
DRAWN = ("monoslam, motion and both eyes", "space_batch, motion and both eyes")
HEADS = (
    "causal [m]",
    "[deg]",
    "ANEES",
    "final [m]",
    "largest [m]",
    "[deg]",
    "ANEES",
    "residual u / v [px]",
    "step [ms]",
)


@dataclass(frozen=True)
class Job:
    log: Log
    config: RunConfig


def section(options: CameraOptions) -> Report:
    report = Report("starry_night", options)
    (log,) = load("starry_night", data_root=options.data_root)
    assert log.reference3 is not None
    assert log.rig.camera is not None
    t = log.streams[LEFT].t
    report.say(
        f"{log.span()[1]:.0f} s, {len(log.streams[TWIST].t)} stamps, {len(t)} times a point is seen, on average "
        f"{len(t) / len(log.streams[TWIST].t):.1f} in an image; pixel noise of {log.rig.camera.pixel_sigma:.1f} px, as the data "
        "set states. What is seen less what should be from the poses of the motion capture, and how much of it (its variance) "
        "the points of an image have in common:"
    )
    rows = []
    for eye, sensor in (("left", LEFT), ("right", RIGHT)):
        residuals = reprojection_residuals(log.reference3, log, sensor)
        found, common = spread_of(residuals), common_to_images(residuals, t)
        sizes = [[f"{found[f'{axis}_{how}']:.1f}" for how in ("mad", "rms")] for axis in "uv"]
        rows.append((eye, *sizes[0], f"{common[0]:.2f}", *sizes[1], f"{common[1]:.2f}"))
    report.table(("eye", "u: median size [px]", "rms", "common", "v: median size [px]", "rms", "common"), rows)
    outcomes = report.collect(attempt, [Job(log, config) for config in CONFIGS.values()], list(CONFIGS), workers=1)
    results = {label: outcomes[i] for i, label in enumerate(CONFIGS) if i in outcomes}
    report.say(
        "Errors are RMSE against the motion capture. The residual is the median size from the final poses, in the left eye."
    )
    report.table(("estimator", *HEADS), [(label, *cells(result, log)) for label, result in results.items()])
    if results:
        draw({label: results[label] for label in DRAWN if label in results}, log, options)
    return report


def attempt(job: Job) -> RunResult:
    return run(job.log, job.config)


def cells(result: RunResult, log: Log) -> list[str]:
    figures = score(result, log)
    causal = ["–"] * 3 if result.causal_space is None else accuracy(figures, "causal")
    final = accuracy(figures, "final")
    assert result.final_space is not None
    seen = spread_of(reprojection_residuals(result.final_space, log))
    step = figures["timing.update_ms_median"]
    return [
        *causal,
        final[0],
        f"{figures['final.space_position_max']:.3f}",
        *final[1:],
        f"{seen['u_mad']:.1f} / {seen['v_mad']:.1f}",
        "–" if step is None or result.causal_space is None else f"{step:.1f}",
    ]


def accuracy(figures: dict[str, float], kind: str) -> list[str]:
    rotation = np.degrees(figures[f"{kind}.space_rotation_rmse"])
    return [f"{figures[f'{kind}.space_position_rmse']:.3f}", f"{rotation:.1f}", f"{figures[f'{kind}.space_anees']:.1f}"]


def draw(results: dict[str, RunResult], log: Log, options: CameraOptions) -> None:
    """Plot errors of the final positions over time, and the number of points in view."""
    assert log.reference3 is not None
    mpl.use("Agg")
    figure, (above, below) = plt.subplots(
        2, 1, figsize=(9.0, 4.5), sharex=True, height_ratios=(2, 1), layout="constrained"
    )
    for label, result in results.items():
        kinds = {"causal": result.causal_space, "final": result.final_space}
        for kind, found in kinds.items():
            if found is not None:
                rows = np.flatnonzero((found.t >= log.reference3.t[0]) & (found.t <= log.reference3.t[-1]))
                truth = log.reference3.at(found.t[rows])
                off = 100.0 * np.linalg.norm(found.positions[rows] - truth.positions, axis=1)
                above.plot(found.t[rows], off, lw=0.8, label=f"{label.split(',')[0]}, {kind}")
    stamps = log.streams[TWIST].t
    below.fill_between(stamps, np.array([np.sum(log.streams[LEFT].t == t) for t in stamps]), step="post", color="0.6")
    above.set_ylabel("position error [cm]")
    below.set(ylabel="points in view", xlabel="time [s]")
    above.legend(loc="upper right", fontsize=8)
    folder = options.out / "starry_night"
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "starry-night.png", dpi=110)
    plt.close(figure)
