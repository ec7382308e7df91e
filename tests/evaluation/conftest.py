"""Runs that never were, for tests of reports."""

import io
from dataclasses import dataclass

import numpy as np
import polars as pl
import pytest
from scipy.signal import lfilter

from factorgraph_loc.evaluation.report import Scene
from factorgraph_loc.io.results import ResultFiles
from factorgraph_loc.model.scoring import MAX_GAP


def estimates(rng, *, count=400, sigma=0.1, offset=(0.0, 0.0)):
    """A table as of ``estimates.parquet``: a drive in a circle, and estimates of it with errors of ``sigma`` [m] that go together
    over some time."""
    t = np.arange(count) / 10.0
    circle = np.column_stack((5.0 * np.cos(t / 8.0), 5.0 * np.sin(t / 8.0))) + offset
    parts = []
    for kind, size in (("causal", sigma), ("final", 0.6 * sigma)):
        error = lfilter([np.sqrt(1.0 - 0.95**2)], [1.0, -0.95], rng.normal(0.0, size, (count, 2)), axis=0)
        heading = rng.normal(0.0, 0.02, count)
        columns = {
            "kind": [kind] * count,
            "t_ns": np.round(t * 1e9).astype(np.int64),
            "x": circle[:, 0] + error[:, 0],
            "y": circle[:, 1] + error[:, 1],
            "heading": t / 8.0 + np.pi / 2 + heading,
            **dict.fromkeys(("cov_xy", "cov_xh", "cov_yh"), np.zeros(count)),
            **dict.fromkeys(("cov_xx", "cov_yy"), np.full(count, size**2)),
            "cov_hh": np.full(count, 0.02**2),
            "error_position": np.hypot(*error.T),
            "error_heading": np.abs(heading),
            "nees": np.sum(error**2, axis=1) / size**2 + (heading / 0.02) ** 2,
            "update_ms": np.full(count, 1.0),
            "status": ["localized"] * count,
        }
        parts.append(pl.DataFrame(columns))
    return pl.concat(parts)


@dataclass
class Made:
    """Runs that never were: ``rows`` as of :func:`load_results`, and ``runs``, what :func:`write_report` asks for their files."""

    rows: pl.DataFrame
    tables: dict[str, bytes]
    scene: Scene
    config: bytes = b'estimator = "made"\n'

    def runs(self, key):
        """The files of a run."""
        files = {"estimates.parquet": self.tables[key], "config.toml": self.config}
        return ResultFiles(files.__getitem__, self.scene and self.scene.t0_ns), self.scene


ANGLES = np.linspace(0.0, 5.0, 50)
SCENE = Scene(
    walls=[(-7.0, -7.0, 7.0, -7.0), (7.0, -7.0, 7.0, 7.0)],
    layers={"landmarks": [(0.0, 0.0), (6.0, 2.0)], "tags": [(-6.0, 1.0)], "points": []},
    reference=[np.column_stack((5.0 * np.cos(ANGLES), 5.0 * np.sin(ANGLES))).tolist()],
)


def make_runs(sigmas, logs, seeds=1, *, count=400, sweep=None):
    """Runs of estimators with errors of these sizes, ``sigmas`` [m] by label, on logs of these names. ``sweep``: dotted name and
    values of a setting that multiplies the errors of all logs."""
    rng = np.random.default_rng(7)
    rows, files = [], {}
    name, values = sweep or (None, [None])
    for log in logs:
        hard = rng.uniform(0.7, 1.5)
        for value in values:
            for label, sigma in sigmas.items():
                for seed in range(seeds):
                    key = f"{len(rows):04d}"
                    table = estimates(rng, count=count, sigma=sigma * hard * (value or 1.0))
                    buffer = io.BytesIO()
                    table.write_parquet(buffer)
                    files[key] = buffer.getvalue()
                    rows.append(_row(key, log, label, seed, table) | ({name: value} if name else {}))
    return Made(pl.DataFrame(rows, infer_schema_length=None), files, SCENE)


def _row(key, log, label, seed, table):
    scores = {"scoring.max_gap": MAX_GAP}
    for kind in ("causal", "final"):
        of = table.filter(pl.col("kind") == kind)
        scores[f"{kind}.position_rmse"] = float(np.sqrt(np.mean(of["error_position"].to_numpy() ** 2)))
        scores[f"{kind}.heading_rmse"] = float(np.sqrt(np.mean(of["error_heading"].to_numpy() ** 2)))
        scores[f"{kind}.scored"] = len(of)
    head = {"key": key, "log": log, "label": label, "estimator": "ekf", "seed": seed, "status": "ok"}
    more = {"time_to_localized": 0.0, "timing.update_ms_median": 1.0 + seed, "timing.real_time_factor": 100.0}
    return head | {"kind": None, "reason": None} | scores | more


@pytest.fixture(scope="session")
def made():
    """``make_runs``."""
    return make_runs
