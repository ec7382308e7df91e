"""``fgloc calibrate``: estimates a rig from logs with reference poses."""

from pathlib import Path
from typing import Annotated

import typer

from factorgraph_loc.cli import show
from factorgraph_loc.cli.options import (
    DataRoot,
    Json,
    LogNames,
    LogOptions,
    Overwrite,
    Reader,
    ReaderOption,
    RigFile,
    WorldFile,
)

OutRig = Annotated[
    Path, typer.Option("--out", "-o", metavar="OUT.rig.toml", help="The rig to write; a report is written next to it.")
]


def calibrate(
    logs: LogNames,
    out: OutRig,
    reader: Reader = None,
    reader_option: ReaderOption = None,
    data_root: DataRoot = None,
    rig: RigFile = None,
    world: WorldFile = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Calibrate a rig from logs with reference poses; write the rig and a report."""
    from factorgraph_loc.api import learning
    from factorgraph_loc.calibration import report

    page = learning.report_beside(out, overwrite=overwrite)  # before the logs are read
    loaded = LogOptions(reader, reader_option, data_root, rig, world).load(logs)
    show.first_use()
    with show.progress("calibrating", counted=True) as progress:
        found = learning.calibrate(loaded, out, overwrite=overwrite, progress=progress)
    for doubt in found.doubts:
        show.note(f"warning: {doubt}")
    if json:
        show.document(report.document(found) | {"files": {"rig": str(out), "report": str(page)}})
        return
    show.table(*report.constants_table(found.knowledge.constants))
    show.line()
    for table in report.sensor_tables(found):
        show.table(*table)
        show.line()
    show.table(*report.judgements_table(found))
    show.line()
    show.table(*report.accuracy_table(found))
    show.line()
    show.line(f"the rig is in {out}, the report in {page}")
