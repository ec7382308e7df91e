"""Markers from ``tags.yaml``, the file of standalone tags and bundles of tags of apriltag_ros.

The axes of a tag point right, up and out of the tag, as somebody in front of it sees them.
"""

import warnings
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import scipy
from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.models import Coordinate, FileModel, InUnit, inside, parse_model
from factorgraph_loc.files.yaml import read_yaml
from factorgraph_loc.maps.markers import MarkerFamily, Turn
from factorgraph_loc.text import listed
from factors.se2 import Array

# columns: the axes of a tag, which point right, up and out of the tag, in a marker's frame: x out, y right, z up
TAG_AXES = np.array(((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
_CENTRED = {"x": 0.0, "y": 0.0, "z": 0.0, "qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0}
UNIT = 0.01  # tolerance of the length of a quaternion


class Place(FileModel):
    """The pose of a bundle or a single tag in the map. ``x``, ``y``, ``z`` [m]: its position. ``facing``, ``pitch``,
    ``roll`` [rad]: heading and upward tilt of the normal, and rotation about it."""

    x: Coordinate = 0.0
    y: Coordinate = 0.0
    z: Coordinate = 0.0
    facing: Turn = 0.0
    pitch: Annotated[float, Field(ge=-1.6, le=1.6), InUnit("rad")] = 0.0
    roll: Turn = 0.0

    def pose(self) -> tuple[Array, Array]:
        """Return the rotation (3, 3) of the axes of the tag or bundle in the world, and its position (3,)."""
        turn = scipy.spatial.transform.Rotation.from_euler("ZYX", (self.facing, -self.pitch, self.roll)).as_matrix()
        return turn @ TAG_AXES, np.array((self.x, self.y, self.z))


class TagFile(FileModel):
    """The section ``[markers]`` of a world file that refers to a file of apriltag_ros.

    ``file``: the path of that file. ``family``: the family of the tags. ``sigma`` [m]: standard deviation of each
    coordinate of a tag's position. ``at``: the poses {name of a bundle, or number of a single tag: pose}. The frame of
    a bundle without a pose is the frame of the map.
    """

    file: str
    family: MarkerFamily
    sigma: Annotated[float, Field(ge=0.0, le=10.0), InUnit("m")] = 0.0
    at: dict[str, Place] = Field(default_factory=dict)


class BundledTag(FileModel):
    """A tag in a file of apriltag_ros. ``id``: its number. ``size``: side of its black square [m]. ``x``, ``y``, ``z``
    [m] and the quaternion ``qw``, ``qx``, ``qy``, ``qz``: its pose in the frame of its bundle."""

    id: Annotated[int, Field(ge=0, le=1_000_000)]
    size: Annotated[float, Field(ge=1e-3, le=10.0), InUnit("m")]
    name: str = ""
    x: Coordinate = 0.0
    y: Coordinate = 0.0
    z: Coordinate = 0.0
    qw: float = 1.0
    qx: float = 0.0
    qy: float = 0.0
    qz: float = 0.0


class TagBundle(FileModel):
    """A bundle of AprilTags, which have known poses in a common frame. ``layout``: the tags."""

    name: str = ""
    layout: tuple[BundledTag, ...]


class _Tags(FileModel):
    standalone_tags: tuple[BundledTag, ...] = ()
    tag_bundles: tuple[TagBundle, ...] = ()


def read_tag_file(content: dict[str, Any], source: object, folder: Path) -> dict[str, dict[str, float]]:
    """Return the markers of a file of apriltag_ros, by name. Each is a dict with the keys and values of a world file.

    ``content``: the section ``[markers]`` of the world file ``source``, see :class:`TagFile`. ``folder``: the folder of
    the world file. A standalone tag without a pose in ``at`` is left out. Raises InputError if no marker remains.
    """
    settings = parse_model(TagFile, content, f"{source} [markers]")
    path = inside(folder, settings.file, source)
    stated = read_yaml(path)
    known = {key: stated[key] for key in _Tags.model_fields if key in stated}
    if not known:
        raise InputError(f"{path}: has neither standalone_tags nor tag_bundles, expected a file of apriltag_ros")
    tags = parse_model(_Tags, known, path)
    bundles = {bundle.name or f"bundle_{i}": bundle for i, bundle in enumerate(tags.tag_bundles)}
    alone = {str(tag.id): TagBundle(layout=(tag.model_copy(update=_CENTRED),)) for tag in tags.standalone_tags}
    if unknown := sorted(set(settings.at) - bundles.keys() - alone.keys()):
        names = listed([*bundles, *alone])
        raise InputError(f"{source} [markers]: at.{unknown[0]} is not in {path.name}, expected one of {names}")
    unplaced = [name for name in bundles if name not in settings.at]
    if len(unplaced) > 1:
        keys = " and ".join(f"[markers.at.{name}]" for name in unplaced[1:3])
        raise InputError(f"{source} [markers]: {path.name} has several bundles without a pose: give {keys}")
    placed = bundles | {name: tag for name, tag in alone.items() if name in settings.at}
    markers: dict[str, dict[str, float]] = {}
    for name, bundle in placed.items():
        at = settings.at.get(name)
        rotation, position = (np.eye(3), np.zeros(3)) if at is None else at.pose()
        for tag in bundle.layout:
            marker = f"{settings.family}-{tag.id}"
            if marker in markers:
                raise bad_field(path, "id", tag.id, "each tag in one place")
            markers[marker] = _marker(path, tag, rotation, position) | {"sigma": settings.sigma}
    if not markers:
        remedy = f"add the pose of each tag to the manifest, such as [markers.at.{next(iter(alone), '0')}]"
        raise InputError(f"{source} [markers]: {path.name} has no poses of tags: {remedy}")
    return markers


def _marker(path: Path, tag: BundledTag, rotation: Array, position: Array) -> dict[str, float]:
    """Return a ``tag`` as a marker: a dict with the keys and values of a world file. ``rotation`` (3, 3), ``position``
    (3,): the pose of the tag's bundle in the world. ``path``: the name of the file in errors."""
    quaternion = np.array((tag.qx, tag.qy, tag.qz, tag.qw))
    if not abs(float(np.linalg.norm(quaternion)) - 1.0) <= UNIT:
        raise bad_field(path, f"tag {tag.id}: qx, qy, qz, qw", quaternion.tolist(), "a unit quaternion")
    turn = rotation @ scipy.spatial.transform.Rotation.from_quat(quaternion).as_matrix() @ TAG_AXES.T
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of gimbal lock: the heading of a tag on the ceiling is arbitrary
        facing, down, roll = scipy.spatial.transform.Rotation.from_matrix(turn).as_euler("ZYX").tolist()
    x, y, z = (position + rotation @ np.array((tag.x, tag.y, tag.z))).tolist()
    return {"x": x, "y": y, "z": z, "size": tag.size, "facing": facing, "pitch": -down, "roll": roll}
