"""The files of a run."""

import json
import tempfile
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from tum_files import read_tum

from factorgraph_loc.errors import InputError
from factorgraph_loc.experiments.output import save_run, write_run
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.io.results import FILES
from factorgraph_loc.model.belief import LearntPoint

COLUMNS = [
    *("kind", "t_ns", "x", "y", "heading", "cov_xx", "cov_xy", "cov_xh", "cov_yy", "cov_yh", "cov_hh"),
    *("error_position", "error_heading", "nees", "update_ms", "status", "doubts_model"),
]


@pytest.fixture
def result(log):
    return run(log, RunConfig("fake", {"localized_at": 0.5}))


def test_files(result, log, tmp_path):
    scores = write_run(result, log, tmp_path / "new" / "out")
    out = tmp_path / "new" / "out"
    assert {path.name for path in out.iterdir()} == set(FILES)
    assert list(out.parent.iterdir()) == [out]
    assert json.loads((out / "metrics.json").read_text()) == scores
    assert tomllib.loads((out / "config.toml").read_text())["estimator"] == "fake"
    assert read_tum(out / "causal.tum", log.t0_ns).t == pytest.approx(np.arange(5, 21) * 0.1)
    assert len(read_tum(out / "final.tum")) == 21


def test_table_of_estimates(result, log, tmp_path):
    write_run(result, log, tmp_path / "out")
    table = pl.read_parquet(tmp_path / "out" / "estimates.parquet")
    assert table.columns == COLUMNS
    types = {"kind": pl.String, "t_ns": pl.Int64, "status": pl.String, "doubts_model": pl.Boolean}
    assert dict(table.schema) == {name: types.get(name, pl.Float64) for name in COLUMNS}
    causal, final = (table.filter(pl.col("kind") == kind) for kind in ("causal", "final"))
    assert len(causal) == len(final) == 21
    assert causal["t_ns"].to_list() == [log.t0_ns + i * 100_000_000 for i in range(21)]
    assert causal["error_position"].to_numpy() == pytest.approx(np.arange(21) * 0.1)
    assert causal["nees"].to_numpy() == pytest.approx((np.arange(21) * 0.1) ** 2)
    assert np.flatnonzero(causal["update_ms"].is_not_null()).tolist() == [1, 6, 11, 16]
    assert causal["status"].to_list() == final["status"].to_list() == ["unlocalized"] * 5 + ["localized"] * 16
    assert final["update_ms"].null_count() == final["cov_xx"].null_count() == 21
    assert not any(table[name].is_nan().any() for name in COLUMNS if name not in types)


def test_what_was_learnt_and_what_happened(result, log, tmp_path):
    point = LearntPoint(np.array((5.0, 1.0)), np.array(((0.04, 0.01), (0.01, np.nan))))
    result = replace(result, learnt=replace(result.learnt, landmarks={"a": point}))
    result.diagnostics.event(0.75, "lost", "moved, or lost")
    write_run(result, log, tmp_path / "out")
    assert json.loads((tmp_path / "out/learnt.json").read_text()) == {
        "constants": {"scale": {"value": 1.0, "sigma": 0.1}},
        "landmarks": {"a": {"x": 5.0, "y": 1.0, "covariance": [0.04, 0.01, None]}},
    }
    table = pl.read_csv(tmp_path / "out/events.csv")
    assert table.rows() == [(log.t0_ns + 750_000_000, 0.75, "moved, or lost")]
    result.diagnostics.events.clear()
    write_run(result, log, tmp_path / "none")
    assert (tmp_path / "none/events.csv").read_text() == "t_ns,t,event\n"


def test_results_are_not_overwritten_unless_told(result, log, tmp_path):
    out = tmp_path / "out"
    write_run(result, log, out)
    before = (out / "metrics.json").read_bytes()
    (out / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="holds results already"):
        write_run(result, log, out)
    assert (out / "metrics.json").read_bytes() == before
    write_run(result, log, out, overwrite=True)
    assert (out / "notes.txt").read_text() == "mine"
    assert {path.name for path in out.iterdir()} == {*FILES, "notes.txt"}


def test_a_run_that_cannot_be_written_is_kept_elsewhere(result, log, tmp_path, monkeypatch):
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "deleted").mkdir()
    monkeypatch.chdir(tmp_path / "deleted")
    (tmp_path / "deleted").rmdir()
    with pytest.raises(
        InputError, match="out: cannot be written: No such file or directory; the results are in "
    ) as caught:
        save_run(result, log, Path("out"))
    (folder,) = (tmp_path / "temporary").iterdir()
    assert str(caught.value).endswith(f" {folder}")
    assert {path.name for path in folder.iterdir()} == set(FILES)
