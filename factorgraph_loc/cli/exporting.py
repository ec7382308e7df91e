"""``fgloc export``: results in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from factorgraph_loc.cli import show
from factorgraph_loc.cli.options import DataRoot, Json, LogOptions, Reader, ReaderOption, RigFile, WorldFile
from factorgraph_loc.cli.viewing import What, shown


def export(
    what: What,
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            metavar="FILE",
            help="The file to write; its suffix selects the format: .mcap (Foxglove), .tum, .kitti or .g2o.",
        ),
    ],
    reader: Reader = None,
    reader_option: ReaderOption = None,
    data_root: DataRoot = None,
    rig: RigFile = None,
    world: WorldFile = None,
    json: Json = False,
) -> None:
    """Write runs for Foxglove, or the final trajectory of a run or the reference of a log for other programs."""
    from factorgraph_loc.api import results

    results.require_format(out)
    log, runs = results.stored(what, LogOptions(reader, reader_option, data_root, rig, world).load_one)
    files = results.write(log, runs, out)
    if json:
        show.document(shown(log, runs) | {"files": [str(file) for file in files]})
    else:
        show.line(f"wrote {' and '.join(map(str, files))}")
