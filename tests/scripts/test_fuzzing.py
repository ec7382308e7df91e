"""The fuzzer: its cases are the same each time, its damage stays what it says, its processes survive; and a first round of it."""

import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from fuzzing import damage
from fuzzing.campaign import batches, shares_of
from fuzzing.cases import ESTIMATORS, KINDS, LOCALIZER, Case
from fuzzing.uses import FORMATS
from fuzzing.verdicts import judge
from fuzzing.workers import Worker

from factorgraph_loc.errors import InputError

FILES = {
    "run.toml": b'name = "x"\n[start]\nx = 1.0\n',
    "a.csv": b"t_ns,v,w\n0,1.0,0.0\n1000,2.0,0.5\n",
    "b.json": b'{"a": [1, 2], "b": {"c": null}}',
    "c.png": b"\x89PNG\r\n\x1a\n" + bytes(60),
}


def test_a_case_is_the_same_whenever_it_is_made():
    def made(number):
        return damage.damaged(FILES, Case("toml", 7, number).generator())

    assert [made(k) for k in range(200)] == [made(k) for k in range(200)]
    assert len({repr(made(k)) for k in range(200)}) > 150


def test_files_are_damaged_in_every_way(tmp_path):
    seen = Counter()
    for k in range(600):
        for name, content in damage.damaged(FILES, np.random.default_rng(k)).items():
            seen[name] += 1
            seen["special" if isinstance(content, damage.Special) else "bytes"] += 1
            damage.write(tmp_path / "case", {**FILES, name: content})
    assert set(seen) == {*FILES, "special", "bytes"}
    assert damage.read(tmp_path / "case").keys() <= FILES.keys() | {f"{name}/" for name in FILES}


def test_verdicts():
    def fail(error):
        def call():
            raise error

        return judge(call)

    assert judge(lambda: None).outcome == "read"
    assert fail(InputError("x.csv:3: t is 'a', expected a number")).outcome == "refused"
    for text in ("two\nlines", "x" * 5000, "\x1b[31m", ""):
        error = InputError("")
        error.args = (text,)  # as an error that does not look after itself
        assert fail(error).outcome == "bad"
    assert fail(KeyError("a")).error == "KeyError"
    assert fail(SystemExit(3)).outcome == "bad"


def test_batches_keep_the_proportion_of_kinds():
    shares = shares_of(KINDS)
    assert shares[LOCALIZER] == 4 * shares[ESTIMATORS]
    made = Counter()
    for batch in batches(KINDS, shares, 12_500):
        assert batch.first == made[batch.kind]
        made[batch.kind] += batch.count
    assert made[LOCALIZER] == 2000
    assert made[ESTIMATORS] == 500
    assert abs(made.total() - 12_500) < len(KINDS)


STUB = """
import json, os, signal, sys, time
for line in sys.stdin:
    print("ready", flush=True)
    number = json.loads(line)["number"]
    sys.stdin.readline()
    if number == 1:
        os.kill(os.getpid(), signal.SIGSEGV)
    if number == 2:
        time.sleep(1000.0)
    if number == 3:
        sys.exit(7)
    print('{"outcome": "read"}', flush=True)
"""


def test_processes_that_die_or_wait_for_ever_are_reported_and_the_next_case_is_tried(tmp_path):
    worker = Worker(tmp_path, command=("-c", STUB), seconds=0.5)
    found = [verdict for _, verdict in worker.try_cases("toml", 0, 0, 5)]
    worker.close()
    assert [verdict.outcome for verdict in found] == ["read", "bad", "bad", "bad", "read"]
    killed, hanging, ended = (verdict.error for verdict in found[1:4])
    assert (killed, ended) == ("killed by SIGSEGV", "ended with 7")
    assert hanging.startswith("hangs")


COMPILING = """
import sys, time
from pathlib import Path
from fuzzing.compilation import CompilationClock
root, name = sys.argv[-2:]
clock = CompilationClock(Path(root, f"{name}.compiled"))
def work(seconds):
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass
for line in sys.stdin:
    print("ready", flush=True)
    sys.stdin.readline()
    if '"number": 0' in line:
        clock.on_start(None)
        clock.on_start(None)
        work(0.6)
        clock.on_end(None)
        work(0.6)
        clock.on_end(None)
    else:
        work(1000.0)
    print('{"outcome": "read"}', flush=True)
"""


def test_the_time_of_compilation_does_not_count(tmp_path):
    worker = Worker(tmp_path, command=("-c", COMPILING), seconds=0.3)
    compiled, hanging = (verdict for _, verdict in worker.try_cases("toml", 0, 0, 2))
    worker.close()
    assert compiled.outcome == "read"
    assert hanging.error.startswith("hangs")


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    made = Worker(tmp_path_factory.mktemp("fuzz"))
    yield made
    made.close()


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != ESTIMATORS])
def test_a_first_round(kind, shared):
    """A few cases of each kind; all others are for ``scripts/fuzz``."""
    count = 12 if kind in FORMATS else 12 if kind == LOCALIZER else 4
    found = shared.try_cases(kind, 1, 0, count)
    assert not [f"{Case(kind, 1, k).command}: {v.error} at {v.place}" for k, v in found if v.outcome == "bad"]


def test_what_a_fuzzer_that_was_ended_leaves_is_swept_by_the_next(tmp_path, processes, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    fuzz = (sys.executable, Path(__file__).parents[2] / "scripts" / "fuzz", "toml", "--keep", tmp_path / "kept")
    running = processes.start(*fuzz, "--case", 0)
    processes.wait_until(lambda: list(tmp_path.glob(".fz*/*")))
    running.terminate()
    running.wait()
    assert list(tmp_path.glob(".fz*/*"))
    assert processes.start(*fuzz, "--cases", 0).wait(processes.PATIENCE) == 0
    assert not list(tmp_path.iterdir())
