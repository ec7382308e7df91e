"""A command ended by a signal at a random moment, the files it leaves, and the result of the same command afterwards."""

from __future__ import annotations

import io
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import polars as pl

FGLOC = (sys.executable, "-c", "from factorgraph_loc.cli.main import main; main()")
TEMPORARY = re.compile(r"\..*\.fgloc-[0-9a-f]{8}(\..*)?")
HOWS = {  # signal, and whether all processes of the command get it
    "KILL": (signal.SIGKILL, False),
    "TERM": (signal.SIGTERM, False),
    "HUP": (signal.SIGHUP, False),
    "INT": (signal.SIGINT, True),  # as sent by a terminal
    "KILL of all": (signal.SIGKILL, True),
}
EXPERIMENT = """
name = "small"
logs = [{simulate = "office", settings = {drive = {duration = 5}}}]
estimators = ["dead_reckoning", "ekf", {name = "particle_filter", settings = {particles = 200}}]
seeds = "0:2"
"""
GONE = 60.0  # s after which a living process is an orphan, even on a busy machine


@dataclass
class Command:
    """``words``: arguments with OUT; the files of ``out`` are checked. ``timed``: those that differ from run to run."""

    name: str
    words: tuple[object, ...]
    seconds: float = 0.0
    expected: dict[str, bytes] = field(default_factory=dict)
    timed: set[str] = field(default_factory=set)


@dataclass(frozen=True)
class Trial:
    """The result of one signal. ``ended``: seconds until no process was left; ``faults``: if any."""

    command: str
    how: str
    after: float
    ended: float
    code: int
    left: int
    faults: tuple[str, ...]


class Bench:
    """A folder with a log of ``seconds`` duration, in which commands are tried."""

    def __init__(self, folder: Path, seconds: float) -> None:
        self.folder = folder
        shutil.rmtree(folder, ignore_errors=True)
        (folder / "tmp").mkdir(parents=True)
        (folder / "e.toml").write_text(EXPERIMENT, encoding="utf-8")
        self._environment = os.environ | {"TMPDIR": str(folder / "tmp"), "FGLOC_CACHE": str(folder / "cache")}
        self.run("simulate", "office", "-o", folder / "log", "--duration", seconds)

    def commands(self) -> list[Command]:
        """The commands; OUT stands for a folder that is new each time."""
        log, two = self.folder / "log", ("--jobs", 2)
        estimators = "dead_reckoning,ekf,particle_filter"
        few = ("--set", "particle_filter.particles=200")
        return [
            Command("experiment run", ("experiment", "run", self.folder / "e.toml", "-o", "OUT", *two)),
            Command("compare", ("compare", log, "-e", estimators, *few, "-o", "OUT", *two)),
            Command("calibrate", ("calibrate", log, "-o", "OUT/learnt.rig.toml")),
            Command("map", ("map", log, "-o", "OUT/made.world.toml")),
            Command("convert", ("convert", log, "OUT/copy")),
        ]

    def measure(self, command: Command) -> None:
        """Run it undisturbed, twice, for its duration, its files, and which of them contain times."""
        found = []
        for _ in range(2):
            out = self._new()
            started = time.monotonic()
            self.run(*command.words, out=out)
            command.seconds = time.monotonic() - started
            found.append(contents(out))
        command.expected = found[0]
        command.timed = {name for name in found[0] if found[0][name] != found[1].get(name)}

    def try_signal(self, command: Command, how: str, after: float) -> Trial:
        """Send a signal after ``after`` seconds, check the files, and repeat the command."""
        out, faults = self._new(), []
        process = self.start(*command.words, out=out)
        try:
            process.wait(after)
        except subprocess.TimeoutExpired:
            number, whole = HOWS[how]
            (os.killpg if whole else os.kill)(process.pid, number)
        sent = time.monotonic()
        said = process.communicate()[1].splitlines()
        while members(process.pid) and time.monotonic() < sent + GONE:
            time.sleep(0.01)
        ended = time.monotonic() - sent
        if orphans := members(process.pid):
            faults.append(f"{len(orphans)} processes live")
            os.killpg(process.pid, signal.SIGKILL)
        code = process.returncode
        asked = [line for line in said if not line.startswith("warning: ")]
        if "KILL" not in how and len(asked) > 1:
            faults.append(f"said {len(asked)} lines: {asked[-1]}")
        if code not in (0, 128 + HOWS[how][0], -HOWS[how][0]):
            faults.append(f"exit code {code}")
        left = len(self.temporary())
        if "KILL" not in how and code > 0 and left:
            faults.append(f"{left} temporary files left")
        faults += [f"{name} is half-written" for name in self._damaged(command, out)]
        if code != 0:
            faults += self._again(command, out)
        return Trial(command.name, how, after, ended, code, left, tuple(faults))

    def start(self, *words: object, out: Path | None = None) -> subprocess.Popen[str]:
        """The command in a group of processes of its own."""
        line = [*FGLOC, *(str(word).replace("OUT", str(out)) for word in words)]
        return subprocess.Popen(
            line,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            env=self._environment,
            start_new_session=True,
            preexec_fn=_ordinary_signals,  # noqa: PLW1509 - there are no threads here
        )

    def run(self, *words: object, out: Path | None = None) -> None:
        """Run the command undisturbed; RuntimeError if it fails."""
        process = self.start(*words, out=out)
        said = process.communicate()[1]
        if process.returncode != 0:
            raise RuntimeError(f"exit code {process.returncode}: {said.strip()}")

    def temporary(self) -> list[Path]:
        """Remaining temporary files and folders."""
        return [path for path in self.folder.rglob(".*") if TEMPORARY.fullmatch(path.name)]

    def _again(self, command: Command, out: Path) -> list[str]:
        """Faults after the same command was repeated."""
        process = self.start(*command.words, out=out)
        said = process.communicate()[1]
        faults = []
        if (
            process.returncode != 0 and "already" not in said and "exists" not in said
        ):  # complete results are not repeated
            faults.append(f"again: exit code {process.returncode}: {said.strip()[-200:]}")
        found = contents(out)
        for name in sorted({*found} ^ {*command.expected}):
            faults.append(f"again: {name} is {'new' if name in found else 'missing'}")
        for name in sorted({*found} & {*command.expected} - command.timed):
            if found[name] != command.expected[name]:
                faults.append(f"again: {name} differs")
        faults += [f"again: {path.name} stays" for path in self.temporary()]
        return faults

    def _damaged(self, command: Command, out: Path) -> list[str]:
        """Files whose content is neither as expected nor, where it may differ, complete."""
        wrong = []
        for name, content in contents(out).items():
            partial = name in command.timed or name == "results.parquet" or name not in command.expected
            if content == HALF or not (partial or content == command.expected[name]):
                wrong.append(name)
        return wrong

    def _new(self) -> Path:
        """An empty folder for the results of one trial; previous ones are removed."""
        out = self.folder / "out"
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        return out


