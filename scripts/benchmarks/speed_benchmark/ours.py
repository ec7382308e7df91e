"""Our estimators, measured as the reference programs are. Usage: python -m speed_benchmark.ours PROBLEM LABEL"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from unittest.mock import patch

from factorgraph_loc.threads import use_one_thread

use_one_thread()

from factorgraph_loc.experiments.run import RunConfig, run  # noqa: E402
from factorgraph_loc.io.readers import load  # noqa: E402
from factorgraph_loc.model.log import Log, cut  # noqa: E402
from factorgraph_loc.model.result import RunResult  # noqa: E402
from speed_benchmark.programs.plain import WARM_UP, Problem, quantiles, read_problem  # noqa: E402

LOG = "mrclam6-robot3"
PARTICLES = 5000
PLAIN = {"self_calibration": False}
CONFIGS: Mapping[str, RunConfig] = {
    "EKF": RunConfig("ekf", PLAIN),
    "EKF, 5 constants": RunConfig("ekf"),
    "smoother, lag 10 s, 5 constants": RunConfig("smoother", {"lag": 10.0}),
    "smoother, 5 constants": RunConfig("smoother"),
    "smoother, full history, 5 constants": RunConfig("smoother", {"lag": "all"}),
    "particle filter, 5,000": RunConfig("particle_filter", {**PLAIN, "particles": PARTICLES}),
    "batch": RunConfig("batch", PLAIN),
}


def timed(log: Log, config: RunConfig) -> RunResult:
    """The result of a run, whose times are those of the processor."""
    with patch("factorgraph_loc.experiments.run.perf_counter", time.process_time):
        return run(log, config)


def seconds_of(result: RunResult) -> float:
    """Of the loop over the measurements; and to the final trajectory, where the whole problem is solved for it."""
    estimator, settings = result.config["estimator"], result.config["settings"]
    whole = estimator == "batch" or (estimator == "smoother" and settings.get("lag") is None)
    return result.timings.causal_seconds + (result.timings.final_seconds if whole else 0.0)


def measured(log: Log, problem: Problem, config: RunConfig) -> dict[str, float]:
    """As :func:`speed_benchmark.programs.plain.measured`."""
    first = log.span()[0]
    timed(cut(log, first, first + WARM_UP), config)  # compiles what is not compiled yet
    result = timed(log, config)
    final = config.estimator == "batch"
    t, poses = (result.final.t, result.final.poses) if final else (result.t, result.poses)
    position, heading = problem.rmse(t.tolist(), poses.tolist())
    updates = {} if final else quantiles((1e-3 * result.timings.update_ms).tolist())
    return {"seconds": seconds_of(result), **updates, "position": position, "heading": heading}


def main() -> None:
    path, label = sys.argv[1:]
    print(json.dumps(measured(load(LOG)[0], read_problem(Path(path)), CONFIGS[label])))


if __name__ == "__main__":
    main()
