"""The tables of landmarks that a world may name."""

from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_loc.files.column_mapping import ColumnMapping, read_mapped
from factorgraph_loc.files.columns import LENGTH, Table, named, number, within
from factorgraph_loc.files.models import FARTHEST, inside, parse_model
from factorgraph_loc.files.tables import rows_by_name
from factorgraph_loc.sensors.landmarks.settings import Landmark

SIGMAS = ("sigma", "sigma_x", "sigma_y")
LANDMARKS = Table(
    "landmarks",
    (
        named("landmark", "the name of a landmark"),
        within("x", LENGTH, FARTHEST, "position in the world"),
        within("y", LENGTH, FARTHEST, "position in the world"),
        *(number(name, LENGTH, 0.0, 100.0, "standard deviation of the survey", may_lack=True) for name in SIGMAS),
    ),
    "one each",
)


def read_layer(content: Any, source: object, folder: Path) -> Any:
    """The landmarks of a world file: inline, or in a foreign table with a mapping."""
    if not isinstance(content, dict) or not isinstance(content.get("file"), str):
        return content
    mapping = parse_model(ColumnMapping, content, f"{source} [landmarks]")
    return read_landmarks(inside(folder, mapping.file, source), mapping)


def read_landmarks(path: Path, mapping: ColumnMapping) -> dict[str, Landmark]:
    """Read a foreign table with the fields landmark, x, y and optionally sigma, or sigma_x and sigma_y, of which the larger one is
    used. InputError names file, row and field of an invalid value, or of a duplicate name."""
    position = ("landmark", "x", "y")
    mapped = read_mapped(path, mapping, (position, (*position, "sigma"), (*position, "sigma_x", "sigma_y")))
    numbers = {name: mapped.numbers(name, LANDMARKS[name]) for name in mapped.columns if name != "landmark"}
    if "sigma_x" in numbers:
        numbers["sigma"] = np.fmax(numbers.pop("sigma_x"), numbers.pop("sigma_y"))
    return rows_by_name(Landmark, path, mapped.rows, LANDMARKS["landmark"], mapped.texts("landmark"), numbers)
