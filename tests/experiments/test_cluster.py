"""An experiment on a real cluster of two worker processes: nothing is lost with a worker, nothing is stored twice."""

import json
import os
import signal
import sys
from collections import Counter

import pytest
from typer.testing import CliRunner

from factorgraph_loc.cli.app import app
from factorgraph_loc.errors import InputError
from factorgraph_loc.experiments import cluster
from factorgraph_loc.experiments.cluster import Cluster
from factorgraph_loc.experiments.execute import execute
from factorgraph_loc.experiments.experiment_file import Limits, read_experiment
from factorgraph_loc.experiments.plan import plan
from factorgraph_loc.experiments.store import Store

distributed = pytest.importorskip("distributed")
EXPERIMENT = """
name = "drives"
logs = [{simulate = "office", seeds = "0:%d", settings = {drive = {duration = 10.0}, world = {tags = 0, landmarks = 12}}}]
estimators = ["dead_reckoning", "ekf"]
sensors = ["odometry", "bearing_range"]
"""


@pytest.fixture(scope="module")
def workers():
    """A scheduler with two workers, each a process of its own."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0", memory_limit=0
    ) as made:
        yield made


@pytest.fixture
def planned(tmp_path):
    """``planned(n)``: the runs of n short drives, two a drive, and the folder for their results."""

    def make(drives):
        (tmp_path / "drives.toml").write_text(EXPERIMENT % drives)
        folder = tmp_path / "out"
        Store(folder).create()
        experiment = read_experiment(tmp_path / "drives.toml")
        return plan(experiment, tmp_path, Store(folder).folder, None), folder

    return make


@pytest.fixture
def stored(monkeypatch):
    """How often the results of each run were stored."""
    count = Counter()
    put = Store.put

    def counted(self, key, files):
        count[key] += 1
        put(self, key, files)

    monkeypatch.setattr(Store, "put", counted)
    return count


def test_a_worker_that_is_killed_loses_no_run_and_none_is_stored_twice(workers, planned, stored):
    runs, folder = planned(4)
    outcomes = []
    for outcome in execute(runs, folder, Cluster(workers.scheduler_address, Limits())):
        outcomes.append(outcome)
        if len(outcomes) == 3:  # both are at work, with more runs than they compute
            os.kill(workers.workers[0].pid, signal.SIGKILL)
    keys = {run.key for run in runs}
    assert len(runs) == len(keys) == 8
    assert [state for _, state in outcomes] == ["ok"] * 8
    assert stored == dict.fromkeys(keys, 1)
    store = Store(folder)
    assert all(store.state(key) == "ok" for key in keys)
    assert not list((store.folder / "claims").iterdir())


def test_a_run_that_another_process_has_is_waited_for(workers, planned, stored):
    runs, folder = planned(1)
    claim = Store(folder).claim(runs[0].key)
    assert claim.__enter__()
    outcomes = execute(runs, folder, Cluster(workers.scheduler_address, Limits()))
    assert next(outcomes) == (runs[1].key, "ok")
    assert not stored[runs[0].key]
    claim.__exit__(None, None, None)
    assert list(outcomes) == [(runs[0].key, "ok")]


def test_a_run_that_takes_too_long_is_a_failure_and_its_worker_begins_anew(workers, planned):
    runs, folder = planned(1)
    before = {worker.pid for worker in workers.workers.values()}
    list(execute(runs[:1], folder, Cluster(workers.scheduler_address, Limits(time=1e-3))))
    row = Store(folder).row(runs[0].key)
    assert (row["status"], row["kind"], row["reason"]) == ("failed", "timeout", "it took more than 0.001 s")
    assert {worker.pid for worker in workers.workers.values()} != before


def test_the_command_takes_a_scheduler(workers, planned, tmp_path):
    runs, folder = planned(1)
    command = ["experiment", "run", str(tmp_path / "drives.toml"), "-o", str(folder), "--scheduler"]
    done = CliRunner().invoke(app, [*command, workers.scheduler_address, "--json"])
    assert done.exit_code == 0, done.output
    assert {row["key"] for row in json.loads(done.stdout)["runs"]} == {run.key for run in runs}
    both = CliRunner().invoke(app, [*command, workers.scheduler_address, "--jobs", "2"])
    assert both.exit_code == 2
    assert "remove one of them" in both.stderr


def test_workers_with_other_code_are_refused(workers, planned, stored, monkeypatch):
    runs, folder = planned(1)
    monkeypatch.setattr(cluster, "software_digest", lambda: "of another day")
    with pytest.raises(InputError, match="another version of the code"):
        list(execute(runs, folder, Cluster(workers.scheduler_address, Limits())))
    assert not stored
    assert not list((Store(folder).folder / "claims").iterdir())


def test_a_run_that_ends_its_workers_is_a_failure_and_the_others_go_on(workers, planned, monkeypatch):
    runs, folder = planned(1)
    monkeypatch.setattr(workers.scheduler, "allowed_failures", 0)
    with monkeypatch.context() as patch:
        patch.setattr(cluster, "make", lambda *_: os._exit(1))
        ((_, state),) = execute(runs[:1], folder, Cluster(workers.scheduler_address, Limits()))
    assert state == "failed"
    assert Store(folder).row(runs[0].key)["kind"] == "killed"
    with distributed.Client(workers) as client:
        client.wait_for_workers(1)  # the one that died is replaced
    others = list(execute(runs[1:], folder, Cluster(workers.scheduler_address, Limits())))
    assert [state for _, state in others] == ["ok"]


def test_no_scheduler_and_no_package_are_told_in_a_line(planned, monkeypatch):
    runs, folder = planned(1)
    monkeypatch.setattr(cluster, "CONNECT", 0.5)
    with pytest.raises(InputError, match="no scheduler answers there"):
        list(execute(runs, folder, Cluster("tcp://127.0.0.1:9", Limits())))
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install 'factorgraph-loc\[cluster\]'"):
        list(execute(runs, folder, Cluster("tcp://127.0.0.1:9", Limits())))
