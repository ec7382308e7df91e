"""An experiment that is killed at random moments and restarted until it is finished, compared with an undisturbed one."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

from benchmarking.report import Report

from experiments_benchmark.options import ExperimentOptions, file_of, fresh
from factorgraph_loc.experiments.store import MANIFEST, TIMINGS

RUNS = 20
COMMAND = "from factorgraph_loc.cli.main import main; main()"


def section(options: ExperimentOptions) -> Report:
    report = Report("killed", options)
    file = file_of(options.out, "killed", runs=RUNS, duration=5.0, particles=50)
    calm = options.out / "calm"
    for _ in range(2):  # the first run compiles
        fresh(file, calm)
        started = time.perf_counter()
        start(file, calm).wait()
        whole = time.perf_counter() - started
    expected = contents(calm)
    rng = random.Random(0)
    kills = {"all processes": 0, "the first process alone": 0}
    finished, again = 0, 0
    while sum(kills.values()) < options.kills:
        folder = options.out / "disturbed"
        fresh(file, folder)
        seen: dict[Path, int] = {}
        while sum(kills.values()) < options.kills:
            process = start(file, folder)
            try:
                process.wait(rng.uniform(0.0, whole))
                break
            except subprocess.TimeoutExpired:
                how = rng.choice(sorted(kills))
                os.killpg(process.pid, signal.SIGKILL) if how == "all processes" else process.kill()
                process.wait()
                kills[how] += 1
            again += done_again(folder, seen)
        if start(file, folder).wait() != 0:
            report.failed.append("an experiment that was started again did not end well")
        again += done_again(folder, seen)
        finished += 1
        found = contents(folder)
        if found != expected:
            wrong = sorted({*found.items()} ^ {*expected.items()})[0][0]
            report.failed.append(f"{wrong} is another than without kills")
    if again:
        report.failed.append(f"{again} results were made again")
    counts = ", ".join(f"{count} times {how}" for how, count in kills.items())
    report.say(
        f"`kill -9` at {sum(kills.values())} random moments ({counts}) within {finished} experiments of {RUNS} runs, each started "
        f"again until it was done: {len(report.failed)} faults. All files but {TIMINGS} are those of "
        f"an undisturbed experiment to the byte, and {again} results were made twice."
    )
    return report


def start(file: Path, folder: Path) -> subprocess.Popen[bytes]:
    """An experiment in a group of processes of its own."""
    command = [sys.executable, "-c", COMMAND, "experiment", "run", file, "-o", folder, "--jobs", "2"]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True)


def contents(folder: Path) -> dict[str, bytes]:
    """The bytes of all results except times."""
    files = sorted((folder / "store").glob("??/*/*"))
    return {str(file.relative_to(folder)): file.read_bytes() for file in files if file.name != TIMINGS}


def done_again(folder: Path, seen: dict[Path, int]) -> int:
    """The number of results written again since the last call; updates ``seen``."""
    now = {path: path.stat().st_mtime_ns for path in (folder / "store").glob(f"??/*/{MANIFEST}")}
    count = sum(now.get(path) != stamp for path, stamp in seen.items())
    seen.update(now)
    return count
