"""``fgloc view`` and ``fgloc export``: results and their log in a viewer, and in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from factorgraph_loc.cli import show
from factorgraph_loc.cli.options import Json, LogOptions, takes_options
from factorgraph_loc.exports.rerun_viewer import LOOPBACK

if TYPE_CHECKING:
    from factorgraph_loc.exports.runs import StoredRun
    from factorgraph_loc.model.log import Log

What = Annotated[
    list[str],
    typer.Argument(
        metavar="RUN...|LOG",
        help="Folders of `fgloc run` or `fgloc compare`, and their log if `fgloc datasets` does not list it; or a log only.",
    ),
]


@takes_options
def view(
    what: What,
    rrd: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a file for the viewer instead of opening it.")
    ] = None,
    bind: Annotated[
        str,
        typer.Option(
            metavar="ADDRESS",
            help="IP address that the viewer listens on, without credentials; only this machine reaches the default one.",
        ),
    ] = LOOPBACK,
    *,
    source: LogOptions,
    json: Json = False,
) -> None:
    """Show a log and its runs over time, in Rerun.

    Example: fgloc view out/plaza1
    """
    from factorgraph_loc.api import results

    log, runs = results.stored(what, source.load_one)
    results.show(log, runs, rrd, bind)
    if json:
        show.document(shown(log, runs) | {"file": None if rrd is None else str(rrd)})
    elif rrd is not None:
        show.line(f"wrote {rrd}: open it with rerun --bind {LOOPBACK} {rrd}")


def shown(log: Log, runs: list[StoredRun]) -> dict[str, Any]:
    """The content of the view or the written files, for ``--json``."""
    return {"log": log.name, "runs": {run.name: str(run.folder.path) for run in runs}}


@takes_options
def export(
    what: What,
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            metavar="FILE",
            help="The file to write; its suffix selects the format: .mcap (Foxglove, RViz), .tum, .kitti or .ply (maps).",
        ),
    ],
    *,
    source: LogOptions,
    json: Json = False,
) -> None:
    """Write runs for Foxglove and RViz, or the final trajectory of a run or the reference of a log for other programs.

    Example: fgloc export out/plaza1 -o plaza1.tum
    """
    from factorgraph_loc.api import results

    results.require_format(out)
    log, runs = results.stored(what, source.load_one)
    files = results.write(log, runs, out)
    if json:
        show.document(shown(log, runs) | {"files": [str(file) for file in files]})
    else:
        show.line(f"wrote {' and '.join(map(str, files))}")
