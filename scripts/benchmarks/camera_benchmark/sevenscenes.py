"""Real images: some of 7-Scenes are mapped, others are located in that map, with each kind of feature."""

from __future__ import annotations

from benchmarking.report import Report

from camera_benchmark.options import CameraOptions
from factorgraph_loc.experiments.image_localization import evaluate_images, table, write_results
from factorgraph_loc.io.readers import load
from factorgraph_loc.vision.features import EXTRACTORS

COUNT = 1500
MAPPED = range(0, 200, 2)
QUERIES = {"A": range(1, 200, 2), "B": range(200, 300)}


def section(options: CameraOptions) -> Report:
    report = Report("sevenscenes", options)
    (log,) = load("sevenscenes", data_root=options.data_root)
    results = evaluate_images(log, list(EXTRACTORS), COUNT, MAPPED, QUERIES)
    write_results(log.name, results, options.out / report.name)
    report.say(
        f"{COUNT} features an image; medians, and the 90th percentiles; located: within 0.05 m and 5 degrees. "
        "A: images 1, 3, ... 199; B: 200 to 299."
    )
    report.table(*table(results))
    report.say("The maps, of images 0, 2, ... 198:")
    heads = ("feature", "points", "observations", "residual RMS [px]", "median [px]", "parallax [rad]", "sigma [m]")
    rows = [
        [
            name,
            str(made.points),
            str(made.observations),
            f"{made.rms:.2f}",
            f"{made.mad:.2f}",
            f"{made.parallax:.3f}",
            f"{made.sigma:.3f}",
        ]
        for name, made in results.maps.items()
    ]
    report.table(heads, rows)
    return report
