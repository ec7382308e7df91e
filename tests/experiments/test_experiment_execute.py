"""What becomes of a planned run: results under its key, or a failure with a reason."""

import dataclasses
import shutil
from collections import Counter
from functools import partial

import numpy as np
import pytest
from computed_here import Here, run_planned

from factorgraph_loc import FglocError, load, load_results, write_native
from factorgraph_loc.evaluation.figures import Track
from factorgraph_loc.experiments import keys
from factorgraph_loc.experiments.execute import execute
from factorgraph_loc.experiments.experiment import prepare, run_experiment
from factorgraph_loc.experiments.experiment_file import Experiment
from factorgraph_loc.experiments.plan import plan
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.experiments.store import FAILURE, MANIFEST, TIMINGS, Store
from factorgraph_loc.io.results import ResultFiles

# a name that would leave the store as a path, and be code in a page
NASTY = "../../a 'b' \"c\" <script>alert(1)</script>/.."


@pytest.fixture(autouse=True)
def _no_logs_kept():
    keys.load_planned.cache_clear()


@pytest.fixture
def out(tmp_path):
    Store(tmp_path / "out").create()
    return tmp_path / "out"


@pytest.fixture
def planned(log, tmp_path, out):
    """``planned(**content)``: the runs of an experiment on the log in the folder ``log``."""
    write_native(dataclasses.replace(log, name=NASTY), tmp_path / "log")

    def make(**content):
        usual = {"name": "a", "logs": ["log"], "estimators": ["fake"]}
        return plan(Experiment.model_validate(usual | content), tmp_path, out / "store")

    return make


def test_a_run_gives_what_fgloc_run_gives_but_for_times(planned, out, tmp_path):
    (one,) = planned(estimators=["ekf"])
    assert run_planned(one, out) == "ok"
    store = Store(out)
    (log,) = load(str(tmp_path / "log"))
    result = run(log, RunConfig("ekf"))
    track = Track.read(ResultFiles(partial(store.read, one.key), log.t0_ns))
    np.testing.assert_allclose(track.final.t, result.final.t, atol=1e-9)
    np.testing.assert_array_equal(track.final.poses, result.final.poses)
    np.testing.assert_array_equal(track.causal.covariances, result.causal().covariances)
    row = store.row(one.key)
    assert row["causal.position_rmse"] is not None
    assert row["timing.run_seconds"] >= row["timing.causal_seconds"] > 0.0


def test_the_same_run_again_is_the_same_to_the_byte_but_for_times(planned, out, tmp_path):
    (one,) = planned(estimators=["particle_filter"])
    other = tmp_path / "other"
    Store(other).create()
    run_planned(one, out)
    run_planned(one, other)
    a, b = Store(out).path(one.key), Store(other).path(one.key)
    names = sorted(file.name for file in a.iterdir())
    assert names == sorted(file.name for file in b.iterdir())
    assert {MANIFEST, TIMINGS} < set(names)
    for name in set(names) - {TIMINGS}:
        assert (a / name).read_bytes() == (b / name).read_bytes(), name


def test_a_claimed_run_is_left_to_its_owner(planned, out):
    one, other = planned(estimators=["fake", "ekf"])
    with Store(out).claim(one.key):
        outcomes = execute([one, other], out, Here())
        assert next(outcomes) == (other.key, "ok")
        assert Store(out).state(one.key) == "missing"
    assert list(outcomes) == [(one.key, "ok")]


@pytest.mark.parametrize(
    ("fault", "kind", "reason"),
    [
        (ZeroDivisionError("by nought"), "error", ": odometry at 0.000 s: by nought"),
        (TypeError("of\nours"), "error", "TypeError: of ours"),
        (FglocError("cannot go on"), "error", "cannot go on"),
        (MemoryError(), "memory", "the run needed more memory than was available"),
    ],
)
def test_a_failure_is_stored_with_its_reason_and_tried_again_if_told(
    planned, out, fake, monkeypatch, fault, kind, reason
):
    def fail(*_):
        raise fault

    (one,) = planned()
    with monkeypatch.context() as patch:
        patch.setattr(fake, "process", fail)
        assert run_planned(one, out) == "failed"
    row = Store(out).row(one.key)
    assert (row["status"], row["kind"]) == ("failed", kind)
    assert row["reason"].endswith(reason)
    assert run_planned(one, out) == "failed"
    assert run_planned(one, out, again=True) == "ok"
    assert not (Store(out).path(one.key) / FAILURE).exists()


