"""Reads and writes maps: files ``NAME.world.toml``, and the tables that they name."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import FileModel, inside, parse_model, read_toml, write_toml
from factorgraph_loc.maps.markers import Marker, corner_points
from factorgraph_loc.maps.occupancy import read_walls
from factorgraph_loc.maps.points import POINTS_SUFFIX, read_points, write_points
from factorgraph_loc.maps.tag_file import read_tag_file
from factorgraph_loc.model.sections import layers
from factorgraph_loc.model.world import World
from factorgraph_loc.plugins import load
from factorgraph_loc.text import quoted


class _Markers(FileModel):
    markers: dict[str, Marker]


def read_world(path: str | Path) -> World:
    """Return the map in ``NAME.world.toml``. Raises InputError with the file, the key and the expected value."""
    path = Path(path)
    return parse_world(read_toml(path), path, path.parent)


def parse_world(content: Mapping[str, Any], source: object, folder: Path) -> World:
    """Return the map in ``content``, the keys and values of a world file.

    ``source``: the file, for errors. ``folder``: the folder of the tables. ``walls`` may name an occupancy map,
    ``markers`` a file of apriltag_ros, and a layer such as ``tags`` a table. The corners of ``markers`` become points.
    Raises InputError if a value is invalid.
    """
    for name, layer in layers().items():
        if layer.read and name in content:
            content = {**content, name: load(layer.read)(content[name], source, folder)}
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
        if isinstance(named := content["markers"], dict) and isinstance(named.get("file"), str):
            content = {**content, "markers": read_tag_file(named, source, folder)}
        markers = parse_model(_Markers, {"markers": content["markers"]}, source).markers
        known = content.get("points")
        points = corner_points(markers) if known is None else known.with_points(corner_points(markers), source)
        content = {key: value for key, value in content.items() if key != "markers"} | {"points": points}
    return parse_model(World, content, source)


def write_world(world: World, path: str | Path) -> None:
    """Write a map to ``NAME.world.toml``, its layers to tables such as ``NAME.tags.csv``, its points to ``NAME.points.parquet``."""
    path = Path(path)
    content = world.model_dump(mode="json", exclude_none=True, exclude={"points"})
    base = path.name.removesuffix(".toml").removesuffix(".world")
    for name, layer in layers().items():
        if layer.write and (entry := load(layer.write)(getattr(world, name), path.parent / base)) is not None:
            content[name] = entry
    if world.points is not None:
        content["points"] = base + POINTS_SUFFIX
        write_points(world.points, path.parent / content["points"])
    write_toml(path, content)
