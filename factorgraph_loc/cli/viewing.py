"""The commands ``fgloc view``, which shows runs and their log in a viewer, and ``fgloc export``, which writes foreign formats."""

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
        help="Folders of results of `fgloc run` or `fgloc compare`; add their log if `fgloc datasets` lacks it. Or only a log.",
    ),
]


@takes_options
def view(
    what: What,
    rrd: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write this file for Rerun instead of opening Rerun.")
    ] = None,
    bind: Annotated[
        str,
        typer.Option(
            metavar="ADDRESS",
            help="IP address of the viewer. The viewer has no password. Only this machine reaches the default address.",
        ),
    ] = LOOPBACK,
    *,
    source: LogOptions,
    json: Json = False,
) -> None:
    """Show a log and its runs over time in the viewer Rerun.

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
    """Return the dictionary that ``--json`` prints: the name of the log, and the name and folder of each run."""
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
    """Write runs for Foxglove and RViz. Or write the final trajectory of a run, or the reference of a log, for other programs.

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
