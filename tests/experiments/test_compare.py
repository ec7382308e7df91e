"""Comparisons: every pair is run, failures are reported, nothing is lost."""

from dataclasses import replace

import polars as pl
import pytest

from factorgraph_loc.errors import InputError
from factorgraph_loc.experiments.compare import compare, digest_of_log
from factorgraph_loc.exports.runs import find_runs
from factorgraph_loc.io.results import FILES


@pytest.mark.usefixtures("runs_here", "blank_pictures")
def test_a_failing_run_is_reported_while_the_others_complete(log, tmp_path):
    nowhere = replace(log, name="no/where", reference=None)
    estimators = ["dead_reckoning", "particle_filter"]
    out = tmp_path / "out"
    done = []
    comparison = compare(
        [log, nowhere],
        estimators,
        out,
        seeds=[3, 4],
        prior="reference",
        align="se2",
        progress=lambda *counts: done.append(counts),
    )
    assert done == [(i, 6) for i in range(7)]
    assert [(r["log"], r["estimator"], r["seed"], r["status"]) for r in comparison.rows] == [
        (name, estimator, seed, status)
        for name, status in (("straight", "ok"), ("no/where", "failed"))
        for estimator, seed in (("dead_reckoning", 3), ("particle_filter", 3), ("particle_filter", 4))
    ]
    assert len({tuple(row) for row in comparison.rows}) == 1
    assert [row["scoring.align"] for row in comparison.rows] == ["se2"] * 3 + [None] * 3
    assert "errors after alignment by se2" in (out / "table.md").read_text()
    assert len(comparison.failures) == 3
    assert comparison.failures[0].startswith(
        "no/where, dead_reckoning, seed 3: no/where: has no reference to start from"
    )

    keys = {(row["log"], row["seed"]): row["key"] for row in comparison.rows if row["estimator"] == "particle_filter"}
    key = keys["straight", 4]
    assert {path.name for path in (out / "store" / key[:2] / key).iterdir()} >= set(FILES)
    assert [folder.log for folder in find_runs(out)] == ["straight"] * 3
    for table in (pl.read_csv(out / "results.csv"), pl.read_parquet(out / "results.parquet")):
        assert len(table) == 6
        assert table["causal.position_rmse"].null_count() == 3
    assert set(pl.read_csv(out / "differences.csv")["log"]) == {"straight", "no/where"}
    assert "| particle_filter |" in (out / "table.md").read_text()
    assert (out / "plots/straight-trajectories.png").is_file()
    page = (out / "report.html").read_text()
    assert "6 runs. <strong>3 of them failed.</strong>" in page
    assert "has no reference to start from" in page

    with pytest.raises(InputError, match="holds results already"):
        compare([log], ["dead_reckoning"], out)
    (out / "notes.txt").write_text("mine")
    (out / "plots/mine.png").write_text("mine")
    compare([log], ["dead_reckoning"], out, overwrite=True)
    assert len(pl.read_csv(out / "results.csv")) == 1
    assert pl.read_csv(out / "differences.csv").is_empty()
    assert [folder.estimator for folder in find_runs(out)] == ["dead_reckoning"]
    assert (out / "notes.txt").is_file()
    assert (out / "plots/mine.png").is_file()
    assert [path.name for path in (out / "plots").glob("*-errors-*")] == ["straight-errors-dead_reckoning.png"]


def test_bad_input_is_found_before_anything_runs(log, tmp_path):
    for logs, estimators, others, message in (
        ([], ["ekf"], {}, "nothing to compare"),
        ([log], [], {}, "nothing to compare"),
        ([log, log], ["ekf"], {}, "two logs are called straight"),
        ([log], ["ekf"], {"settings": {"ekf": {"max_dely": 0.1}}}, "did you mean max_delay"),
        ([log], ["smother"], {}, "did you mean smoother"),
        ([log], ["ekf"], {"prior": "1"}, "prior is '1'"),
        ([log], ["ekf"], {"sensors": ["odometri"]}, "did you mean odometry"),
    ):
        with pytest.raises(InputError, match=message):
            compare(logs, estimators, tmp_path / "out", **others)
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("runs_here", "blank_pictures")
def test_a_comparison_that_was_interrupted_goes_on_where_it_was(log, tmp_path):
    out = tmp_path / "out"
    estimators = ["dead_reckoning", "ekf"]

    def interrupt(done, _):
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compare([log], estimators, out, prior="reference", progress=interrupt)
    assert len(find_runs(out)) == 1
    left = []
    compare([log], estimators, out, prior="reference", progress=lambda *counts: left.append(counts))
    assert left == [(0, 1), (1, 1)]
    assert len(find_runs(out)) == 2
    with pytest.raises(InputError, match="holds results already"):
        compare([log], estimators, out, prior="reference")


def test_a_log_that_differs_has_another_digest(log):
    assert digest_of_log(log) == digest_of_log(replace(log))
    odometry = log.streams["odometry"]
    other = replace(log, streams={**log.streams, "odometry": replace(odometry, t=odometry.t + 1e-6)})
    assert digest_of_log(other) != digest_of_log(log)


@pytest.mark.usefixtures("runs_here", "blank_pictures")
def test_no_terminal_obeys_the_tables_of_a_log_with_any_name(log, tmp_path):
    compare([replace(log, name="a\x1b[31m\u202eb")], ["dead_reckoning", "ekf"], tmp_path / "out")
    for name in ("table.md", "results.csv", "differences.csv"):
        text = (tmp_path / "out" / name).read_text()
        assert all(line.isprintable() for line in text.split("\n")), name
        assert "\\x1b[31m\\u202e" in text, name
