"""Models of COLMAP as text: cameras.txt, images.txt, points3D.txt (Schönberger, Frahm, "Structure-from-motion revisited", 2016;
format: https://colmap.github.io/format.html).

There, (0, 0) is the upper left corner of the upper left pixel, here its centre.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.models import read_text, write_text
from factorgraph_loc.files.temporary import writing
from factors.camera.model import CameraModel
from factors.se2 import Array, Integers

CAMERAS, IMAGES, POINTS = "cameras.txt", "images.txt", "points3D.txt"
CORNER = 0.5  # px
GREY = "128 128 128"


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """F images named ``names`` at ``positions`` (F, 3), with axes ``rotations`` (F, 3, 3) in the world, and ``points`` (P, 3).

    N observations: image ``seen_in`` (N,) shows point ``seen`` (N,) at ``pixels`` (N, 2) [px]. ``sizes``: width and height of the
    images, by camera.
    """

    sizes: tuple[tuple[int, int], ...]
    names: tuple[str, ...]
    positions: Array
    rotations: Array
    points: Array
    seen_in: Integers
    seen: Integers
    pixels: Array


def write_colmap(model: ColmapModel, camera: CameraModel, folder: Path) -> None:
    """Write a model whose images are all of one camera."""
    lens = (camera.fx, camera.fy, camera.cx + CORNER, camera.cy + CORNER, *camera.distortion)
    places: list[list[tuple[int, int]]] = [[] for _ in model.points]  # image, row in its list of observations
    lines = []
    turns = Rotation.from_matrix(model.rotations).inv().as_quat(canonical=True)[:, [3, 0, 1, 2]]
    shifts = -np.einsum("fji,fj->fi", model.rotations, model.positions)
    for i, name in enumerate(model.names):
        rows = np.flatnonzero(model.seen_in == i)
        lines.append(f"{i + 1} {_words((*turns[i], *shifts[i]))} 1 {name}")
        seen = model.seen[rows].tolist()
        lines.append(" ".join(f"{_words(model.pixels[r] + CORNER)} {p + 1}" for r, p in zip(rows, seen, strict=True)))
        for k, point in enumerate(seen):
            places[point].append((i + 1, k))
    points = [
        f"{i + 1} {_words(position)} {GREY} -1" + "".join(f" {image} {row}" for image, row in places[i])
        for i, position in enumerate(model.points)
    ]
    camera_line = f"1 OPENCV {camera.width} {camera.height} {_words(lens)}"
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in ((CAMERAS, [camera_line]), (IMAGES, lines), (POINTS, points)):
            write_text(folder / name, "".join(f"{line}\n" for line in content))


def read_colmap(folder: Path) -> ColmapModel:
    """Read a model. Raises InputError with file and row of what is wrong."""
    sizes = {fields[0]: (int(fields[2]), int(fields[3])) for _, fields in _rows(folder / CAMERAS, "i.ii", 4)}
    index: dict[str, int] = {}
    points = []
    for _, fields in _rows(folder / POINTS, "ifff", 4):
        index[fields[0]] = len(index)
        points.append([float(value) for value in fields[1:4]])
    names: list[str] = []
    cameras: list[str] = []
    poses: list[list[float]] = []
    seen_in: list[int] = []
    seen: list[int] = []
    pixels: list[tuple[float, float]] = []
    path = folder / IMAGES
    lines = enumerate(read_text(path).splitlines(), start=1)
    for row, line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        fields = _checked(path, row, line.split(maxsplit=9), "ifffffffi.", 10)
        row, line = next(lines, (row, ""))  # noqa: PLW2901 - the second line of an image
        triples = line.split()
        _checked(path, row, triples, "ffi" * (len(triples) // 3), -(-len(triples) // 3) * 3)
        for u, v, point in zip(triples[::3], triples[1::3], triples[2::3], strict=True):
            if point in index:  # else -1
                seen_in.append(len(names))
                seen.append(index[point])
                pixels.append((float(u) - CORNER, float(v) - CORNER))
        names.append(fields[9].rstrip())
        cameras.append(fields[8])
        poses.append([float(value) for value in fields[1:8]])
    if not names or not points:
        raise InputError(f"{folder}: has {len(names)} images and {len(points)} points, expected a model with both")
    if missing := set(cameras) - sizes.keys():
        raise bad_field(path, "camera", min(missing), f"one of those in {CAMERAS}")
    values = np.array(poses)
    if len(bad := np.flatnonzero(~values[:, :4].any(axis=1))):
        raise InputError(f"{path}: the quaternion of {names[bad[0]]} is 0, expected a rotation")
    rotations = Rotation.from_quat(values[:, [1, 2, 3, 0]]).as_matrix().transpose(0, 2, 1)
    return ColmapModel(
        tuple(sizes[camera] for camera in cameras),
        tuple(names),
        -np.einsum("fij,fj->fi", rotations, values[:, 4:]),
        rotations,
        np.array(points),
        np.array(seen_in, dtype=np.int64),
        np.array(seen, dtype=np.int64),
        np.array(pixels).reshape(-1, 2),
    )


def _rows(path: Path, kinds: str, count: int) -> list[tuple[int, list[str]]]:
    lines = enumerate(read_text(path).splitlines(), start=1)
    there = [(row, line.split()) for row, line in lines if line.strip() and not line.startswith("#")]
    return [(row, _checked(path, row, fields, kinds, count)) for row, fields in there]


def _checked(path: Path, row: int, fields: list[str], kinds: str, count: int) -> list[str]:
    """The fields of a row, of which there are ``count`` or more: integers (i), finite numbers (f), or anything."""
    if len(fields) < count:
        raise bad_field(path, "row", " ".join(fields), f"{count} fields or more", row=row)
    for field, kind in zip(fields, kinds, strict=False):
        try:
            good = kind == "." or (bool(np.isfinite(float(field))) and (kind == "f" or float(field).is_integer()))
        except ValueError:
            good = False
        if not good:
            raise bad_field(path, "field", field, "an integer" if kind == "i" else "a finite number", row=row)
    return fields


def _words(values: object) -> str:
    return " ".join(f"{value:.9g}" for value in np.asarray(values, dtype=float).tolist())
