"""Experiments of processes that are killed, or that work on one store at once."""

import subprocess
import sys
import time
from pathlib import Path

import computed_here
import pytest

from factorgraph_loc.experiments.experiment import experiment

SCRIPT = """
import sys
sys.path.append(sys.argv[1])
from computed_here import Here
from factorgraph_loc.experiments import experiment
experiment.Processes = Here
for out in sys.argv[3:]:
    experiment.experiment(sys.argv[2], out=out)
"""
MANY = """
name = "many"
logs = [{simulate = "office", seeds = "0:8", settings = {drive = {duration = 3}, world = {tags = 0, landmarks = 12}}}]
estimators = ["dead_reckoning"]
sensors = ["odometry"]
"""


@pytest.fixture
def start(tmp_path):
    """``start(out, ...)``: a process that makes many short runs, once into each folder."""
    (tmp_path / "many.toml").write_text(MANY)
    (tmp_path / "script.py").write_text(SCRIPT)

    def run(*outs):
        shared, folders = Path(computed_here.__file__).parent, [tmp_path / out for out in outs]
        return subprocess.Popen([sys.executable, tmp_path / "script.py", shared, tmp_path / "many.toml", *folders])

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


@pytest.mark.usefixtures("runs_here")
def test_two_processes_share_the_work_of_one_experiment_and_one_that_is_killed_loses_nothing(start, tmp_path):
    # what numba compiles in one go is rounded in another way than what it has kept, which the others use
    experiment(tmp_path / "many.toml", out=tmp_path / "compiled")
    killed, other = start("disturbed"), start("disturbed", "undisturbed")
    wait_for_results(tmp_path / "disturbed", 3)
    killed.kill()
    killed.wait()
    assert other.wait(120) == 0
    found = contents(tmp_path / "disturbed")
    assert len(found) == 8 * 9  # runs, and files of each
    assert found == contents(tmp_path / "undisturbed")
    assert list((tmp_path / "disturbed" / "store" / "tmp").iterdir()) == []
