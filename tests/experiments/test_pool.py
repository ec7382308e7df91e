"""Worker processes: what becomes of a run that takes too much, of a worker that dies, and of an experiment that is stopped."""

import multiprocessing
import os
import signal
import threading
import time

import pytest

from factorgraph_loc.experiments import execute as pool
from factorgraph_loc.experiments.execute import Processes, execute
from factorgraph_loc.experiments.experiment_file import Experiment, Limits
from factorgraph_loc.experiments.plan import plan
from factorgraph_loc.experiments.store import Store

SHORT = {"simulate": "office", "settings": {"drive": {"duration": 4}}}
LONG = {"simulate": "office", "settings": {"name": "long", "drive": {"duration": 10}}}
HUGE = {"name": "particle_filter", "label": "huge", "settings": {"particles": 1_000_000}}


@pytest.fixture
def planned(tmp_path):
    """``planned(logs, estimators)``: the runs; results go to the folder ``out``."""
    Store(tmp_path / "out").create()

    def make(logs, estimators):
        experiment = Experiment.model_validate({"name": "a", "logs": logs, "estimators": estimators})
        return plan(experiment, tmp_path, tmp_path / "out" / "store")

    return make


def test_a_run_that_takes_too_long_or_too_much_memory_fails_and_the_others_go_on(planned, tmp_path):
    runs = planned([LONG], [HUGE]) + planned([SHORT], ["dead_reckoning"])
    store = Store(tmp_path / "out")
    outcomes = execute(runs, tmp_path / "out", Processes(1, Limits(memory=450.0)))
    assert [state for _, state in outcomes] == ["failed", "ok"]
    row = store.row(runs[0].key)
    assert (row["kind"], row["reason"]) == ("memory", "its process used more than 450 MB of memory")
    runs = planned([LONG], [{**HUGE, "label": "endless", "settings": {"particles": 900_000}}])
    list(execute(runs, tmp_path / "out", Processes(1, Limits(time=0.5))))
    row = store.row(runs[0].key)
    assert (row["kind"], row["reason"]) == ("timeout", "it took more than 0.5 s")
    assert [list((store.folder / name).iterdir()) for name in ("tmp", "claims")] == [[], []]


def kill_worker(when):
    """In a thread: kill the worker of this process once ``when()`` says that it has a run."""

    def kill():
        while not when():
            time.sleep(0.01)
        (child,) = multiprocessing.active_children()
        os.kill(child.pid, signal.SIGKILL)

    threading.Thread(target=kill, daemon=True).start()


@pytest.mark.parametrize("attempts", [2, 1])
def test_a_run_whose_worker_is_killed_is_tried_once_more(planned, tmp_path, monkeypatch, attempts):
    monkeypatch.setattr(pool, "ATTEMPTS", attempts)
    (run,) = planned([LONG], [{"name": "particle_filter", "settings": {"particles": 500}}])
    store = Store(tmp_path / "out")
    kill_worker((store.folder / "claims" / run.key).exists)
    ((_, state),) = execute([run], tmp_path / "out", Processes(1, Limits()))
    if attempts == 2:
        assert state == "ok"
    else:
        assert state == "failed"
        assert store.row(run.key)["kind"] == "killed"


def test_workers_end_when_the_caller_stops_listening(planned, tmp_path):
    runs = planned([SHORT], ["dead_reckoning"]) + planned([LONG], [HUGE])
    outcomes = execute(runs, tmp_path / "out", Processes(1, Limits()))
    assert next(outcomes)[1] == "ok"
    outcomes.close()
    assert multiprocessing.active_children() == []
    assert Store(tmp_path / "out").state(runs[1].key) == "missing"
