"""RFID tags of the map, and the files that list them."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from factorgraph_loc.files.column_mapping import ColumnMapping, EpcCase, in_case, read_mapped
from factorgraph_loc.files.columns import ANGLE, FULL_TURN, LENGTH, Table, named, number, within
from factorgraph_loc.files.models import FARTHEST, Coordinate, FileModel, InUnit, inside, parse_model
from factorgraph_loc.files.tables import read_cells, rows_by_name, write_table
from factorgraph_loc.model.settings import Covariance, spread_of
from factors.se2 import Array

TAGS_SUFFIX = ".tags.csv"
TAGS = Table(
    "tags",
    (
        named("epc", "the EPC of a tag"),
        within("x", LENGTH, FARTHEST, "position in the frame of the survey"),
        within("y", LENGTH, FARTHEST, "position in the frame of the survey"),
        number("z", LENGTH, -FARTHEST, FARTHEST, "height; 0 if empty", may_lack=True),
        number("facing", ANGLE, -FULL_TURN, FULL_TURN, "direction that the front of the tag faces", may_lack=True),
        number("sigma", LENGTH, 0.0, 100.0, "standard deviation of the surveyed x and y", may_lack=True),
    ),
    optional=(("sigma",),),
)


class Tag(FileModel):
    """An RFID tag of the map: its surveyed position [m], and the direction ``facing`` [rad] of its front or None.

    ``sigma``: standard deviation [m] of the surveyed x and y. ``covariance``: the elements (xx, xy, yy) [m^2] of the
    covariance of the survey, as an alternative to ``sigma``.
    """

    x: Coordinate
    y: Coordinate
    z: Coordinate = 0.0
    facing: Annotated[float, Field(ge=-2.0 * math.pi, le=2.0 * math.pi), InUnit("rad")] | None = None
    sigma: Annotated[float, Field(ge=0.0, le=100.0)] = 0.0
    covariance: Covariance | None = None

    def spread(self) -> Array:
        """Return the covariance (2, 2) of the surveyed position [m^2]."""
        return spread_of(self.sigma, self.covariance)


class TagsFile(ColumnMapping):
    """Assigns the columns of a foreign table of tags to the fields epc, x, y and optionally z, facing, sigma.
    ``epc_case``: the conversion of EPCs to upper or lower case, if their case differs from that of the reads."""

    epc_case: EpcCase = "as written"


def read_layer(content: Any, source: object, folder: Path) -> Any:
    """Return the tags of a world file by EPC. ``content``: the section ``tags`` of the file. If it names a table, the
    tags are read from this table in ``folder``. ``source``: the name of the world file in messages."""
    if isinstance(content, str):
        return read_tags(inside(folder, content, source))
    if isinstance(content, dict) and isinstance(content.get("file"), str):
        mapping = parse_model(TagsFile, content, f"{source} [tags]")
        return read_tags(inside(folder, mapping.file, source), mapping)
    return content


def write_layer(tags: Mapping[str, Tag], base: Path) -> str | None:
    """Write tags to a table next to the world file ``base``. Returns the name of the table. If there are no tags, or if
    a tag has a covariance, nothing is written and None is returned."""
    if not tags or any(tag.covariance is not None for tag in tags.values()):
        return None
    write_tags(tags, base.with_name(base.name + TAGS_SUFFIX))
    return base.name + TAGS_SUFFIX


def read_tags(path: Path, mapping: TagsFile | None = None) -> dict[str, Tag]:
    """Return the tags in a table, by EPC. ``mapping``: the columns of a foreign table, None for a native table.

    A native table has the columns epc, x, y, z, facing (may be empty) and optionally sigma. Raises InputError with
    file, row and field for an invalid value or a duplicate EPC.
    """
    if mapping is None:
        cells, _ = read_cells(path, (TAGS,))
        return rows_by_name(Tag, cells, TAGS, cells.texts("epc"))
    cells = read_mapped(path, mapping, (("epc", "x", "y"),), ("z", "facing", "sigma"))
    return rows_by_name(Tag, cells, TAGS, in_case(cells.texts("epc"), mapping.epc_case))


def write_tags(tags: Mapping[str, Tag], path: Path) -> None:
    numbers = {column.name: [getattr(tag, column.name) for tag in tags.values()] for column in TAGS.columns[1:]}
    write_table(path, (TAGS,), {"epc": list(tags), **numbers})
