"""What is around the robot: landmarks and tags with their positions, read from and written to ``NAME.world.toml``.

Many tags are better kept in a table beside it, ``NAME.tags.csv``; points that a camera sees always are, as ``NAME.points.parquet``.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field

from factorgraph_loc.column_mapping import ColumnMapping, EpcCase, in_case, read_mapped
from factorgraph_loc.columns import TAGS
from factorgraph_loc.csv_cells import read_cells
from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import Coordinate, FileModel, inside, parse_model, read_toml, write_text, write_toml
from factorgraph_loc.markers import Marker, corner_points
from factorgraph_loc.occupancy import read_walls
from factorgraph_loc.points import POINTS_SUFFIX, PointMap, read_points, write_points
from factorgraph_loc.text import quoted
from factors.se2 import Array

TAGS_SUFFIX = ".tags.csv"
TAG_COLUMNS = ("epc", "x", "y", "z", "facing")
TAG_COLUMNS_WITH_SIGMA = (*TAG_COLUMNS, "sigma")


def _positive_semidefinite(value: tuple[float, float, float]) -> tuple[float, float, float]:
    xx, xy, yy = value
    # of a singular matrix the determinant may round to a little below zero
    if xx < 0.0 or yy < 0.0 or xy * xy > xx * yy * (1.0 + 1e-9):
        raise ValueError("expected (xx, xy, yy) [m^2] of a positive semi-definite matrix")
    return value


Variance = Annotated[float, Field(ge=-1e8, le=1e8, description="m^2")]
Covariance = Annotated[tuple[Variance, Variance, Variance], AfterValidator(_positive_semidefinite)]


class Landmark(FileModel):
    """A point landmark: position [m] in the world's frame, and how well it is known.

    ``sigma``: standard deviation of its survey in x and y [m]. ``covariance``: (xx, xy, yy) [m^2], in place of ``sigma``, where
    the map was made from a log and the errors in x and y differ or go together.
    """

    x: Coordinate
    y: Coordinate
    sigma: Annotated[float, Field(ge=0.0, le=100.0)] = 0.0
    covariance: Covariance | None = None

    def spread(self) -> Array:
        """The covariance (2, 2) of the position [m^2]."""
        if self.covariance is None:
            return self.sigma**2 * np.eye(2)
        xx, xy, yy = self.covariance
        return np.array(((xx, xy), (xy, yy)))


class Tag(FileModel):
    """An RFID tag: position [m] as it was surveyed, and the direction that it faces [rad], None where that is not known.

    ``sigma``: standard deviation of its survey in x and y [m]; ``covariance``: (xx, xy, yy) [m^2] in place of it, as of a
    :class:`Landmark`.
    """

    x: Coordinate
    y: Coordinate
    z: Coordinate = 0.0
    facing: Annotated[float, Field(ge=-2.0 * math.pi, le=2.0 * math.pi, description="rad, not degrees")] | None = None
    sigma: Annotated[float, Field(ge=0.0, le=100.0)] = 0.0
    covariance: Covariance | None = None


class TagsFile(ColumnMapping):
    """A table of tags as another program wrote it, with the columns epc, x, y and perhaps z, facing, sigma. ``epc_case``: in which
    letters EPCs are compared with the reads."""

    epc_case: EpcCase = "as written"


class _Markers(FileModel):
    markers: dict[str, Marker]


class World(FileModel):
    """A map. ``landmarks``: by name, as measurements name them. ``tags``: RFID tags by EPC, as they were surveyed: what a rig
    knows of the survey's errors is applied where they are used. ``points``: what a camera sees. ``walls``: segments (x1, y1, x2,
    y2) [m]."""

    model_config = ConfigDict(arbitrary_types_allowed=True)

    name: str = "world"
    landmarks: dict[str, Landmark] = Field(default_factory=dict)
    tags: dict[str, Tag] = Field(default_factory=dict)
    points: PointMap | None = None
    walls: tuple[tuple[Coordinate, Coordinate, Coordinate, Coordinate], ...] = ()

    def position(self, landmark: str) -> Array | None:
        """Position (2,) of a landmark, or None if the map lacks it."""
        found = self.landmarks.get(landmark)
        return None if found is None else np.array((found.x, found.y))

    def positions(self) -> Array:
        """Positions (K, 2) of all landmarks, in the order of the map."""
        return np.array([(m.x, m.y) for m in self.landmarks.values()]).reshape(-1, 2)


def read_world(path: str | Path) -> World:
    """Read ``NAME.world.toml``; InputError names file, key and what is expected."""
    path = Path(path)
    return parse_world(read_toml(path), path, path.parent)


def parse_world(content: Mapping[str, Any], source: object, folder: Path) -> World:
    """A map as it stands in a file ``source``; tables that it names lie below ``folder``. InputError as of :func:`read_world`.

    ``walls`` may name an occupancy map, ``tags`` a table of another program with the mapping of its columns; the corners of
    ``markers`` become points.
    """
    tags = content.get("tags")
    if isinstance(tags, str):
        content = {**content, "tags": read_tags(inside(folder, tags, source))}
    elif isinstance(tags, dict) and isinstance(tags.get("file"), str):
        mapping = parse_model(TagsFile, tags, f"{source} [tags]")
        content = {**content, "tags": read_mapped_tags(inside(folder, mapping.file, source), mapping)}
    if isinstance(walls := content.get("walls"), str):
        content = {**content, "walls": read_walls(inside(folder, walls, source))}
    points = content.get("points")
    if points is not None:
        if not isinstance(points, str):
            raise InputError(f"{source}: points is {quoted(points)}, expected the name of a file")
        path = inside(folder, points, source)
        if not path.exists():
            raise InputError(f"{source}: points names {quoted(points)}, which is missing")
        content = {**content, "points": read_points(path)}
    if "markers" in content:
        markers = parse_model(_Markers, {"markers": content["markers"]}, source).markers
        known = content.get("points")
        points = corner_points(markers) if known is None else known.with_points(corner_points(markers), source)
        content = {key: value for key, value in content.items() if key != "markers"} | {"points": points}
    return parse_model(World, content, source)


def read_tags(path: Path) -> dict[str, Tag]:
    """Read ``NAME.tags.csv`` with the columns epc, x, y, z, facing and, if they are known, sigma; a facing may be empty.

    InputError names file, row and field of what is wrong. An EPC that stands there twice is an error: no estimator could tell which
    of the two it hears, and only who surveyed them can.
    """
    cells, shape = read_cells(path, (TAG_COLUMNS_WITH_SIGMA, TAG_COLUMNS))
    return _tags(path, cells.rows, cells.columns["epc"], {name: cells.numbers(name, TAGS[name]) for name in shape[1:]})


def read_mapped_tags(path: Path, mapping: TagsFile) -> dict[str, Tag]:
    """Read a table of another program; what is wrong with it is an InputError as of :func:`read_tags`."""
    mapped = read_mapped(path, mapping, (("epc", "x", "y"),), ("z", "facing", "sigma"))
    numbers = {name: mapped.numbers(name, TAGS[name]) for name in mapped.fields if name != "epc"}
    return _tags(path, mapped.cells.rows, in_case(mapped.texts("epc"), mapping.epc_case), numbers)


def _tags(path: Path, rows: Sequence[int], epcs: Sequence[str], numbers: Mapping[str, Array]) -> dict[str, Tag]:
    tags: dict[str, Tag] = {}
    found: dict[str, int] = {}
    for i, (row, epc) in enumerate(zip(rows, epcs, strict=True)):
        if not epc or epc in tags:
            expected = f"another EPC than in row {found[epc]}" if epc else "the EPC of a tag"
            raise bad_field(path, "epc", epc, expected, row=row)
        values = {name: float(column[i]) for name, column in numbers.items() if not math.isnan(column[i])}
        tags[epc] = parse_model(Tag, values, f"{path}:{row}")
        found[epc] = row
    return tags


def write_world(world: World, path: str | Path) -> None:
    """Write ``NAME.world.toml``, the tags beside it as ``NAME.tags.csv``, or in the same file where one has a covariance, and the
    points as ``NAME.points.parquet``."""
    path = Path(path)
    content = world.model_dump(mode="json", exclude_none=True, exclude={"points"})
    base = path.name.removesuffix(".toml").removesuffix(".world")
    if world.tags and all(tag.covariance is None for tag in world.tags.values()):
        content["tags"] = base + TAGS_SUFFIX
        _write_tags(world.tags, path.parent / content["tags"])
    if world.points is not None:
        content["points"] = base + POINTS_SUFFIX
        write_points(world.points, path.parent / content["points"])
    write_toml(path, content)


def _write_tags(tags: Mapping[str, Tag], path: Path) -> None:
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(TAG_COLUMNS_WITH_SIGMA)
    # csv writes a float with all its digits, and None as an empty cell
    rows.writerows((epc, tag.x, tag.y, tag.z, tag.facing, tag.sigma) for epc, tag in tags.items())
    write_text(path, text.getvalue())
