"""Reading and writing ``NAME.world.toml``, with the tables beside it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import FileModel, inside, parse_model, read_toml, write_toml
from factorgraph_loc.maps.markers import Marker, corner_points
from factorgraph_loc.maps.occupancy import read_walls
from factorgraph_loc.maps.points import POINTS_SUFFIX, read_points, write_points
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.rfid.map import TAGS_SUFFIX, TagsFile, read_mapped_tags, read_tags, write_tags
from factorgraph_loc.text import quoted


class _Markers(FileModel):
    markers: dict[str, Marker]


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


def write_world(world: World, path: str | Path) -> None:
    """Write ``NAME.world.toml``, the tags beside it as ``NAME.tags.csv``, or in the same file where one has a covariance, and the
    points as ``NAME.points.parquet``."""
    path = Path(path)
    content = world.model_dump(mode="json", exclude_none=True, exclude={"points"})
    base = path.name.removesuffix(".toml").removesuffix(".world")
    if world.tags and all(tag.covariance is None for tag in world.tags.values()):
        content["tags"] = base + TAGS_SUFFIX
        write_tags(world.tags, path.parent / content["tags"])
    if world.points is not None:
        content["points"] = base + POINTS_SUFFIX
        write_points(world.points, path.parent / content["points"])
    write_toml(path, content)
