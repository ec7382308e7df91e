"""Files of a result folder: their names, and trajectories in the table of a run."""

import numpy as np
import polars as pl

from factorgraph_loc.model.trajectory import COVARIANCES, Trajectory

FILES = (
    "final.tum",
    "causal.tum",
    "estimates.parquet",
    "learnt.json",
    "events.csv",
    "config.toml",
    "metrics.json",
)  # the last one is written last


def trajectory_of(table: pl.DataFrame, t0_ns: int) -> Trajectory:
    """The poses in rows of an ``estimates.parquet``, in seconds after ``t0_ns``."""
    covariances = np.empty((len(table), 3, 3))
    for name, (i, j) in COVARIANCES.items():
        covariances[:, i, j] = covariances[:, j, i] = table[name].cast(pl.Float64).fill_null(np.nan).to_numpy()
    t = (table["t_ns"].to_numpy() - t0_ns) / 1e9
    return Trajectory(t, table.select("x", "y", "heading").fill_null(np.nan).to_numpy(), covariances)
