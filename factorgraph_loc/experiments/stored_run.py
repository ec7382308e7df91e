"""The files of one run in the store: those of ``fgloc run``, with all times in ``timings.json``.

All other files of a run are reproducible to the byte.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np
import polars as pl

from factorgraph_loc.evaluation.estimates_file import NAME, parse_estimates
from factorgraph_loc.evaluation.figures import Track
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.output import write_files
from factorgraph_loc.experiments.store import TIMING, TIMINGS
from factorgraph_loc.files.temporary import of_system, temporary_folder
from factorgraph_loc.io.results.estimates import trajectory_of
from factorgraph_loc.io.results.layout import FILES
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.result import RunResult


def run_files(result: RunResult, log: Log, started: float) -> dict[str, bytes]:
    """The files of a run by name: see :func:`~factorgraph_loc.experiments.output.write_run`; ``update_ms`` is empty.

    ``started``: the value of ``perf_counter`` at the start, for the total time.
    """
    scores = score(result, log)
    timings = {name: value for name, value in scores.items() if name.startswith(TIMING)}
    untimed = replace(result, timings=replace(result.timings, update_t=np.empty(0), update_ms=np.empty(0)))
    with temporary_folder(of_system("run")) as folder:
        write_files(untimed, log, {k: v for k, v in scores.items() if k not in timings}, folder)
        files = {name: (folder / name).read_bytes() for name in FILES}
    return files | {TIMINGS: timings_file(timings | {"timing.run_seconds": perf_counter() - started})}


def timings_file(timings: Mapping[str, Any]) -> bytes:
    """The content of ``timings.json``; non-finite values are null."""
    plain = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in timings.items()}
    return (json.dumps(plain, indent=2) + "\n").encode()


def read_track(estimates: bytes) -> Track:
    """The trajectories of an ``estimates.parquet``; see :meth:`~factorgraph_loc.experiments.store.Store.track`."""
    table = parse_estimates(estimates, NAME)
    t0_ns = int(table["t_ns"].to_numpy().min(initial=np.iinfo(np.int64).max))
    causal = trajectory_of(table.filter((pl.col("kind") == "causal") & _from_localized(table)), t0_ns)
    final = trajectory_of(table.filter(pl.col("kind") == "final"), t0_ns)
    return Track(causal if len(causal) else None, final, np.empty(0))


def _from_localized(table: pl.DataFrame) -> pl.Expr:
    found = table.filter((pl.col("kind") == "causal") & (pl.col("status") == "localized"))["t_ns"]
    return pl.col("t_ns") >= (found.min() if len(found) else np.iinfo(np.int64).max)
