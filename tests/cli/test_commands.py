"""Every command of `fgloc`, from the arguments to the files."""

import json
import os
import shutil
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from factorgraph_loc import __version__
from factorgraph_loc.cli import show
from factorgraph_loc.errors import RunFailedError
from factorgraph_loc.evaluation.tables import COLUMNS, comparison_cells, comparison_table
from factorgraph_loc.experiments.run import run
from factorgraph_loc.model.belief import Learnt, LearntPoint
from factorgraph_loc.model.trajectory import Trajectory, read_tum, write_tum

RUN_FILES = {
    "final.tum",
    "causal.tum",
    "estimates.parquet",
    "learnt.json",
    "events.csv",
    "metrics.json",
    "config.toml",
}


def test_version_and_help(fgloc):
    assert fgloc("--version").stdout == f"fgloc {__version__}\n"
    text = fgloc("--help").stdout
    for command in ("datasets", "info", "convert", "run", "compare"):
        assert command in text
        assert fgloc(command, "--help").exit_code == 0


@pytest.mark.parametrize("args", [["--help"], ["--version"], ["run", "--help"]])
def test_help_does_not_load_numerical_libraries(args):
    code = (
        "import sys, factorgraph_loc.cli.main as m\n"
        f"sys.argv[1:] = {args!r}\n"
        "try: m.main()\n"
        "except SystemExit: pass\n"
        "print(sorted({'numpy', 'gtsam', 'matplotlib', 'polars', 'scipy'} & set(sys.modules)))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.endswith("[]\n")


def test_datasets(fgloc):
    result = fgloc("datasets")
    assert result.exit_code == 0
    for name in ("plaza2", "mrclam6-robot1", "woods-r3"):
        assert name in result.stdout
    names = [entry["name"] for entry in json.loads(fgloc("datasets", "--json").stdout)]
    assert "plaza2" in names


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_convert(fgloc, short_log, tmp_path, kind):
    out = tmp_path / "copy"
    result = fgloc("convert", short_log, out, "--format", kind)
    assert result.exit_code == 0
    assert str(out) in result.stdout
    assert (out / f"odometry.{kind}").is_file()
    one, other = (json.loads(fgloc("info", log, "--json").stdout) for log in (short_log, out))
    assert one["streams"] == other["streams"]


def test_convert_overwrites_a_log_alone(fgloc, short_log, tmp_path):
    out = tmp_path / "copy"
    assert fgloc("convert", short_log, out).exit_code == 0
    assert fgloc("convert", short_log, out, "--format", "parquet").exit_code == 2
    assert fgloc("convert", short_log, out, "--format", "parquet", "--overwrite").exit_code == 0
    assert (out / "odometry.parquet").is_file()
    assert not (out / "odometry.csv").exists()
    assert [path.name for path in tmp_path.glob(".*")] == []
    (out / "notes.md").write_text("mine")
    assert "holds notes.md beside its log" in fgloc("convert", short_log, out, "--overwrite").stderr
    (out / "run.toml").unlink()
    refused = fgloc("convert", short_log, out, "--overwrite")
    assert refused.exit_code == 2
    assert "expected a new one, or one with a log in the native format to overwrite" in refused.stderr
    assert (out / "notes.md").read_text() == "mine"


@pytest.mark.in_full
def test_run_writes_its_files_and_says_where(fgloc, short_log, tmp_path):
    out = tmp_path / "out"
    result = fgloc("run", short_log, "-e", "ekf", "-o", out, "--seed", 3)
    assert result.exit_code == 0, result.output
    assert {path.name for path in out.iterdir()} == RUN_FILES | {"plots"}
    plots = {f"short-{name}.png" for name in ("trajectories", "errors-ekf", "consistency-ekf")}
    assert {path.name for path in (out / "plots").iterdir()} == plots
    assert str(out) in result.stdout
    assert "causal" in result.stdout
    assert "final" in result.stdout
    assert tomllib.loads((out / "config.toml").read_text())["seed"] == 3
    assert len(read_tum(out / "final.tum")) > 500
    assert set(pl.read_parquet(out / "estimates.parquet")["kind"]) == {"causal", "final"}


def test_run_prints_json_alone(fgloc, short_log, tmp_path):
    result = fgloc("run", short_log, "-e", "ekf", "-o", tmp_path / "out", "--json")
    content = json.loads(result.stdout)
    assert content["causal.position_rmse"] == pytest.approx(
        json.loads((tmp_path / "out/metrics.json").read_text())["causal.position_rmse"]
    )


def test_run_takes_settings_sensors_and_a_start(fgloc, short_log, tmp_path):
    options = ["--set", "ekf.max_delay=0.25", "--sensors", "odometry", "--prior", "0,0,0.5"]
    result = fgloc("run", short_log, "-e", "ekf", "-o", tmp_path / "out", *options)
    assert result.exit_code == 0, result.output
    config = tomllib.loads((tmp_path / "out/config.toml").read_text())
    assert config["settings"]["max_delay"] == 0.25
    assert config["sensors"] == ["odometry"]


def test_run_refuses_to_overwrite_unless_told(fgloc, short_log, tmp_path):
    first = fgloc("run", short_log, "-e", "dead_reckoning", "-o", tmp_path / "out")
    again = fgloc("run", short_log, "-e", "dead_reckoning", "-o", tmp_path / "out")
    (tmp_path / "out/plots/mine.png").write_text("mine")
    (tmp_path / "out/plots/old-errors-ekf.png").write_text("of an earlier run")
    told = fgloc("run", short_log, "-e", "dead_reckoning", "-o", tmp_path / "out", "--overwrite")
    assert (first.exit_code, again.exit_code, told.exit_code) == (0, 2, 0)
    assert "--overwrite" in again.stderr
    assert (tmp_path / "out/plots/mine.png").is_file()
    assert not (tmp_path / "out/plots/old-errors-ekf.png").exists()


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
    assert sum(line.startswith("bearing_range: normalised innovation squared ") for line in lines) == 1
    assert "localized after 3.0 s" in lines
    learnt = [line for line in lines if line.startswith("learnt: ")]
    assert learnt[:2] == ["learnt: constant_0 1 ± 0.01", "learnt: constant_1 2 ± 0.01"]
    assert learnt[10:] == ["learnt: 2 more in learnt.json"]
    i = next(i for i, line in enumerate(lines) if line.startswith("events: 7"))
    assert lines[i + 1 : i + 6] == [f"  at {10.0 * k:.1f} s: event number {k}" for k in range(5)]
    assert "event number 5" not in result.stdout
    assert len(pl.read_csv(tmp_path / "out/events.csv")) == 7


def test_run_aligns_where_the_map_was_free(fgloc, short_log, tmp_path, monkeypatch):
    def mapping(log, config, progress):
        result = run(log, config, progress)
        landmarks = {n: LearntPoint(log.world.position(n), np.eye(2)) for n in log.world.landmarks}
        config = {**result.config, "settings": {"landmarks": "unknown"}}
        return replace(result, config=config, learnt=Learnt(landmarks=landmarks))

    monkeypatch.setattr("factorgraph_loc.experiments.run.run", mapping)
    result = fgloc("run", short_log, "-e", "ekf", "-o", tmp_path / "out")
    assert "final, aligned because the map was free: position RMSE 0." in result.stdout
    assert "learnt landmarks: 4, aligned RMSE 0." in result.stdout


def test_a_log_without_reference_has_innovations(fgloc, short_log, tmp_path):
    shutil.copytree(short_log, tmp_path / "log")
    (tmp_path / "log/reference.tum").unlink()
    result = fgloc("run", tmp_path / "log", "-e", "ekf", "-o", tmp_path / "out", "--prior", "0,0,0")
    assert result.exit_code == 0, result.output
    assert "there is no reference to score against" in result.stdout
    assert "bearing_range: normalised innovation squared " in result.stdout
    names = {"short-trajectories.png", "short-consistency-ekf.png"}
    assert {path.name for path in (tmp_path / "out/plots").iterdir()} == names


def test_compare(fgloc, short_log, tmp_path):
    out = tmp_path / "out"
    result = fgloc("compare", short_log, "-e", "dead_reckoning,ekf", "-o", out, "--seeds", "0:2", "--jobs", 2)
    assert result.exit_code == 0, result.output
    assert "dead_reckoning" in result.stdout
    assert str(out) in result.stdout
    table = pl.read_csv(out / "results.csv")
    assert set(table["estimator"]) == {"dead_reckoning", "ekf"}
    assert (out / "results.parquet").is_file()
    assert list(out.rglob("*.png"))
    again = fgloc("compare", short_log, "-e", "ekf", "-o", out)
    assert again.exit_code == 2
    assert "--overwrite" in again.stderr


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


def test_what_cannot_be_aligned_is_a_warning(fgloc, short_log, tmp_path):
    still = tmp_path / "still"
    shutil.copytree(short_log, still)
    rows = (still / "reference.tum").read_text().splitlines()
    first = rows[0].split()
    same = [" ".join((row.split()[0], *first[1:])) for row in rows]
    (still / "reference.tum").write_text("\n".join(same) + "\n")
    result = fgloc("run", still, "-e", "ekf", "-o", tmp_path / "run", "--align", "se2")
    assert result.exit_code == 0, result.output
    assert "warning: not aligned: the reference: all positions are one, which --align se2 cannot turn" in result.stderr
    assert json.loads((tmp_path / "run/metrics.json").read_text())["final.aligned_position_rmse"] is None


def test_compare_says_why_there_are_no_errors(fgloc, short_log, tmp_path):
    bare = tmp_path / "bare"
    shutil.copytree(short_log, bare)
    (bare / "reference.tum").unlink()
    result = fgloc("compare", bare, "-e", "dead_reckoning", "-o", tmp_path / "out", "--prior", "0,0,0", "--jobs", 1)
    assert result.exit_code == 0, result.output
    assert "short: there is no reference to score against, so there are no errors" in result.stdout


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


def test_compare_says_what_is_doubtful_once_and_stores_it(fgloc, doubtful_log, tmp_path):
    out = tmp_path / "out"
    result = fgloc("compare", doubtful_log, "-e", "dead_reckoning,ekf", "-o", out, "--jobs", 2)
    assert result.exit_code == 0, result.output
    assert result.stderr.count(DOUBT) == 1
    text = json.loads((out / "runs/short/ekf/seed0/metrics.json").read_text())["warnings"][0]
    assert pl.read_csv(out / "results.csv")["warnings"].to_list() == [text, text]
    assert (out / "report.html").read_text().count(text) == 1
    again = fgloc("compare", doubtful_log, "-e", "ekf", "-o", tmp_path / "json", "--json")
    assert json.loads(again.stdout)["warnings"] == [text]


def test_compare_prints_one_table_with_seeds_pooled_and_the_best_in_words(fgloc, short_log, tmp_path):
    out = tmp_path / "out"
    result = fgloc(
        "compare",
        short_log,
        "-e",
        "dead_reckoning,particle_filter",
        "-o",
        out,
        "--seeds",
        "0:2",
        "--set",
        "particle_filter.particles=500",
    )
    assert result.exit_code == 0, result.output
    lines = [line.split() for line in result.stdout.splitlines()]
    assert [line[-1] for line in lines if line[:1] == ["short"]] == ["1/1", "2/2"]
    assert "least causal position error: particle_filter, " in result.stdout
    assert "(dead_reckoning: " in result.stdout
    for name in ("results.parquet", "results.csv", "table.md", "differences.csv", "plots", "runs"):
        assert name in result.stdout
        assert (out / name).exists()


def test_compare_reports_a_failed_run_and_goes_on(fgloc, short_log, tmp_path):
    nowhere = tmp_path / "nowhere"
    shutil.copytree(short_log, nowhere)
    (nowhere / "reference.tum").unlink()
    run_file = nowhere / "run.toml"
    run_file.write_text(run_file.read_text().replace('name = "short"', 'name = "nowhere"'))
    result = fgloc("compare", short_log, nowhere, "-e", "dead_reckoning", "-o", tmp_path / "out")
    assert result.exit_code == 1
    assert "failed: nowhere, dead_reckoning, seed 0: dead_reckoning cannot start" in result.stderr
    assert "least final position error" not in result.stdout
    table = pl.read_csv(tmp_path / "out/results.csv")
    assert table["status"].to_list() == ["ok", "failed"]
    assert table["final.position_rmse"].null_count() == 1


def test_a_run_that_fails_has_exit_code_1(fgloc, short_log, tmp_path, monkeypatch):
    def fail(*_):
        raise RunFailedError("short: the estimate at 3.000 s is not finite")

    monkeypatch.setattr("factorgraph_loc.experiments.run.run", fail)
    result = fgloc("run", short_log, "-e", "ekf", "-o", tmp_path / "out")
    assert result.exit_code == 1
    assert result.stderr == "error: short: the estimate at 3.000 s is not finite\n"
    assert not (tmp_path / "out").exists()


def test_a_folder_with_results_is_refused_before_anything_is_read(fgloc, tmp_path):
    (tmp_path / "metrics.json").write_text("{}")
    for command in ("run", "compare"):
        result = fgloc(command, "no-such-log", "-e", "ekf", "-o", tmp_path)
        assert result.exit_code == 2
        assert "metrics.json" in result.stderr


def test_batch_is_not_timed_by_update(fgloc, short_log, tmp_path):
    result = fgloc("run", short_log, "-e", "batch", "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "for the final trajectory" in result.stdout
    assert "per update" not in result.stdout


def test_compare_prints_json_alone(fgloc, short_log, tmp_path):
    result = fgloc("compare", short_log, "-e", "ekf", "-o", tmp_path / "out", "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)


def test_a_pipe_gets_plain_text(short_log, tmp_path):
    """A comparison as it is given to a shell, with processes of its own and all pictures."""
    command = [sys.executable, "-c", "from factorgraph_loc.cli.main import main; main()"]
    arguments = ["compare", str(short_log), "-e", "dead_reckoning,ekf", "-o", str(tmp_path / "out")]
    done = subprocess.run([*command, *arguments], capture_output=True, text=True, check=True)
    assert "\x1b" not in done.stdout + done.stderr
    assert done.stderr == ""
    assert Path(tmp_path / "out/results.csv").is_file()


@pytest.mark.parametrize("columns", [40, 80, 200])
def test_a_narrow_terminal_cuts_nothing_off(columns, capsys, monkeypatch):
    scores = {key: 31.494 for key, _, _ in COLUMNS.values()}
    row = {"log": "plaza2", "estimator": "dead_reckoning", "seed": 0, "status": "ok", "time_to_localized": 0.0} | scores
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setattr("shutil.get_terminal_size", lambda **_: os.terminal_size((columns, 24)))
    show.rich_table(comparison_table([row]))
    text = capsys.readouterr().out
    assert "…" not in text
    line = next(line for line in text.splitlines() if "plaza2" in line).split()
    assert line == ["plaza2", "dead_reckoning", *comparison_cells([row])[1][0][2:]]