HALF = b"is half-written"


def contents(folder: Path) -> dict[str, bytes]:
    """The files below a folder, except hidden ones, and without times where a format contains them."""
    found = {}
    for path in sorted(folder.rglob("*")):
        inside = path.relative_to(folder)
        if path.is_file() and not any(part.startswith(".") for part in inside.parts) and "claims" not in inside.parts:
            found[str(inside)] = _untimed(path)
    return found


def _untimed(path: Path) -> bytes:
    content = path.read_bytes()
    try:
        if path.suffix == ".json":
            values = json.loads(content)
            return json.dumps({k: v for k, v in values.items() if not k.startswith("timing.")}).encode()
        if path.suffix == ".parquet":
            table = pl.read_parquet(io.BytesIO(content))
            times = [name for name in table.columns if name.startswith("timing.") or name == "update_ms"]
            return table.drop(times).write_csv().encode()
        if path.suffix == ".html" and not content.rstrip().endswith(b"</html>"):
            return HALF
    except (ValueError, pl.exceptions.PolarsError):
        return HALF
    return content


def members(leader: int) -> list[int]:
    """The running processes of a group."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, group = path.read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()[:3]
        except (OSError, ValueError):
            continue
        if int(group) == leader and state not in "ZX":
            found.append(int(path.parent.name))
    return found


def _ordinary_signals() -> None:
    for one in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(one, signal.SIG_DFL)


def drawn(commands: list[Command], each: int, seed: int) -> list[tuple[Command, str, float]]:
    """The trials of a seed: ``each`` per command, with the kinds of signals in turn, at moments within its usual duration."""
    rng = random.Random(seed)
    hows = list(HOWS)
    return [
        (command, hows[i % len(hows)], rng.uniform(0.0, command.seconds)) for command in commands for i in range(each)
    ]
