"""`fgloc run`, from the arguments to the files."""

import tomllib
from dataclasses import replace

import polars as pl
import pytest
from tum_files import read_tum

from factorgraph_loc.experiments.run import run
from factorgraph_loc.model.belief import Learnt


@pytest.mark.in_full
def test_run_writes_its_files_and_says_where(fgloc, short_log, tmp_path):
    out = tmp_path / "out"
    result = fgloc("run", short_log, "-e", "ekf", "-o", out, "--seed", 3)
    assert result.exit_code == 0, result.output
    plots = {f"short-{name}.png" for name in ("trajectories", "errors-ekf", "consistency-ekf")}
    assert {path.name for path in (out / "plots").iterdir()} == plots
    assert str(out) in result.stdout
    assert "causal" in result.stdout
    assert "final" in result.stdout
    assert tomllib.loads((out / "config.toml").read_text())["seed"] == 3
    assert len(read_tum(out / "final.tum")) > 500
    assert set(pl.read_parquet(out / "estimates.parquet")["kind"]) == {"causal", "final"}


def test_run_says_how_consistent_it_was_and_what_it_learnt(fgloc, short_log, tmp_path, monkeypatch):
    def eventful(log, config, progress):
        result = run(log, config, progress)
        result.diagnostics.events.extend((10.0 * i, f"event number {i}") for i in range(7))
        values = {f"constant_{i}": (1.0 + i, 0.01) for i in range(12)}
        status = ("unlocalized",) * 30 + result.status[30:]
        return replace(result, learnt=Learnt(values), status=status)

    monkeypatch.setattr("factorgraph_loc.experiments.run.run", eventful)
    result = fgloc("run", short_log, "-e", "ekf", "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert "localized after 3.0 s" in lines
    learnt = [line for line in lines if line.startswith("learnt: ")]
    assert learnt[::10] == ["learnt: constant_0 1 ± 0.01", "learnt: 2 more in learnt.json"]
    i = next(i for i, line in enumerate(lines) if line.startswith("events: 7"))
    assert lines[i + 1 : i + 6] == [f"  at {10.0 * k:.1f} s: event number {k}" for k in range(5)]
    assert "event number 5" not in result.stdout
    assert len(pl.read_csv(tmp_path / "out/events.csv")) == 7
