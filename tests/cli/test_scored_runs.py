"""What `fgloc run` and `fgloc compare` say of the errors: how often they are scored, after an alignment, and in doubt."""

import json
import shutil

import numpy as np
import polars as pl
import pytest

from factorgraph_loc.model.trajectory import Trajectory, read_tum, write_tum


@pytest.fixture
def sparse_log(short_log, tmp_path):
    """The log with a pose of the reference every 0.13 s, between the ticks."""
    shutil.copytree(short_log, tmp_path / "sparse")
    whole = read_tum(short_log / "reference.tum")
    t = np.arange(whole.t[0] + 0.03, whole.t[-1], 0.13)
    write_tum(Trajectory(t, whole.at(t)), tmp_path / "sparse/reference.tum")
    return tmp_path / "sparse", len(t)


def test_relative_errors_and_an_alignment_are_shown_where_they_are_asked_for(fgloc, short_log, tmp_path):
    plain = fgloc("run", short_log, "-e", "ekf", "-o", tmp_path / "plain")
    assert "relative errors" not in plain.stdout
    assert "after alignment" not in plain.stdout
    result = fgloc("run", short_log, "-e", "ekf", "-o", tmp_path / "run", "--align", "sim3", "--rpe")
    assert result.exit_code == 0, result.output
    scored = fgloc("score", tmp_path / "run", short_log, "--associate", "interpolate", "--align", "sim3", "--json")
    scored = json.loads(scored.stdout)
    lines = result.stdout.splitlines()
    of_final = [line.split()[1:] for line in lines if line.startswith("final ")]
    aligned, relative = of_final[1:3]
    assert [float(cell) for cell in aligned] == pytest.approx(
        [scored["ape.position_rmse"], scored["ape.rotation_rmse"]], abs=6e-4
    )
    unaligned = json.loads(fgloc("score", tmp_path / "run", short_log, "--associate", "interpolate", "--json").stdout)
    keys = [f"rpe_per_{per}.{what}_rmse" for per in ("m", "s") for what in ("position", "rotation")]
    assert [float(cell) for cell in relative] == pytest.approx([unaligned[key] for key in keys], abs=6e-5)
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    assert metrics["scoring.align"] == "sim3"
    assert metrics["final.aligned_position_rmse"] == pytest.approx(scored["ape.position_rmse"], abs=1e-6)
    assert metrics["final.rpe_position_per_s"] == pytest.approx(unaligned["rpe_per_s.position_rmse"], abs=1e-6)

    both = fgloc("compare", short_log, "-e", "ekf", "-o", tmp_path / "out", "--align", "sim3", "--rpe")
    assert both.exit_code == 0, both.output
    for text in (both.stdout, (tmp_path / "out/table.md").read_text()):
        assert "errors after alignment by sim3" in text
        assert "relative errors over a metre of path, and over a second" in text
        assert f"{metrics['final.aligned_position_rmse']:.3f}" in text
        assert f"{metrics['final.rpe_position_per_s']:.4f}" in text
    page = (tmp_path / "out/report.html").read_text()
    assert "final aligned position RMSE" in page
    assert "m per s" in page


def test_a_sparse_reference_is_scored_and_how_often_stands_beside_it(fgloc, sparse_log, tmp_path):
    log, count = sparse_log
    result = fgloc("run", log, "-e", "ekf", "-o", tmp_path / "run")
    assert result.exit_code == 0, result.output
    (header,) = [line for line in result.stdout.splitlines() if "position RMSE" in line]
    assert header.split()[-2:] == ["poses", "scored"]
    scored = [line.split()[-1] for line in result.stdout.splitlines() if line.split()[:1] in (["causal"], ["final"])]
    assert scored == [str(count)] * 2
    assert json.loads((tmp_path / "run/metrics.json").read_text())["causal.scored"] == count
    result = fgloc("compare", log, "-e", "ekf,batch", "-o", tmp_path / "two", "--jobs", 1)
    assert result.exit_code == 0, result.output
    lines = [line.split() for line in result.stdout.splitlines()]
    assert [line[-2:] for line in lines if line[:1] == ["short"]] == [[str(count), "1/1"]] * 2
    table = pl.read_csv(tmp_path / "two/results.csv")
    assert table["causal.scored"].to_list() == [count, None]
    assert table["final.scored"].to_list() == [count, count]
    errors = pl.read_parquet(tmp_path / "run/estimates.parquet").filter(pl.col("kind") == "causal")["error_position"]
    assert len(errors.drop_nulls()) == pytest.approx(count, abs=1)


@pytest.mark.parametrize("command", ["run", "compare"])
def test_where_estimates_lie_farther_apart_than_allowed_nothing_is_scored(fgloc, sparse_log, tmp_path, command):
    log, count = sparse_log
    result = fgloc(command, log, "-e", "ekf", "-o", tmp_path / "out", "--max-gap", 0.05, "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    scores = found if command == "run" else found["runs"][0]
    # those alone that are met by a tick
    assert scores["causal.scored"] < 0.2 * count
    assert scores["scoring.max_gap"] == 0.05
    refused = fgloc(command, log, "-e", "ekf", "-o", tmp_path / "none", "--max-gap", 0)
    assert refused.exit_code == 2
    assert refused.stderr.strip() == "error: max_gap is 0, expected a time above 0 s"


@pytest.fixture
def doubtful_log(short_log, tmp_path):
    """The log with a reference that ends after a quarter of it."""
    shutil.copytree(short_log, tmp_path / "doubtful")
    lines = (short_log / "reference.tum").read_text().splitlines(keepends=True)
    (tmp_path / "doubtful/reference.tum").write_text("".join(lines[: len(lines) // 4]))
    return tmp_path / "doubtful"


DOUBT = "warning: short: scored over "


def test_run_says_what_is_doubtful_and_stores_it(fgloc, doubtful_log, tmp_path):
    result = fgloc("run", doubtful_log, "-e", "ekf", "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    (told,) = [line for line in result.stderr.splitlines() if DOUBT in line]
    stored = json.loads((tmp_path / "out/metrics.json").read_text())["warnings"]
    assert f"warning: {stored[0]}" == told
    assert len(stored) == 1
