"""Images in the native format: ``camera.csv`` and the folder ``camera``.

Images are decoded and checked later, by :mod:`factorgraph_loc.sensors.camera.frontend`.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import checks
from factorgraph_loc.files.bounded import NoFileNameError, copy_file
from factorgraph_loc.files.models import inside
from factorgraph_loc.files.tables import TableRows
from factorgraph_loc.model.measurement import Stream
from factorgraph_loc.sensors.camera.stream import ImageStream
from factorgraph_loc.sensors.tables import Columns, Reading, Writing

FOLDER = "camera"


def make_images(table: TableRows, t0_ns: int, warnings: list[str], folder: Path | None = None) -> ImageStream:
    """The existing images in order of arrival; of several with one timestamp the last. They are in ``folder``, which must be
    validated, by default that of the native format.

    InputError if a path leaves the folder or is no regular file, or a timestamp is late by more than 0.5 s.
    """
    latest = checks.images_in_order(table.path, table.rows, table.t_ns, warnings).tolist()
    within = inside(table.path.parent, FOLDER, table.path) if folder is None else folder
    named = zip(table.rows.tolist(), table.names["file"], strict=True)
    paths = [_image(within, f"{table.path}:{row}", name) for row, name in named]
    keep = [i for i in latest if paths[i] is not None]
    if missing := [i for i in latest if paths[i] is None]:
        first = f"{table.names['file'][missing[0]]} of row {table.rows[missing[0]]}"
        warnings.append(
            f"{table.path}: {len(missing)} of {len(latest)} images are missing and skipped, the first is {first}"
        )
    t = checks.seconds(table.t_ns[keep], t0_ns)
    return ImageStream(t, [path for path in (paths[i] for i in keep) if path is not None])


def assemble(rows: Mapping[str, TableRows], reading: Reading) -> ImageStream:
    """The images in a log's folder."""
    return make_images(rows["camera"], reading.t0_ns, reading.warnings)


def disassemble(stream: Stream, writing: Writing) -> dict[str, Columns]:
    """The rows of images, which are copied to the folder; InputError for features, which cannot be written."""
    if not isinstance(stream, ImageStream):
        raise InputError(f"{writing.log}: camera holds features, expected the images they were computed from")
    return {
        "camera": {"t_ns": checks.absolute(stream.t, writing.t0_ns), "file": write_images(stream.file, writing.folder)}
    }


def write_images(files: Sequence[Path], folder: Path) -> list[str]:
    """Copy the images into the new folder ``camera`` in ``folder``, numbered, and return their names. InputError if one is
    missing."""
    target = folder / FOLDER
    target.mkdir()
    names = [f"{i:06d}{file.suffix}" for i, file in enumerate(files)]
    for file, name in zip(files, names, strict=True):
        _copy(file, target / name)
    return names


def _copy(file: Path, target: Path) -> None:
    try:
        copy_file(file, target)
    except OSError as error:
        raise InputError(f"{file}: cannot be copied into {target.parent}: {error.strerror}") from error


def _image(folder: Path, source: str, name: str) -> Path | None:
    """The path of an image in ``folder``, or None if there is no such file."""
    try:
        path = inside(folder, name, source)
    except NoFileNameError:
        return None
    return path if path.is_file() else None
