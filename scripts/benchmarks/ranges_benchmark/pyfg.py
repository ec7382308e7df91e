"""The smoother compared with GTSAM alone, on PyFG files of ranges to beacons at unknown positions."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
from benchmarking.report import NOTHING, Options, Report

from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.files.data_root import find_data_root
from factorgraph_loc.io.readers import read_log
from factorgraph_loc.model.log import cut
from factors import se2
from factors.se2 import Array
from ranges_benchmark import graphs

FILES = ("pyfg/plaza1.pyfg", "pyfg/plaza2.pyfg")
T = TypeVar("T")
CONFIG = RunConfig("smoother", {"landmarks": "unknown"})
WARM_UP = 60.0  # s: the first part of the log is run before, so that compilation is not measured
HEADS = ("file", "estimator", "final, aligned [m]", "beacons, aligned [m]", "processor time [s]", "ratio to iSAM2")


def section(options: Options) -> Report:
    report = Report("pyfg", options)
    root, rows = find_data_root(options.data_root, FILES[0]), []
    for name in FILES:
        rows += compared(root / name)
        report.tell(len(rows), 3 * len(FILES))
    report.table(HEADS, rows)
    return report


def compared(path: Path) -> list[tuple[str, ...]]:
    """Solve one file by three methods, and return the rows of the table."""
    log, graph = read_log(path), graphs.Graph.of(path)
    run(cut(log, 0.0, WARM_UP), CONFIG)
    truth, from_truth = timed(lambda: graphs.from_truth(graph))
    positions, plain = timed(lambda: graphs.incremental(graph))
    result, ours = timed(lambda: run(log, CONFIG))
    scores = score(result, log)
    found = (
        ("Levenberg-Marquardt from the true poses", aligned(truth, graph.poses), None, from_truth),
        ("iSAM2 alone", aligned(positions, graph.poses), None, plain),
        ("smoother", scores["final.aligned_position_rmse"], scores["landmarks.rmse"], ours),
    )
    return [
        (
            path.stem,
            name,
            f"{error:.3f}",
            NOTHING if marks is None else f"{marks:.3f}",
            f"{took:.1f}",
            f"{took / plain:.2f}",
        )
        for name, error, marks, took in found
    ]


def timed(call: Callable[[], T]) -> tuple[T, float]:
    """Call a function. Returns its result and its processor time [s]."""
    started = time.process_time()
    return call(), time.process_time() - started


def aligned(positions: Array, poses: Array) -> float:
    """Align ``positions`` (N, 2) with the true ``poses`` (N, 3), and return the root mean square error [m]."""
    moved = se2.transform_from(se2.align_points(positions, poses[:, :2]), positions)
    return float(np.sqrt(np.mean(np.sum((moved - poses[:, :2]) ** 2, axis=1))))
