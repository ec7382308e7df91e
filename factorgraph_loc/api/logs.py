"""The commands ``fgloc datasets``, ``info``, ``convert``, ``manifest`` and ``simulate`` as functions."""

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.figures import write_picture
from factorgraph_loc.evaluation.inspect import Inspection, inspect
from factorgraph_loc.evaluation.plots import overview
from factorgraph_loc.experiments.run import run
from factorgraph_loc.files.temporary import temporary_folder, writing
from factorgraph_loc.io.bags.file import is_bag
from factorgraph_loc.io.bags.manifest import manifest_of_bag
from factorgraph_loc.io.folder_manifest import manifest_of_folder
from factorgraph_loc.io.native.native import require_new, write_native
from factorgraph_loc.io.proposals import Proposal
from factorgraph_loc.io.readers import Dataset, LogLike, RigLike, WorldLike, describe, read_log
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.scoring import RunConfig
from factorgraph_loc.sensors.registry import moving
from factorgraph_loc.simulation import SimulationSettings, named_settings, with_images
from factorgraph_loc.simulation import simulate as make_log


def datasets(data_root: str | Path | None = None) -> list[Dataset]:
    """Return descriptions of the known data sets. Their names can be given as logs. ``data_root``: the folder of their
    files."""
    return describe(data_root)


def info(
    log: LogLike, *, rig: RigLike | None = None, world: WorldLike | None = None, out: str | Path | None = None
) -> Inspection:
    """Return a summary of a log, with warnings about its content.

    ``rig``, ``world``: replace those of the log. ``out``: a PNG file to write, a picture of the log from above.
    """
    loaded = read_log(log, rig=rig, world=world)
    if out is not None:
        draw([loaded], Path(out))
    return inspect(loaded)


def draw(logs: Sequence[Log], path: Path) -> None:
    """Write a picture of a log from above to ``path``. ``logs``: a list with this log. Raises InputError if it has not
    exactly one log, or if ``path`` does not end in .png."""
    if path.suffix.lower() != ".png":
        raise InputError(f"{path}: expected a name that ends in .png")
    if len(logs) != 1:
        raise InputError(f"-o: there are {len(logs)} logs, expected one to draw")
    (log,) = logs
    odometry = run(log, RunConfig("dead_reckoning")).final if moving(tuple(log.streams)) else None
    path.parent.mkdir(parents=True, exist_ok=True)
    write_picture(overview(log, odometry), path)


def convert(
    log: LogLike,
    out: str | Path,
    *,
    format: Literal["csv", "parquet"] = "csv",
    rig: RigLike | None = None,
    world: WorldLike | None = None,
    overwrite: bool = False,
) -> None:
    """Write a log as the folder ``out`` in the native format of this project. ``format``: the file type of the tables.

    ``rig``, ``world``: replace those of the log. ``overwrite``: replace a log in the folder ``out``.
    """
    write_native(read_log(log, rig=rig, world=world), out, format, overwrite=overwrite)


def manifest(log: str | Path) -> Proposal:
    """Return a proposed manifest. It is a TOML file that assigns files of a folder, or topics of a ROS bag, to sensors.

    Write the ``text`` of the proposal to a file in its ``folder``, and check it. Then the file can be given as a log.
    Raises InputError if the folder or the bag cannot be read.
    """
    path = Path(log)
    propose = manifest_of_folder if path.is_dir() and not is_bag(path) else manifest_of_bag
    return propose(path, Path.cwd())


def simulate(
    what: str | Path | SimulationSettings = "office",
    seed: int = 0,
    *,
    changes: Mapping[str, Any] | None = None,
    images: bool = False,
    out: str | Path | None = None,
    progress: Callable[[float, float], None] = lambda _done, _total: None,
) -> Log:
    """Return a simulated log with known ground truth. The same seed gives the same bytes.

    ``what``: a preset, a TOML file, or settings. ``changes``: changed settings as nested tables, such as ``{"drive":
    {"duration": 60.0}}``. ``images``: render the images of the camera into ``out``. ``out``: a new folder for the log
    in the native format. ``progress`` is called with the number of rendered images and the number of all images.
    """
    if isinstance(what, SimulationSettings) and changes:
        raise InputError("changes apply to a preset or a file, but settings are given: change the settings themselves")
    settings = what if isinstance(what, SimulationSettings) else named_settings(str(what), changes)
    if images and out is None:
        raise InputError("images is true, but out is missing: give a new folder for the log as out")
    log = make_log(settings, seed)
    if out is None:
        return log
    folder = Path(out)
    with writing(folder):
        if images:
            _write_with_images(log, settings, seed, folder, progress)
        else:
            write_native(log, folder)
    return read_log(folder) if images else log


def _write_with_images(
    log: Log, settings: SimulationSettings, seed: int, folder: Path, progress: Callable[[float, float], None]
) -> None:
    """Write a simulated log with images to ``folder``. The images are rendered from ``settings`` and ``seed``.

    ``progress`` is called with the number of finished images and of all images. If rendering fails, nothing is written."""
    require_new(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with temporary_folder(folder) as rendered:
        workers = os.cpu_count() or 1
        write_native(with_images(log, settings, seed, rendered, workers=workers, progress=progress), folder)
