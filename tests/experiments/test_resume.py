"""Experiments of processes that are killed, or that work on one store at once."""

import subprocess
import sys
import time

import pytest

SCRIPT = """
import sys
from pathlib import Path
from factorgraph_loc.experiments.experiment import prepare, run_experiment
run_experiment(prepare(Path(sys.argv[1]), out=Path(sys.argv[2])), jobs=1)
"""
MANY = """
name = "many"
logs = [{simulate = "office", settings = {drive = {duration = 3}}}]
estimators = [{name = "particle_filter", settings = {particles = 20}}]
seeds = "0:8"
"""


@pytest.fixture
def start(tmp_path):
    """``start(out)``: a process that runs many short runs."""
    (tmp_path / "many.toml").write_text(MANY)
    (tmp_path / "script.py").write_text(SCRIPT)

    def run(out):
        return subprocess.Popen([sys.executable, tmp_path / "script.py", tmp_path / "many.toml", tmp_path / out])

    return run


def contents(out):
    """The bytes of all results but times."""
    return {
        str(file.relative_to(out)): file.read_bytes()
        for file in sorted((out / "store").glob("??/*/*"))
        if file.name != "timings.json"
    }


def wait_for_results(out, count):
    deadline = time.monotonic() + 60.0
    while len(list((out / "store").glob("??/*"))) < count and time.monotonic() < deadline:
        time.sleep(0.01)


def test_two_processes_share_the_work_of_one_experiment_and_one_that_is_killed_loses_nothing(start, tmp_path):
    # what numba compiles in one go is rounded in another way than what it has kept, which the others use
    assert start("compiled").wait(120) == 0
    killed, other = start("disturbed"), start("disturbed")
    wait_for_results(tmp_path / "disturbed", 3)
    killed.kill()
    killed.wait()
    undisturbed = start("undisturbed")
    assert [process.wait(120) for process in (other, undisturbed)] == [0, 0]
    found = contents(tmp_path / "disturbed")
    assert len(found) == 8 * 9  # runs, and files of each
    assert found == contents(tmp_path / "undisturbed")
    assert list((tmp_path / "disturbed" / "store" / "tmp").iterdir()) == []
