"""Comparisons: every pair is run, failures are reported, nothing is lost."""

from dataclasses import replace

import polars as pl
import pytest

from factorgraph_loc.errors import InputError
from factorgraph_loc.experiments.compare import compare
from factorgraph_loc.experiments.run import RunConfig
from factorgraph_loc.io.results import FILES


@pytest.mark.usefixtures("runs_here", "blank_pictures")
def test_a_failing_run_is_reported_while_the_others_complete(log, tmp_path):
    nowhere = replace(log, name="no/where", reference=None)
    configs = [
        RunConfig(name, seed=seed, prior="reference")
        for name in ("dead_reckoning", "particle_filter")
        for seed in (3, 4)
    ]
    out = tmp_path / "out"
    done = []
    comparison = compare([log, nowhere], configs, out, progress=lambda *counts: done.append(counts))
    assert done == [(i + 1, 6) for i in range(6)]
    assert [(r["log"], r["estimator"], r["seed"], r["status"]) for r in comparison.rows] == [
        (name, estimator, seed, status)
        for name, status in (("straight", "ok"), ("no/where", "failed"))
        for estimator, seed in (("dead_reckoning", 3), ("particle_filter", 3), ("particle_filter", 4))
    ]
    assert len({tuple(row) for row in comparison.rows}) == 1
    assert len(comparison.failures) == 3
    assert comparison.failures[0].startswith(
        "no/where, dead_reckoning, seed 3: no/where: has no reference to start from"
    )

    assert {path.name for path in (out / "runs/straight/particle_filter/seed4").iterdir()} == set(FILES)
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
        compare([log], configs[:1], out)
    (out / "notes.txt").write_text("mine")
    (out / "plots/mine.png").write_text("mine")
    compare([log], configs[:1], out, overwrite=True)
    assert len(pl.read_csv(out / "results.csv")) == 1
    assert pl.read_csv(out / "differences.csv").is_empty()
    assert not list((out / "runs/straight/particle_filter").rglob("metrics.json"))
    assert (out / "notes.txt").is_file()
    assert (out / "plots/mine.png").is_file()
    assert [path.name for path in (out / "plots").glob("*-errors-*")] == ["straight-errors-dead_reckoning.png"]


def test_bad_input_is_found_before_anything_runs(log, tmp_path):
    config = RunConfig("dead_reckoning")
    for logs, configs, message in (
        ([], [config], "nothing to compare"),
        ([log], [], "nothing to compare"),
        ([log, log], [config], "two logs are called straight"),
        ([log], [config, RunConfig("dead_reckoning", {"max_delay": 0.1})], "given twice"),
        ([log], [RunConfig("dead_reckoning", {"max_dely": 0.1})], "did you mean max_delay"),
        ([log], [RunConfig("smother")], "did you mean smoother"),
        ([log], [RunConfig("ekf", prior="1")], "prior is '1'"),
        ([log], [RunConfig("ekf", sensors=("odometri",))], "did you mean odometry"),
    ):
        with pytest.raises(InputError, match=message):
            compare(logs, configs, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("runs_here", "blank_pictures")
def test_the_same_comparison_may_be_made_again_where_it_was_interrupted(log, tmp_path):
    out = tmp_path / "out"
    configs = [RunConfig("dead_reckoning", prior="reference"), RunConfig("ekf", prior="reference")]

    def interrupt(done, _):
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compare([log], configs, out, progress=interrupt)
    assert len(list(out.glob("runs/*/*/seed*"))) >= 1
    with pytest.raises(InputError, match="holds results already"):
        compare([log], configs[:1], out)
    compare([log], configs, out)
    assert not (out / "unfinished.txt").exists()
    with pytest.raises(InputError, match="holds results already"):
        compare([log], configs, out)


@pytest.mark.usefixtures("runs_here", "blank_pictures")
def test_what_a_killed_run_has_left_beside_its_place_is_removed(log, tmp_path):
    place = tmp_path / "out/runs/straight/ekf"
    (place / ".seed0.fgloc-0123abcd").mkdir(parents=True)
    (place / ".seed0.fgloc-0123abcd" / "final.tum").write_text("half")
    compare([log], [RunConfig("dead_reckoning", prior="reference")], tmp_path / "out")
    assert list(place.iterdir()) == []


@pytest.mark.usefixtures("runs_here", "blank_pictures")
def test_no_terminal_obeys_the_tables_of_a_log_with_any_name(log, tmp_path):
    configs = [RunConfig("dead_reckoning"), RunConfig("ekf")]
    compare([replace(log, name="a\x1b[31m\u202eb")], configs, tmp_path / "out")
    for name in ("table.md", "results.csv", "differences.csv"):
        text = (tmp_path / "out" / name).read_text()
        assert all(line.isprintable() for line in text.split("\n")), name
        assert "\\x1b[31m\\u202e" in text, name
