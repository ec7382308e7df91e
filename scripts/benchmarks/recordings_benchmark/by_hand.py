"""From the files of each recording to a scored table with the commands of the docs alone: how many, and how long they take."""

from __future__ import annotations

import csv
import json
import resource
import shutil
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarking.report import Options, Report

from recordings_benchmark.listed import RECORDINGS, Recording

REASONS = ("to score against", "never localized")
LIST = Path(__file__).with_name("by_hand.toml")


@dataclass(frozen=True)
class Job:
    recording: Recording
    folder: Path
    out: Path
    files: dict[str, str]
    commands: tuple[str, ...]


@dataclass(frozen=True)
class Done:
    """``seconds`` of processor time of all commands together; ``result``: the errors, or why there are none."""

    seconds: float
    result: str


def jobs_of(data: Path, out: Path) -> list[Job]:
    """What is written and typed for each recording."""
    content = tomllib.loads(LIST.read_text(encoding="utf-8"))
    found = []
    for recording in RECORDINGS:
        name = recording.name
        places = {str(i): file.name for i, file in enumerate(recording.files, start=1)}
        places["start"] = content["starts"].get(name, "")
        files = content["files"].get(content["like"].get(name, name), {})
        commands = content["kind"][content["recordings"][name]]["commands"]
        filled = {file: _filled(text, places) for file, text in files.items()}
        typed = tuple(_filled(command, places) for command in commands)
        found.append(Job(recording, data.resolve(), out / "by_hand" / name, filled, typed))
    return found


def section(options: Options) -> Report:
    """The table, a row per recording."""
    assert options.data_root is not None
    kinds = tomllib.loads(LIST.read_text(encoding="utf-8"))
    report = Report("by_hand", options)
    jobs = jobs_of(options.data_root, options.out)
    found = report.collect(measured, jobs, [job.recording.name for job in jobs])
    rows = []
    for i, done in sorted(found.items()):
        job = jobs[i]
        reason = kinds["kind"][kinds["recordings"][job.recording.name]].get("reason", "")
        typed = "<br>".join(f"`{command.replace('|', '')}`" for command in job.commands)
        written = ", ".join(job.files) or "-"
        row = (job.recording.name, written, typed or "-", str(len(job.commands)))
        rows.append((*row, f"{done.seconds / 60.0:.2f}" if job.commands else "-", done.result or reason))
    report.table(("log", "files to write", "commands", "number", "processor [min]", "position RMSE [m]"), rows)
    return report


def measured(job: Job) -> Done:
    """Write the files and execute the commands in a folder of their own. RuntimeError with the last line of one that fails."""
    shutil.rmtree(job.out, ignore_errors=True)
    job.out.mkdir(parents=True)
    for file in job.recording.files:
        shutil.copy(job.folder / file.name, job.out / file.name)
    for name, text in job.files.items():
        (job.out / name).write_text(text.lstrip(), encoding="utf-8")
    start = "from factorgraph_loc.cli.main import main; main()"
    program = f"fgloc() {{ '{sys.executable}' -c '{start}' \"$@\"; }}; "
    told, before = "", _processor_time()
    for command in job.commands:
        done = subprocess.run(
            ["bash", "-c", program + command], cwd=job.out, capture_output=True, text=True, check=False
        )
        if done.returncode != 0:
            raise RuntimeError(f"{command}: {done.stderr.strip().splitlines()[-1]}")
        told += done.stdout
    return Done(_processor_time() - before, _result(job.out / "out", told))


def _processor_time() -> float:
    """Seconds of the programs that this one started and that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _filled(text: str, places: dict[str, str]) -> str:
    for name, place in places.items():
        text = text.replace(f"{{{name}}}", place)
    return text


def _result(out: Path, told: str) -> str:
    if (out / "score.json").is_file():
        return f"{json.loads((out / 'score.json').read_text())['ape.position_rmse']:.3f} after sim3"
    if not (out / "results.csv").is_file():
        return ""
    with (out / "results.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    scored = [row for row in rows if row["final.position_rmse"]]
    if not scored:
        lines = [*told.splitlines(), *(line for row in rows for line in row["warnings"].splitlines())]
        return next((line.partition(": ")[2] for line in lines if any(reason in line for reason in REASONS)), "")
    return "; ".join(f"{row['estimator']} {_errors(row)}" for row in scored)


def _errors(row: dict[str, Any]) -> str:
    causal, final = (row[f"{kind}.position_rmse"] for kind in ("causal", "final"))
    return f"{float(causal):.3f} / {float(final):.3f}" if causal else f"- / {float(final):.3f}"