@pytest.mark.parametrize("how", ["removed", "changed"])
def test_a_log_that_vanishes_or_changes_mid_way_is_a_failure(planned, out, tmp_path, how):
    one, other = planned(estimators=["dead_reckoning", "ekf"])
    run_planned(one, out)
    keys.load_planned.cache_clear()
    if how == "removed":
        shutil.rmtree(tmp_path / "log")
    else:
        (tmp_path / "log" / "odometry.csv").write_text("t_ns,v,w\n")
    assert run_planned(other, out) == "failed"
    assert Store(out).row(other.key)["kind"] == "vanished"
    assert Store(out).state(one.key) == "ok"


@pytest.fixture
def experiment(log, tmp_path, out, runs_here):  # noqa: ARG001
    """``experiment(text)``: an experiment prepared from its file, with the log of a nasty name; its runs are made here."""
    write_native(dataclasses.replace(log, name=NASTY), tmp_path / "log")

    def make(text="estimators = ['fake', 'ekf']", folder=out, **options):
        file = tmp_path / "a.toml"
        file.write_text(f'name = "a"\nlogs = ["log"]\n{text}')
        return prepare(file, out=folder, **options)[1]

    return make


def test_the_table_has_a_row_a_run_and_names_stay_what_they_are(experiment, out, tmp_path):
    told = []
    text = "estimators = ['ekf', {name = 'smoother', label = 'short'}]\nsensors = ['odometry']\n[sweep]\nshort.lag = [1, 2]"
    done = run_experiment(experiment(text), progress=lambda *numbers: told.append(numbers))
    rows = load_results(out)
    assert rows.equals(done.table)
    assert rows["log"].to_list() == [NASTY] * 3
    assert rows["label"].to_list() == ["ekf", "short", "short"]
    assert rows["sensors"].to_list() == ["odometry"] * 3
    assert rows["sweep.short.lag"].to_list() == [None, 1, 2]
    assert set(rows["status"]) == {"ok"}
    assert rows["causal.position_rmse"].null_count() == 0
    assert told == [(0, 3, 0), (1, 3, 0), (2, 3, 0), (3, 3, 0)]
    # nothing was written beside the folder of the results
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.toml", "log", "out"]


def test_failures_are_rows_and_are_tried_again_if_told(experiment, fake, monkeypatch):
    def fail(*_):
        raise FglocError("cannot go on")

    with monkeypatch.context() as patch:
        patch.setattr(fake, "process", fail)
        done = run_experiment(experiment())
    assert done.table["status"].to_list() == ["failed", "ok"]
    assert done.table["reason"].to_list() == ["cannot go on", None]
    assert done.failures == [f"{NASTY}, fake, seed 0: cannot go on"]
    assert experiment().todo() == []
    (again,) = experiment().todo(again=True)
    assert again.label == "fake"
    done = run_experiment(experiment(), again=True)
    assert done.table["status"].to_list() == ["ok", "ok"]


def test_a_damaged_result_is_found_and_done_again(experiment, out):
    first = run_experiment(experiment()).table
    key = first["key"][1]
    (Store(out).path(key) / "estimates.parquet").write_bytes(b"")
    prepared = experiment()
    assert Counter(prepared.states.values()) == {"ok": 1, "damaged": 1}
    assert [one.key for one in prepared.todo()] == [key]
    second = run_experiment(prepared).table
    times = [name for name in first.columns if name.startswith("timing.")]
    assert second.drop(times).equals(first.drop(times))
