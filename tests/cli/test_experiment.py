"""``fgloc experiment`` from the file to the table; what is stopped goes on."""

import json
import os
import signal
import subprocess

import polars as pl
import pytest

from .conftest import COMMAND

TEXT = """
name = "lags"
logs = ["{log}"]
estimators = ["dead_reckoning", "ekf"]
"""


@pytest.fixture
def file(tmp_path, short_log, monkeypatch):
    """An experiment of two runs, its results in the working folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FGLOC_DATA", str(short_log.parent))
    made = tmp_path / "lags.toml"
    made.write_text(TEXT.format(log=short_log))
    return made


def test_runs_are_made_once_and_can_be_looked_at(fgloc, file, tmp_path):
    plan = fgloc("experiment", "run", file, "--dry-run")
    assert plan.exit_code == 0, plan.output
    assert "2 runs, 2 to do" in plan.stdout
    made = fgloc("experiment", "run", file, "--jobs", 1)
    assert made.exit_code == 0, made.output
    assert "1 of 1" in made.stdout
    rows = pl.read_parquet(tmp_path / "out" / "lags" / "results.parquet")
    assert rows["label"].to_list() == ["dead_reckoning", "ekf"]
    before = sorted(path.stat().st_mtime_ns for path in (tmp_path / "out" / "lags" / "store").glob("??/*/*"))
    again = fgloc("experiment", "run", file, "--json")
    document = json.loads(again.stdout)
    assert [run["causal.position_rmse"] for run in document["runs"]] == rows["causal.position_rmse"].to_list()
    assert sorted(p.stat().st_mtime_ns for p in (tmp_path / "out" / "lags" / "store").glob("??/*/*")) == before
    status = fgloc("experiment", "status", file, "--json")
    labels = json.loads(status.stdout)["labels"]
    assert labels["ekf"] == {"ok": 1, "failed": 0, "missing": 0, "damaged": 0}
    changed = fgloc("experiment", "run", file, "--set", "ekf.max_delay=0.4", "--dry-run", "--json")
    states = [(run["label"], run["state"]) for run in json.loads(changed.stdout)["runs"]]
    assert states == [("dead_reckoning", "ok"), ("ekf", "missing")]
    page = fgloc("experiment", "report", file)
    assert page.exit_code == 0, page.output
    assert "<html" in (tmp_path / "out" / "lags" / "report.html").read_text().lower()


def test_damage_is_told_and_repaired(fgloc, file, tmp_path):
    assert fgloc("experiment", "run", file, "--jobs", 1).exit_code == 0
    for path in (tmp_path / "out/lags/store").glob("??/*/estimates.parquet"):
        before = path.stat()
        path.write_bytes(b"?" + path.read_bytes()[1:])
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
        break
    (name,) = json.loads(fgloc("experiment", "status", file, "--json").stdout)["damaged"]
    assert f"damaged: {name}" in fgloc("experiment", "status", file).stdout
    report = fgloc("experiment", "report", file)
    assert report.exit_code == 0, report.output
    assert f"damaged, left out: {name}" in report.stdout
    assert json.loads(fgloc("experiment", "report", file, "--json").stdout)["damaged"] == [name]
    assert fgloc("experiment", "run", file, "--jobs", 1).exit_code == 0
    assert json.loads(fgloc("experiment", "report", file, "--json").stdout)["damaged"] == []


def test_a_failure_is_named_and_the_exit_code_is_1(fgloc, file, tmp_path):
    result = fgloc("experiment", "run", file, "--jobs", 1, "--set", "prior=log")
    assert result.exit_code == 1, result.output
    status = fgloc("experiment", "status", file, "--set", "prior=log")
    failures = [line for line in status.stdout.splitlines() if line.startswith("failed: ")]
    assert len(failures) == result.stderr.count("failed: ") == 2
    rows = pl.read_parquet(tmp_path / "out" / "lags" / "results.parquet")
    assert rows["kind"].to_list() == ["error", "error"]


def test_an_interrupt_ends_it_cleanly_and_it_goes_on(fgloc, file, tmp_path, processes):
    (tmp_path / "slow.toml").write_text(
        file.read_text().replace('"ekf"]', '{name = "particle_filter", settings = {particles = 200000}}]')
    )
    process = processes.start(*COMMAND, "experiment", "run", "slow.toml", "--jobs", "1", stderr=subprocess.PIPE)
    processes.wait_until(lambda: list(tmp_path.glob("out/lags/store/??/*")))
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to the workers too
    stderr = process.communicate(timeout=processes.PATIENCE)[1]
    assert process.returncode == 130
    assert stderr.endswith("the same command resumes\n")
    assert stderr.count("\n") == 1
    assert "Traceback" not in stderr
    assert len(pl.read_parquet(tmp_path / "out" / "lags" / "results.parquet")) == 1
    status = fgloc("experiment", "status", "slow.toml")
    (line,) = [line for line in status.stdout.splitlines() if line.startswith("(all)")]
    assert line.split()[1:] == ["1", "0", "1", "0"]
    assert list((tmp_path / "out" / "lags" / "store" / "tmp").iterdir()) == []


def test_a_first_experiment_can_be_planned(fgloc, tmp_path):
    file = tmp_path / "lags.toml"
    assert fgloc("experiment", "new", str(file)).exit_code == 0
    planned = fgloc("experiment", "run", str(file), "--dry-run", "-o", str(tmp_path / "out"))
    assert planned.exit_code == 0
    assert "6 runs" in planned.stdout
    assert fgloc("experiment", "new", str(file)).exit_code == 2  # it exists
