"""Processes that try cases one after the other, with limits of memory and time; restarted if one ends or hangs."""

from __future__ import annotations

import faulthandler
import json
import os
import re
import resource
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

from fuzzing.compilation import CompilationClock, Seconds, compiled
from fuzzing.verdicts import Verdict

SECONDS = 8.0  # of processor time, or of blocking; compilation does not count
AT_MOST = 60.0  # s of wall-clock time, on a busy machine
STARTING = 900.0  # s, for imports, compilation and seeds
MEMORY = 2 * 10**9  # bytes, in addition to those of a process that is ready
LIBRARIES = ("OPENBLAS", "OMP", "NUMBA", "RAYON")
ONE_THREAD = {"POLARS_MAX_THREADS": "1"} | {f"{name}_NUM_THREADS": "1" for name in LIBRARIES}
TICKS = os.sysconf("SC_CLK_TCK")


class Worker:
    """A process that tries cases below ``root``; ``name`` identifies it there. ``command``: the process, which follows the
    protocol of :func:`_serve`; ``seconds``: limit for a case."""

    def __init__(
        self, root: Path, name: str = "w0", command: Sequence[str] = ("-m", "fuzzing.workers"), seconds: float = SECONDS
    ) -> None:
        self.root, self.name = root, name
        self._command, self._seconds = command, seconds
        self.case_folder = root / name
        self._process: subprocess.Popen[str] | None = None
        self._said, self._compiled = root / f"{name}.stderr", root / f"{name}.compiled"

    def try_cases(self, kind: str, seed: int, first: int, count: int) -> Iterator[tuple[int, Verdict]]:
        """The verdict of each case by number. The files of a case exist until the next is requested."""
        number = first
        while number < first + count:
            process = self._running()
            self._tell({"kind": kind, "seed": seed, "number": number})
            if (failed := self._wait(process, STARTING)) is not None:  # the kind is ready, or could not be
                self.close()
                yield number, Verdict("bad", failed, "while the seed was made", self._last_words())
                return
            self._tell({})
            if (failed := self._wait(process, self._seconds)) is None:
                yield number, Verdict(**json.loads(self._line))
            else:
                words, place = self._last_words(), self._place()
                self.close()
                yield number, Verdict("bad", failed, place, words)
            number += 1

    def close(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def _running(self) -> subprocess.Popen[str]:
        if self._process is None or self._process.poll() is not None:
            self.root.mkdir(parents=True, exist_ok=True)
            scripts = str(Path(__file__).parents[1])
            places = [scripts, str(Path(scripts).parent), os.environ.get("PYTHONPATH", "")]
            self._compiled.unlink(missing_ok=True)
            environment = os.environ | ONE_THREAD | {"PYTHONPATH": os.pathsep.join(filter(None, places))}
            with self._said.open("a") as said:
                self._process = subprocess.Popen(
                    [sys.executable, *self._command, str(self.root), self.name],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=said,
                    text=True,
                    env=environment,
                )
        return self._process

    def _tell(self, what: dict[str, object]) -> None:
        assert self._process is not None
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(what) + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            pass  # it has ended, as waiting for its answer shows

    def _wait(self, process: subprocess.Popen[str], seconds: float) -> str | None:
        """Wait for a line; None once it has arrived, else the failure."""
        assert process.stdout is not None
        began = self._times(process)
        while True:
            if select.select([process.stdout], [], [], 0.25)[0]:
                self._line = process.stdout.readline()
                if self._line:
                    return None
                code = process.wait()
                return f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with {code}"
            now = self._times(process)
            waited, worked = now.wall - began.wall, now.processor - began.processor
            if (
                worked > seconds
                or waited > max(AT_MOST, seconds)
                or (waited > seconds and worked < 0.1 * waited and _sleeps(process.pid))
            ):
                process.send_signal(signal.SIGUSR1)  # it prints its traceback
                time.sleep(0.3)
                return f"hangs for {waited:.0f} s"

    def _times(self, process: subprocess.Popen[str]) -> Seconds:
        """Time used until now, without that of compilation."""
        used = _processor_seconds(process.pid)
        compiling = compiled(self._compiled, used)
        return Seconds(used - compiling.processor, time.monotonic() - compiling.wall)

    def _last_words(self) -> str:
        return self._said.read_text(errors="replace")[:3000] if self._said.exists() else ""

    def _place(self) -> str:
        """The innermost line of the project in its output."""
        found = re.findall(r'File "[^"]*?((?:factorgraph_loc|factors)/[^"]+)", line (\d+) in (\w+)', self._last_words())
        return "{}:{} {}".format(*found[0]) if found else "outside of the project"


def _processor_seconds(pid: int) -> float:
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / TICKS


def _sleeps(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "S"
    except OSError:
        return False


def _limit_memory() -> None:
    """Limit further memory to this amount."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * os.sysconf("SC_PAGE_SIZE") + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))


def _serve(root: Path, name: str, asked: IO[str], answers: IO[str]) -> None:
    """Serve requests: one line per case, and one line for each answer."""
    from fuzzing.cases import Bench, Case  # noqa: PLC0415

    CompilationClock(root / f"{name}.compiled")  # numba keeps it
    bench = Bench(root, name)
    faulthandler.register(signal.SIGUSR1, all_threads=False)
    ready: set[str] = set()
    for line in asked:
        case = Case(**json.loads(line))
        if case.kind not in ready:
            resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
            bench.prepare(case.kind)
            ready.add(case.kind)
        _limit_memory()  # per case, without what libraries keep from previous ones
        print("ready", file=answers, flush=True)
        os.ftruncate(2, 0)
        asked.readline()
        verdict = bench.try_case(case)
        print(json.dumps(verdict.plain()), file=answers, flush=True)


if __name__ == "__main__":
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # output of libraries is not an answer
    faulthandler.enable(all_threads=False)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _serve(Path(sys.argv[1]), sys.argv[2], sys.stdin, answers)
