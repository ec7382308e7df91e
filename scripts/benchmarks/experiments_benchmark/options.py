"""Options of the sections, and their experiments."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import tomli_w
from benchmarking.report import Options

from factorgraph_loc.experiments.experiment import Prepared, prepare


@dataclass(frozen=True)
class ExperimentOptions(Options):
    """``short_runs``: of the section speed; ``many_runs``: of a finished experiment; ``kills``: of the section killed."""

    short_runs: int
    many_runs: int
    kills: int


def file_of(folder: Path, name: str, *, runs: int, duration: float, particles: int) -> Path:
    """An experiment of a particle filter with ``runs`` seeds, in an office, on a drive of ``duration`` [s]."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{name}.toml"
    content = {
        "name": name,
        "logs": [{"simulate": "office", "settings": {"drive": {"duration": duration}}}],
        "estimators": [{"name": "particle_filter", "settings": {"particles": particles}}],
        "seeds": f"0:{runs}",
    }
    file.write_text(tomli_w.dumps(content), encoding="utf-8")
    return file


def many(options: ExperimentOptions) -> Prepared:
    """The experiment of many runs, in its present state."""
    file = file_of(options.out, "many", runs=options.many_runs, duration=10.0, particles=20)
    return prepare(file, out=options.out / "many")


def fresh(file: Path, out: Path) -> Prepared:
    """The experiment of a file, from scratch."""
    shutil.rmtree(out, ignore_errors=True)
    return prepare(file, out=out)
