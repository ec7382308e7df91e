"""``fgloc calibrate``: a rig from logs with reference poses."""

from __future__ import annotations

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
    with show.progress("calibrating", counted=True) as progress:
        found = learn(loaded, _score_ekf, progress=progress)
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


def _score_ekf(log: Log) -> dict[str, Any]:
    """The scores of the EKF on a log, with the log's rig."""
    from factorgraph_loc.evaluation.metrics import score
    from factorgraph_loc.experiments.run import RunConfig, run

    return score(run(log, RunConfig("ekf")), log)
