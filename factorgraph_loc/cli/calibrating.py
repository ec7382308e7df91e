"""``fgloc calibrate``: a rig from logs with reference poses."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
from factorgraph_loc.errors import InputError

if TYPE_CHECKING:
    from factorgraph_loc.log import Log

SUFFIX = ".rig.toml"
OutRig = Annotated[
    Path, typer.Option("--out", "-o", metavar="OUT.rig.toml", help="The rig to write; a report goes beside it.")
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
    """Learn a rig from logs with reference poses; write it, and a report."""
    page = _report_beside(out, overwrite=overwrite)
    from factorgraph_loc.calibration import report
    from factorgraph_loc.calibration.calibrate import calibrate as learn
    from factorgraph_loc.files import write_text
    from factorgraph_loc.rig import write_rig

    loaded = LogOptions(reader, reader_option, data_root, rig, world).load(logs)
    # learnt grids lie here until the rig is written: nothing is left of a calibration that fails
    with tempfile.TemporaryDirectory(prefix="fgloc-") as folder:
        with show.progress("calibrating", counted=True) as progress:
            grids = Path(folder) / out.name.removesuffix(SUFFIX)
            found = learn(loaded, _score, progress=progress, grids=grids)
        try:
            write_text(page, report.page(found))
            write_rig(found.rig, out)
        except OSError as error:
            raise InputError(f"{out}: cannot be written: {error.strerror}") from error
    for doubt in found.doubts:
        show.note(f"warning: {doubt}")
    if json:
        show.document(report.document(found) | {"files": {"rig": str(out), "report": str(page)}})
        return
    show.table(*report.constants_table(found.knowledge.constants))
    typer.echo()
    if found.knowledge.rfid is not None:
        for table in report.rfid_tables(found):
            show.table(*table)
            typer.echo()
    show.table(*report.accuracy_table(found))
    typer.echo(f"\nthe rig is in {out}, the report in {page}")


def _report_beside(out: Path, *, overwrite: bool) -> Path:
    """The report's path; InputError if the rig's name is not one, or something is there already."""
    name = out.name.removesuffix(SUFFIX)
    if name in ("", out.name):
        raise InputError(f"--out is {str(out)!r}, expected a name that ends in {SUFFIX}")
    if not out.parent.is_dir():
        raise InputError(f"--out is {str(out)!r}, but there is no folder {out.parent}")
    page = out.with_name(f"{name}.report.html")
    for path in (out, page):
        if path.exists() and not overwrite:
            raise InputError(f"{path}: exists already; choose another name or give --overwrite")
    return page


def _score(log: Log) -> dict[str, Any]:
    """The scores of the EKF on a log, with the log's rig and its sensors; of the smoother where tags are read."""
    from factorgraph_loc.evaluation.metrics import score
    from factorgraph_loc.experiments.run import RunConfig, run

    return score(run(log, RunConfig("smoother" if "rfid" in log.rig.sensors else "ekf")), log)
