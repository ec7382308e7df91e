"""Images and identified pixels in the native format: ``camera.csv`` with the folder ``camera``, and ``sightings.csv``.

Images are not opened here: whether they can be decoded, and have the size that the camera was calibrated for, is found out
where their features are looked for (:mod:`factorgraph_loc.sensors.camera.frontend`).
"""

from collections.abc import Sequence
from pathlib import Path

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import checks
from factorgraph_loc.files.bounded import NoFileNameError, copy_file
from factorgraph_loc.files.columns import SIGHTINGS
from factorgraph_loc.files.models import inside
from factorgraph_loc.files.tables import Table
from factorgraph_loc.sensors.camera.stream import ImageStream, SightingStream

IMAGES = ("t_ns", "file")
PIXELS = ("t_ns", "landmark", "u", "v")
FOLDER = "camera"


def make_images(table: Table, t0_ns: int, warnings: list[str], folder: Path | None = None) -> ImageStream:
    """The images that there are, in order of arrival; of several at one stamp the last. They lie below ``folder``, which was
    checked itself, by default that of the native format.

    InputError for a path that leaves the folder or is no regular file, and a stamp that is late by more than 0.5 s."""
    checks.arrivals(table.path, table.rows, table.t_ns, warnings)
    within = inside(table.path.parent, FOLDER, table.path) if folder is None else folder
    named = zip(table.rows.tolist(), table.names["file"], strict=True)
    paths = [_image(within, f"{table.path}:{row}", name) for row, name in named]
    last = {t: i for i, t in enumerate(table.t_ns.tolist())}
    if dropped := len(paths) - len(last):
        warnings.append(f"{table.path}: {dropped} rows have the stamp of a later row and are left out")
    latest = sorted(last.values())
    keep = [i for i in latest if paths[i] is not None]
    if missing := [i for i in latest if paths[i] is None]:
        first = f"{table.names['file'][missing[0]]} of row {table.rows[missing[0]]}"
        warnings.append(
            f"{table.path}: {len(missing)} of {len(latest)} images are missing and left out, the first is {first}"
        )
    t = checks.seconds(table.t_ns[keep], t0_ns)
    return ImageStream(t, [path for path in (paths[i] for i in keep) if path is not None])


def make_pixels(table: Table, t0_ns: int, warnings: list[str]) -> SightingStream:
    """Identified pixels in order of arrival; of one point at one stamp the last."""
    for field in ("u", "v"):
        SIGHTINGS[field].require(table.path, table.rows, table.numbers[field])
    names = table.names["landmark"]
    keep = checks.sightings_in_order(table.path, table.rows, table.t_ns, names, warnings)
    t = checks.seconds(table.t_ns[keep], t0_ns)
    return SightingStream(t, [names[i] for i in keep], table.numbers["u"][keep], table.numbers["v"][keep])


def write_images(files: Sequence[Path], folder: Path) -> list[str]:
    """Put the images into the new folder ``camera`` of a log's ``folder``, and return their names there, by their numbers.

    They are copies: whoever edits one does not edit the other. InputError names one that is gone.
    """
    target = folder / FOLDER
    target.mkdir()
    names = [f"{i:06d}{file.suffix}" for i, file in enumerate(files)]
    for file, name in zip(files, names, strict=True):
        try:
            copy_file(file, target / name)
        except OSError as error:
            raise InputError(f"{file}: cannot be copied into {target}: {error.strerror}") from error
    return names


def _image(folder: Path, source: str, name: str) -> Path | None:
    """The path of an image below ``folder``; None if there is no such file."""
    try:
        path = inside(folder, name, source)
    except NoFileNameError:
        return None
    return path if path.is_file() else None
