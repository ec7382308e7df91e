"""Processes that are started: what comes of their jobs, and that none outlives the one that started it."""

import multiprocessing
import os
import signal
import sys
import time
import traceback
from functools import partial

import pytest

from factorgraph_loc.processes import ProcessDiedError, run_each

# a child, and a child of a child, in native code that never lets go of the interpreter
HOLDING = """
import ctypes, os, sys
from pathlib import Path

from factorgraph_loc.processes import run_each

FOLDER = Path(sys.argv[1])


def tell():
    (FOLDER / "new").write_text("")
    (FOLDER / "new").rename(FOLDER / f"{os.getpid()}.pid")


def hold(_):
    tell()
    ctypes.PyDLL(None).sleep(600)


def nest(_):
    tell()
    list(run_each(hold, [0], 1))
"""
# which needs no guard: its processes do not import it
SCRIPT = """
from holding import nest, run_each

list(run_each(nest, [0], 1))
"""


def test_a_job_that_fails_or_dies_takes_nothing_with_it(monkeypatch):
    monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    jobs = ["6 * 7", "1 / 0", "__import__('os')._exit(3)", "__import__('os').environ['OPENBLAS_NUM_THREADS']"]
    outcomes = dict(run_each(eval, jobs, workers=2))
    assert outcomes[0] == 42
    assert isinstance(outcomes[1], ZeroDivisionError)
    assert 'File "<string>", line 1' in "".join(traceback.format_exception(outcomes[1]))
    assert isinstance(outcomes[2], ProcessDiedError)
    assert outcomes[3] == "1"


def test_each_job_has_a_process_of_its_own():
    jobs = ["__import__('os').getpid()"] * 4
    assert len(set(dict(run_each(eval, jobs, workers=2)).values())) == 4
    dying = ["__import__('os')._exit(3)", "1"]
    outcomes = dict(run_each(eval, dying, workers=1))
    assert isinstance(outcomes[0], ProcessDiedError)
    assert outcomes[1] == 1


@pytest.mark.parametrize("expression", ["lambda: 0", "exec('import ast; raise type(\"Odd\", (Exception,), {})(3)')"])
def test_what_cannot_be_sent_is_told_as_an_exception(expression):
    (outcome,) = dict(run_each(eval, [expression], workers=1)).values()
    assert isinstance(outcome, Exception)
    assert not isinstance(outcome, ProcessDiedError)


def test_a_beat_while_jobs_are_made():
    beats = []
    list(run_each(time.sleep, [1.0], workers=1, beat=partial(beats.append, 1)))
    assert len(beats) >= 2


def test_processes_end_when_the_caller_stops_listening():
    outcomes = run_each(time.sleep, [0.0, 600.0], workers=2)
    assert next(outcomes) == (0, None)
    outcomes.close()
    assert multiprocessing.active_children() == []


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGHUP])
def test_no_process_outlives_the_first_not_even_in_native_code(how, tmp_path, processes):
    (tmp_path / "holding.py").write_text(HOLDING)
    (tmp_path / "script.py").write_text(SCRIPT)
    first = processes.start(sys.executable, tmp_path / "script.py", tmp_path)
    processes.wait_until(lambda: len(list(tmp_path.glob("*.pid"))) == 2)
    children = [int(path.stem) for path in tmp_path.glob("*.pid")]
    assert all(map(processes.lives, children))
    os.kill(first.pid, how)
    first.wait()
    processes.wait_until(lambda: not any(map(processes.lives, children)))
