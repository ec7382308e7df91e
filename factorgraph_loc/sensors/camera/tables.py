"""Images in the native format: ``camera.csv`` with the folder ``camera``.

Images are not opened here: whether they can be decoded, and have the size that the camera was calibrated for, is found out
where their features are looked for (:mod:`factorgraph_loc.sensors.camera.frontend`).
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import checks
from factorgraph_loc.files.bounded import NoFileNameError, copy_file
from factorgraph_loc.files.models import inside
from factorgraph_loc.files.tables import TableRows
from factorgraph_loc.model.stream import Stream
from factorgraph_loc.sensors.camera.stream import ImageStream
from factorgraph_loc.sensors.tables import Columns, Reading, Writing

FOLDER = "camera"


def make_images(table: TableRows, t0_ns: int, warnings: list[str], folder: Path | None = None) -> ImageStream:
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


def assemble(rows: Mapping[str, TableRows], reading: Reading) -> ImageStream:
    """The images of a log's folder."""
    return make_images(rows["camera"], reading.t0_ns, reading.warnings)


def disassemble(stream: Stream, writing: Writing) -> dict[str, Columns]:
    """The rows of images, which are copied into the folder; InputError for features, which cannot be written."""
    if not isinstance(stream, ImageStream):
        raise InputError(f"{writing.log}: camera holds features, expected the images in which they were found")
    return {
        "camera": {"t_ns": checks.absolute(stream.t, writing.t0_ns), "file": write_images(stream.file, writing.folder)}
    }


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
