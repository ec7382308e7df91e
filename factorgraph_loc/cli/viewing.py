"""``fgloc view``: shows results and their log in a viewer."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from factorgraph_loc.cli import show
from factorgraph_loc.cli.options import DataRoot, Json, LogOptions, Reader, ReaderOption, RigFile, WorldFile
from factorgraph_loc.errors import InputError
from factorgraph_loc.files.shipped import manifests
from factorgraph_loc.text import listed

if TYPE_CHECKING:
    from factorgraph_loc.exports.particles import Particles
    from factorgraph_loc.exports.runs import StoredRun
    from factorgraph_loc.model.log import Log

SAME = 1e-6  # m between the positions of a run and of its repetition

What = Annotated[
    list[str],
    typer.Argument(
        metavar="RUN...|LOG",
        help="Folders of `fgloc run` or `fgloc compare`, and their log if `fgloc datasets` does not list it; or a log only.",
    ),
]


def view(
    what: What,
    rrd: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a file for the viewer instead of opening it.")
    ] = None,
    particles: Annotated[
        bool, typer.Option("--particles", help="Repeat runs of particle filters to show their particles.")
    ] = False,
    reader: Reader = None,
    reader_option: ReaderOption = None,
    data_root: DataRoot = None,
    rig: RigFile = None,
    world: WorldFile = None,
    json: Json = False,
) -> None:
    """Show a log and its runs over time, in Rerun."""
    from factorgraph_loc.exports import rerun_scene

    log, runs = load_results(what, LogOptions(reader, reader_option, data_root, rig, world))
    clouds = _particles(log, runs) if particles else {}
    if rrd is None:
        rerun_scene.show(log, runs, clouds)
    else:
        rerun_scene.write_rrd(log, runs, rrd, clouds)
    if json:
        show.document(shown(log, runs) | {"file": None if rrd is None else str(rrd)})
    elif rrd is not None:
        show.line(f"wrote {rrd}: open it with rerun {rrd}")


def _particles(log: Log, runs: list[StoredRun]) -> dict[str, Particles]:
    """The particles of the runs that use particles, by name."""
    from factorgraph_loc.experiments.particles import particles_of

    found = {}
    for run in runs:
        with show.progress(run.name, counted=False) as report:
            cloud = particles_of(run, log, partial(report, total=1.0))
        if cloud is not None:
            found[run.name] = cloud
            if cloud.difference > SAME:
                show.note(
                    f"warning: {run.folder.path}: repeated, it differs by up to {cloud.difference:.2g} m, so its particles "
                    "differ too: did the rig, the map or the version change?"
                )
    if not found:
        show.note("warning: no run has particles; only particle_filter and switching use them")
    return found


def shown(log: Log, runs: list[StoredRun]) -> dict[str, Any]:
    """The content of what is shown or written, for ``--json``."""
    return {"log": log.name, "runs": {run.name: str(run.folder.path) for run in runs}}


def load_results(what: list[str], options: LogOptions) -> tuple[Log, list[StoredRun]]:
    """The log named in ``what``, or else the common log of all runs there, and the runs.

    InputError if there are several logs, or if the log of the runs is not known by its name.
    """
    from factorgraph_loc.exports.runs import find_runs, is_results, read_runs

    places = [name for name in what if is_results(Path(name))]
    logs = [name for name in what if name not in places]
    if len(logs) > 1:
        raise InputError(f"{listed(logs)} are {len(logs)} logs, expected one log and folders of its results")
    folders = [run for name in places for run in find_runs(Path(name))]
    named = sorted({folder.log for folder in folders})
    if not logs and len(named) > 1:
        raise InputError(f"{places[0]}: holds runs of {listed(named)}, expected one of these logs to be given too")
    if not logs and named[0] not in manifests():
        raise InputError(
            f"{places[0]}: is of the log {named[0]}, which `fgloc datasets` does not list, expected that log to be given too"
        )
    log = options.load_one(logs[0] if logs else named[0])
    of_log = [folder for folder in folders if folder.log == log.name]
    if folders and not of_log:
        raise InputError(f"{places[0]}: holds runs of {listed(named)}, expected some of the log {log.name}")
    return log, read_runs(of_log, log)
