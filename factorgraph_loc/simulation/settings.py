"""Settings of a simulation: world, drive, sensors and faults. They come from presets, and from files that change a preset."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, model_validator

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import FileModel, InUnit, add_fields, inside, nearest, parse_model, read_toml
from factorgraph_loc.io.native.rig_file import read_rig
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.settings import Hertz
from factorgraph_loc.plugins import load
from factorgraph_loc.sensors.registry import functions, sensors
from factorgraph_loc.text import quoted

MOST_TAGS = 10_000
MOST_OBSERVATIONS = 50_000_000  # largest number of simulated observations of one kind, to limit the memory
Surface = Literal["wall", "shelf", "floor"]


class WorldSettings(FileModel):
    """Settings of the building and its tags, landmarks and points. Either ``tags`` or ``density`` must be given."""

    plan: Literal["office", "hall", "warehouse", "corridors"] = "office"
    """hall: one empty room; corridors: an H with a half-turn symmetry, whose ends differ only by three hanging tags"""
    width: Annotated[float, Field(ge=2.0, le=500.0), InUnit("m")] = 20.0
    """size along x"""
    depth: Annotated[float, Field(ge=2.0, le=500.0), InUnit("m")] = 12.0
    """size along y"""
    tags: Annotated[int, Field(ge=0, le=MOST_TAGS)] | None = None
    """number of tags"""
    density: Annotated[float, Field(ge=1e-4, le=100.0), InUnit("tags per m^2")] | None = None
    """density of tags, instead of their number"""
    surfaces: Annotated[tuple[Surface, ...], Field(min_length=1)] = ("wall", "shelf")
    """places of tags; shelf includes furniture"""
    tag_height: Annotated[float, Field(ge=0.0, le=10.0), InUnit("m")] = 1.2
    """height of the tags that are not on the floor"""
    even: bool = False
    """whether tags are at equal distances along the walls, symmetric on both sides, rather than at random"""
    antennas: Annotated[int, Field(ge=0, le=1000)] = 0
    """number of fixed RFID antennas at doors and on walls, which read the tags on the robot"""
    landmarks: Annotated[int, Field(ge=0, le=10_000)] = 0
    """number of landmarks on the walls"""
    points: Annotated[int, Field(ge=0, le=10_000)] = 0
    """number of named points for a camera on walls and furniture"""

    @model_validator(mode="after")
    def _has_one_number(self) -> WorldSettings:
        if (self.tags is None) == (self.density is None):
            raise ValueError("tags and density are both given or both missing, expected exactly one of them")
        if self.tag_count() > MOST_TAGS:
            raise ValueError(f"density results in {self.tag_count():,} tags, expected at most {MOST_TAGS:,}")
        return self

    def antenna_names(self) -> list[str]:
        return [f"A{i:03d}" for i in range(self.antennas)]

    def tag_count(self) -> int:
        if self.tags is not None:
            return self.tags
        return round((self.density or 0.0) * self.width * self.depth)


class DriveSettings(FileModel):
    """Settings of the drive of the robot between random places."""

    duration: Annotated[float, Field(ge=1.0, le=36_000.0), InUnit("s")] = 600.0
    """duration of the log"""
    speed: Annotated[float, Field(ge=0.01, le=3.0), InUnit("m/s")] = 0.5
    """highest speed"""
    turn_rate: Annotated[float, Field(ge=0.01, le=6.0), InUnit("rad/s")] = 1.0
    """highest turn rate"""
    rate: Annotated[float, Field(ge=10.0, le=50.0), InUnit("1/s")] = 10.0
    """rate of reference poses"""
    clearance: Annotated[float, Field(ge=0.25, le=2.0), InUnit("m")] = 0.3
    """least distance of the path from walls"""


class ImageSettings(FileModel):
    """Settings of the simulated images. A pixel of value v (0 to 255) has the variance ``read_noise``^2 +
    ``shot_noise`` v."""

    rate: Hertz = 5.0
    """images per second"""
    exposure: Annotated[float, Field(ge=0.0, le=0.2), InUnit("s")] = 0.005
    """exposure time, which causes motion blur; stamps are in its middle"""
    read_noise: Annotated[float, Field(ge=0.0, le=50.0), InUnit("of 255")] = 1.5
    """standard deviation of a black pixel"""
    shot_noise: Annotated[float, Field(ge=0.0, le=10.0)] = 0.03
    """additional variance of a pixel per unit of its value"""
    vignetting: Annotated[float, Field(ge=0.0, le=0.9)] = 0.3
    """relative loss of brightness in the corners"""


class SimulationSettings(FileModel):
    """All settings of a simulation except the seed.

    ``world``: the building with its objects. ``drive``: the path of the robot. Further sections, which sensors add:
    ``sightings`` of landmarks, ``rssi`` and ``phase`` of RFID reads, ``faults`` of RFID reads, and ``pixels`` of
    points.
    """

    name: str = "office"
    """name of the log"""
    world: WorldSettings
    world_seed: Annotated[int, Field(ge=0, le=2**63 - 1)] | None = None
    """seed of the building, its textures and its survey, for several drives in one building; by default the seed of the log"""
    drive: DriveSettings = DriveSettings()
    rounds_per_second: Hertz = 2.0
    """inventory rounds of each antenna"""
    images: ImageSettings = ImageSettings()
    rig: Rig

    if TYPE_CHECKING:

        def __init__(self, **values: Any) -> None: ...
        def __getattr__(self, section: str) -> Any: ...

    @model_validator(mode="after")
    def _fits(self) -> SimulationSettings:
        for what, count in self.observation_counts().items():
            if count > MOST_OBSERVATIONS:
                raise ValueError(
                    f"{what} are observed {count:,.0f} times in total, expected at most {MOST_OBSERVATIONS:,}: "
                    "reduce drive.duration or a rate"
                )
        return self

    def observation_counts(self) -> dict[str, float]:
        """Return {kind of objects (tags, landmarks, points): expected number of simulated observations}. Raises
        ValueError if the settings are inconsistent."""
        counts: dict[str, float] = {}
        for name, rates in functions("looks", self.rig):
            for what, often in rates(self.model_copy(update={"rig": self.rig.alone(name)})).items():
                counts[what] = counts.get(what, 0.0) + self.drive.duration * often
        return counts


def _add_sections() -> None:
    added: dict[str, tuple[Any, Any]] = {}
    for sensor in sensors().values():
        for name, section in sensor.simulation.items():
            kind = load(section.kind)
            added[name] = (kind, kind()) if section.always else (kind | None, None)
    add_fields(SimulationSettings, added, after="rounds_per_second")


_add_sections()


# the robot Rackham: eight antennas at the height of the tags, odometry with the noise of the simulated wheels
RACKHAM_RIG: Mapping[str, Any] = {
    "name": "rackham",
    "sensors": ["odometry", "rfid"],
    "odometry": {
        "noise": {
            "along": {"per_distance": 0.01},
            "lateral": {"per_distance": 0.005},
            "heading": {"per_distance": 0.02618},
        },
        "uncertainty": {"scale_distance": 0.02, "scale_rotation": 0.02, "heading_drift": 0.01745},
    },
    "rfid": {
        "preset": "rackham",
        "preset_z": 1.2,
        "models": {"default": {"kind": "beam", "p0": 0.9, "r_max": 4.5, "s_r": 0.3, "sigma_phi": 0.698}},
        "false_read": 1e-3,
        "tempering": 1.0,
    },
    "bearing_range": {"range_sigma": 0.05, "range_sigma_relative": 0.02, "bearing_sigma": 0.02},
    # the camera is pitched slightly upwards, because walls have more texture than floors
    "camera": {
        "fx": 410.0,
        "fy": 411.0,
        "cx": 322.0,
        "cy": 238.0,
        "distortion": [-0.06, 0.012, 4e-4, -3e-4],
        "x": 0.2,
        "z": 1.0,
        "pitch": -0.08,
    },
}
_OFFICE: Mapping[str, Any] = {"world": {"plan": "office", "tags": 40}, "rig": RACKHAM_RIG}
# During a fade a tag is not read. Fades take the fraction f of the time and have the mean duration d. Outside of fades a round
# reads the tag with probability p. Fades increase the variance of the number of reads in rounds at intervals dt, by the factor
# 1 + 2 rho / (1 - rho) f p / (1 - (1 - f) p) with rho = exp(-dt / (d (1 - f))). The factor is 1.9 at p = 0.5. For a robot at
# rest, its inverse is the tempering exponent. For a moving robot, 0.7 gives the smoother the ideal causal ANEES of 3.0 over six
# runs of 300 s, and 0.6 gives 2.8.
_BURSTY: Mapping[str, Any] = {
    "faults": {"fading": {"duration": 2.0, "share": 0.2}},
    "rig": {"rfid": {"miss": 0.2, "tempering": 0.7}},
}


EXCLUSIVE = (("tags", "density"), ("antennas", "preset"))  # pairs of keys: a change that sets one key removes the other


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the nested table ``base`` with the values of ``changes``. A table in ``changes`` with another value of the
    key ``kind`` replaces the whole table in ``base``."""
    if "kind" in changes and changes["kind"] != base.get("kind"):
        return dict(changes)
    out = dict(base)
    for pair in EXCLUSIVE:
        for key, partner in (pair, pair[::-1]):
            if key in changes and partner not in changes:
                out.pop(partner, None)
    for key, value in changes.items():
        old = out.get(key)
        out[key] = merged(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return out


# two tags on the robot, one facing to the front and one to the back
_CARRIED: Mapping[str, Any] = {
    "front": {"x": 0.25, "z": 1.2, "facing": 0.0},
    "back": {"x": -0.25, "z": 1.2, "facing": 3.1415},
}
_READER: Mapping[str, Any] = {key: value for key, value in RACKHAM_RIG["rfid"].items() if not key.startswith("preset")}

PRESETS: Mapping[str, Mapping[str, Any]] = {
    "office": _OFFICE,
    "sparse": merged(_OFFICE, {"world": {"tags": 15}}),
    "bursty": merged(_OFFICE, _BURSTY),
    "gates": {
        "world": {"plan": "office", "tags": 0, "antennas": 16},
        "rig": {**RACKHAM_RIG, "rfid": {**_READER, "tags": _CARRIED}},
    },
    "corridor": merged(
        _OFFICE,
        {"world": {"plan": "hall", "width": 40.0, "depth": 3.0, "tags": 20, "surfaces": ["wall"], "even": True}},
    ),
    "warehouse": {
        "world": {"plan": "warehouse", "width": 30.0, "depth": 20.0, "density": 0.04, "surfaces": ["shelf"]},
        "rig": RACKHAM_RIG,
    },
    "symmetric": {
        "world": {"plan": "corridors", "width": 30.0, "depth": 24.0, "tags": 3},
        "rig": RACKHAM_RIG,
    },
}


def preset(name: str, changes: Mapping[str, Any] | None = None) -> SimulationSettings:
    """Return the settings of the preset ``name``, such as "office". ``changes``: nested tables of values that replace
    those of the preset. Raises InputError for an unknown preset or key, or for a value out of bounds."""
    content = merged(_preset(name, "the settings"), changes or {})
    return parse_model(SimulationSettings, content, "the settings")


def read_settings(path: Path, changes: Mapping[str, Any] | None = None) -> SimulationSettings:
    """Return the settings in a TOML file. ``changes``: nested tables of values that override those of the file.

    The file changes the settings of a preset. Its key ``preset`` names the preset; the default is ``office``. The key
    ``rig`` may be the path of a rig file in the folder of the settings file. Raises InputError if the file is not
    valid.
    """
    content = read_toml(path)
    base = _preset(content.pop("preset", "office"), path)
    base["name"] = path.stem
    folder = path.parent
    if isinstance(content.get("rig"), str):
        file = inside(folder, content.pop("rig"), path)
        base["rig"] = read_rig(file).model_dump(mode="json", exclude_none=True)
        folder = file.parent
    settings = parse_model(SimulationSettings, merged(merged(base, content), changes or {}), path)
    return settings.model_copy(update={"rig": settings.rig.placed(folder)})


def named_settings(what: str, changes: Mapping[str, Any] | None = None) -> SimulationSettings:
    """Return the settings of the preset ``what``, or of the file ``what`` if it ends with ``.toml``. ``changes``:
    nested tables of values that override these settings."""
    return read_settings(Path(what), changes) if what.endswith(".toml") else preset(what, changes)


def _preset(name: Any, source: object) -> dict[str, Any]:
    if not isinstance(name, str) or name not in PRESETS:
        raise InputError(f"{source}: preset {quoted(name)} is not known{nearest(str(name), list(PRESETS))}")
    return {"name": name, **PRESETS[name]}
