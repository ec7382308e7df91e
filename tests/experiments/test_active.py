"""Many active runs: rows of what went well and what did not, files, and going on after an interruption."""

import math

import numpy as np
import polars as pl
import pytest
from computed_here import Here

from factorgraph_loc import InputError, RunFailedError, Trajectory, World
from factorgraph_loc.experiments import active, experiment
from factorgraph_loc.planning.closed_loop import ActiveRun, PlanningStep
from factorgraph_loc.simulation.settings import preset

OFFICE = preset("office")
WALLS = ((0.0, 0.0, 5.0, 0.0), (0.0, 0.0, 0.0, 5.0))


def step(metres, ms):
    pose, way = np.array((1.0, 1.0, 0.0)), np.array(((1.0, 1.0, 0.0), (2.0, 1.0, 0.0)))
    return PlanningStep(0.0, metres, pose, pose, np.eye(3), np.zeros((5, 3)), (way,), np.ones(1), way, ms)


@pytest.fixture
def calls(monkeypatch):
    """Runs take no time, in this process: the metres are 10 and the seed, 5 more for `random`; the calls are returned."""
    seen = []

    def run(simulation, policy, estimator, seed, settings):
        seen.append((policy, estimator, seed))
        if settings.start is not None:
            raise InputError("the start is inside a wall")
        if seed == 7:
            raise RunFailedError("the pose is not finite")
        if seed == 8:
            raise ZeroDivisionError("by zero")
        metres = 10.0 + seed + 5.0 * (policy == "random")
        truth = Trajectory(np.arange(3.0), np.ones((3, 3)))
        steps = () if seed == 2 else (step(0.0, 30.0), step(2.0, 10.0), step(4.0, 12.0))
        ends = (metres < 14.0, metres, 2.0 * metres, 0.1, 0.05, False)
        return ActiveRun(seed, simulation.name, World(walls=WALLS), policy, estimator, *ends, truth, steps)

    monkeypatch.setattr(active, "run_active", run)
    monkeypatch.setattr(experiment, "Processes", Here)
    monkeypatch.setattr(active, "write_picture", lambda figure, path: path.write_text(type(figure).__name__))
    monkeypatch.setattr(active, "png_bytes", lambda figure: type(figure).__name__.encode())
    return seen


def test_each_policy_runs_on_each_seed(calls, tmp_path):
    told = []
    report = lambda done, total: told.append((done, total))  # noqa: E731
    results = active.active(
        OFFICE, tmp_path / "out", policies=("information", "random"), seeds=range(7), progress=report
    )
    assert sorted(calls) == sorted((p, "active_mcl", s) for p in ("information", "random") for s in range(7))
    assert not results.failures
    assert told[0] == (0, 14)
    assert told[-1] == (14, 14)
    found = {(row["policy"], row["seed"]): row for row in results.rows}
    assert found["random", 1].items() >= {
        *(("metres", 16.0), ("localized", False), ("steps", 3), ("planning_ms", 12.0), ("planning_ms_max", 30.0)),
    }
    assert found["information", 2]["planning_ms"] is None  # nothing had to be chosen


@pytest.mark.usefixtures("calls")
def test_files_of_an_experiment(tmp_path):
    out = tmp_path / "out"
    results = active.active(OFFICE, out, policies=("information", "random"), seeds=range(3))
    assert sorted(path.name for path in (out / "plots").iterdir()) == [
        "comparison.png",
        "office-active_mcl-information-seed0.png",
        "office-active_mcl-random-seed0.png",
    ]
    assert pl.read_parquet(out / "results.parquet").to_dicts() == results.rows
    (difference,) = pl.read_csv(out / "differences.csv").to_dicts()
    assert difference["pairs"] == 3
    assert difference["difference"] == -math.inf  # the other never came there
    assert "information / random" in (out / "table.md").read_text()
    assert (out / "plots" / "comparison.png").read_text() == "Figure"


@pytest.mark.usefixtures("calls")
def test_a_run_that_fails_is_a_row(tmp_path):
    results = active.active(OFFICE, tmp_path, seeds=range(5, 10))
    assert [row["status"] for row in results.rows] == ["ok", "ok", "failed", "failed", "ok"]
    assert results.rows[2]["metres"] is None
    assert results.failures == [
        "office, information, active_mcl, seed 7: the pose is not finite",
        "office, information, active_mcl, seed 8: ZeroDivisionError: by zero",
    ]
    stored = [path.read_text() for path in tmp_path.glob("store/*/*/failure.json")]
    assert sorted("Traceback" in text for text in stored) == [False, True]


@pytest.mark.usefixtures("calls")
def test_input_that_no_run_takes_is_an_error(tmp_path):
    with pytest.raises(InputError, match="inside a wall"):
        active.active(OFFICE, tmp_path, seeds=(0, 1), changes={"start": (0.0, 0.0, 0.0)})
    assert not (tmp_path / "table.md").exists()


def test_what_is_stored_is_not_run_again(calls, tmp_path):
    done = active.active(OFFICE, tmp_path, seeds=range(5)).rows
    calls.clear()
    told = []
    report = lambda done, total: told.append((done, total))  # noqa: E731
    rows = active.active(OFFICE, tmp_path, seeds=range(12), overwrite=True, progress=report).rows
    assert {seed for _, _, seed in calls} == set(range(5, 12))
    assert rows[:5] == done
    assert [row["seed"] for row in rows] == list(range(12))
    assert told[0] == (0, 7)
    calls.clear()
    active.active(OFFICE, tmp_path, seeds=range(12), overwrite=True)
    assert {seed for _, _, seed in calls} == {7, 8}  # those that failed


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ({"policies": ("informtion",)}, "did you mean information"),
        ({"policies": ("random",), "estimators": ("ekf",)}, "unknown estimator 'ekf'"),
        ({"policies": ("random", "random")}, "random is given twice"),
        ({"policies": ()}, "no policy is given"),
    ],
)
def test_names_are_checked_before_anything_runs(calls, tmp_path, names, message):
    with pytest.raises(InputError, match=message):
        active.active(OFFICE, tmp_path / "out", **names)
    assert not calls
    assert not (tmp_path / "out").exists()
