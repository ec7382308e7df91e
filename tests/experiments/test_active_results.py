"""Tables and pictures of robots that seek their place, from runs whose figures are known."""

import itertools
import math

import numpy as np
import polars as pl
import pytest
from computed_here import Here

from factorgraph_loc import InputError, RunFailedError, Tag, Trajectory, World
from factorgraph_loc.experiments import active, experiment
from factorgraph_loc.experiments.active_results import comparison, differences, run_picture, summaries
from factorgraph_loc.planning.closed_loop import ActiveRun, PlanningStep
from factorgraph_loc.simulation.settings import preset


def row(policy, seed, metres, *, world="hall", localized=True, **changes):
    """A run; ``changes`` of its other figures."""
    named = {"world": world, "policy": policy, "estimator": "active_mcl", "seed": seed, "status": "ok", "reason": None}
    ends = {"localized": localized, "metres": metres, "seconds": 2.0 * metres, "claimed_wrong": False}
    errors = {"error_position": 0.1, "error_heading": math.radians(5.0)}
    return {**named, **ends, **errors, "steps": 3, "planning_ms": 20.0, "planning_ms_max": 50.0, **changes}


def crashed(policy, seed):
    """A run that told nothing."""
    known = {"world": "hall", "policy": policy, "estimator": "active_mcl", "seed": seed, "status": "failed"}
    return {**dict.fromkeys(row("", 0, 0.0)), **known, "reason": "it broke"}


@pytest.fixture
def rows():
    """Two policies on ten seeds: the second drives twice as far and is not localized on two of them; one run broke."""
    first = [row("information", seed, 10.0 + seed) for seed in range(9)] + [crashed("information", 9)]
    second = [row("random", seed, 20.0 + 2.0 * seed) for seed in range(8)]
    lost = [row("random", seed, 100.0, localized=False, claimed_wrong=seed == 8) for seed in (8, 9)]
    return [*first, *second, *lost]


def test_a_run_that_does_not_get_there_is_beyond_all_others(rows):
    first, second = summaries(rows)
    assert (first["policy"], first["runs"], first["failures"]) == ("information", 10, 1)
    assert (first["median"], first["p90"]) == (14.5, 18.0)
    assert (second["median"], second["p90"], second["failures"]) == (29.0, math.inf, 2)
    assert second["claimed_wrong"] == 1
    assert second["error_position"] == pytest.approx(0.1)
    assert 0.0 < second["failures_low"] < 0.2 < second["failures_high"]


def test_policies_are_compared_on_the_same_seeds(rows):
    (found,) = differences(rows)
    assert (found["a"], found["b"], found["pairs"]) == ("information", "random", 10)
    assert found["ratio"] == pytest.approx(0.5)
    assert found["difference"] == pytest.approx(-14.5)
    assert found["ratio_low"] <= found["ratio"] <= found["ratio_high"] < 1.0
    assert (found["failed_only_a"], found["failed_only_b"]) == (0, 1)
    assert found["p"] == 1.0
    (fewer,) = differences([one for one in rows if one["policy"] == "information" or one["seed"] < 4])
    assert fewer["pairs"] == 4
    assert fewer["difference"] == pytest.approx(11.5 - 23.0)


def test_the_picture_of_a_comparison_counts_what_came_and_what_did_not(rows):
    figure = comparison(rows)
    boxes, shares = figure.axes
    assert figure.get_suptitle().endswith("10 runs of each")
    assert [label.get_text() for label in boxes.get_xticklabels()] == ["information", "random"]
    assert [text.get_text() for text in boxes.texts] == ["1 of 10\nnever", "2 of 10\nnever"]
    ends = [float(line.get_ydata()[-1]) for line in shares.lines]
    assert ends == pytest.approx([0.9, 0.8])
    assert float(np.interp(14.5, *shares.lines[0].get_data())) == pytest.approx(0.5, abs=0.06)


def walls(width, depth):
    corners = ((0.0, 0.0), (width, 0.0), (width, depth), (0.0, depth), (0.0, 0.0))
    return tuple((*a, *b) for a, b in itertools.pairwise(corners))


def seeking(count):
    """A run of so many decisions, whose belief is half as wide after each."""
    rng = np.random.default_rng(0)
    steps = []
    for i in range(count):
        pose = np.array((1.0 + i, 1.5, 0.0))
        ways = tuple(pose + np.array(((0.0, 0.0, 0.0), (1.0, side, 0.0))) for side in (-0.5, 0.0, 0.5))
        particles = pose + 2.0**-i * rng.standard_normal((200, 3))
        chosen = ways[1] if i else None
        steps.append(PlanningStep(0.0, float(i), pose, pose, np.eye(3), particles, ways, np.ones(3), chosen, 1.0))
    truth = np.column_stack((np.linspace(1.0, 1.0 + count, 50), np.full(50, 1.5), np.zeros(50)))
    world = World(tags={"T": Tag(x=2.0, y=0.0)}, walls=walls(12.0, 3.0))
    ends = (True, float(count), 1.0, 0.1, 0.05, False)
    return ActiveRun(
        0, "hall", world, "information", "active_mcl", *ends, Trajectory(np.arange(50.0), truth), tuple(steps)
    )


def labels(figure):
    return {text.get_text() for text in figure.legends[0].get_texts()}


def test_the_picture_of_a_run_shows_what_was_proposed_chosen_and_believed():
    figure = run_picture(seeking(9))
    maps = [axis for axis in figure.axes if axis.get_title().startswith("after")]
    assert [axis.get_title() for axis in maps[:-1]] == [f"after {i}.0 m" for i in (0, 2, 3, 5, 6)]
    assert maps[-1].get_title() == "after 8.0 m, path to the end at 9.0 m"
    drawn = {line.get_label(): line for line in maps[1].lines}
    assert {"walls", "tags", "belief", "candidates", "chosen", "robot (true)"} <= set(drawn)
    np.testing.assert_allclose(drawn["chosen"].get_xydata(), ((3.0, 1.5), (4.0, 1.5)))
    assert "chosen" not in {line.get_label() for line in maps[0].lines}  # nothing was taken
    ways = [next(line for line in axis.lines if line.get_label() == "path (true)") for axis in maps]
    np.testing.assert_allclose([way.get_xdata()[-1] for way in ways], (1.0, 3.0, 4.0, 6.0, 7.0, 10.0), atol=0.2)
    assert {"chosen", "path (true)"} <= labels(figure)
    (belief,) = [axis for axis in figure.axes if axis.get_ylabel() == "standard deviation of the belief [m]"]
    spread = belief.lines[0].get_ydata()
    assert len(spread) == 9
    # of 200 particles: farther off than 20 % in one of 2,000 draws
    np.testing.assert_allclose(spread[1:] / spread[:-1], 0.5, rtol=0.2)


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
