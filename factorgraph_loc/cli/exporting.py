"""``fgloc export``: results in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from factorgraph_loc.cli import show
from factorgraph_loc.cli.options import DataRoot, Json, LogOptions, Reader, ReaderOption, RigFile, WorldFile
from factorgraph_loc.cli.viewing import What, load_results, shown
from factorgraph_loc.errors import InputError
from factorgraph_loc.text import listed, quoted

if TYPE_CHECKING:
    from factorgraph_loc.exports.runs import StoredRun
    from factorgraph_loc.model.log import Log
    from factorgraph_loc.model.trajectory import Trajectory

FORMATS = (".mcap", ".tum", ".kitti", ".g2o")


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
    if out.suffix not in FORMATS:
        raise InputError(f"{out}: has the suffix {quoted(out.suffix)}, expected one of {', '.join(FORMATS)}")
    log, runs = load_results(what, LogOptions(reader, reader_option, data_root, rig, world))
    files = [out]
    if out.suffix == ".mcap":
        from factorgraph_loc.exports.foxglove import write_mcap

        write_mcap(log, runs, out)
    elif out.suffix == ".g2o":
        from factorgraph_loc.exports.g2o import pose_graph, write_g2o

        run = _only(runs, out)
        sensors = run.folder.config.sensors or log.rig.sensors
        write_g2o(pose_graph(log, run.final, sensors, run.landmarks), out)
    elif out.suffix == ".kitti":
        from factorgraph_loc.exports.trajectories import write_kitti

        in_space = log.reference3 if not runs and log.reference is None else None
        files.append(write_kitti(in_space or _trajectory(log, runs, out), out))
    else:
        from factorgraph_loc.model.trajectory import write_tum

        write_tum(_trajectory(log, runs, out), out, log.t0_ns)
    if json:
        show.document(shown(log, runs) | {"files": [str(file) for file in files]})
    else:
        show.line(f"wrote {' and '.join(map(str, files))}")


def _only(runs: list[StoredRun], out: Path) -> StoredRun:
    if len(runs) != 1:
        found = f"there are {len(runs)} ({listed(run.name for run in runs)})" if runs else "there is none"
        raise InputError(f"{out}: holds one run, and {found}, expected the folder of one run")
    return runs[0]


def _trajectory(log: Log, runs: list[StoredRun], out: Path) -> Trajectory:
    """The final trajectory of the run, or the reference of a log without runs."""
    if runs:
        return _only(runs, out).final
    if log.reference is None:
        if log.reference3 is not None:
            raise InputError(f"{log.name}: has a three-dimensional reference, which only .kitti supports")
        raise InputError(f"{log.name}: has no reference to write, expected the folder of a run too")
    return log.reference
