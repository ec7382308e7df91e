"""Settings of a simulation (world, drive, sensors, faults), presets, and files that change a preset."""

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
MOST_OBSERVATIONS = 50_000_000  # maximum number of simulated observations of one kind, which are all in memory
Surface = Literal["wall", "shelf", "floor"]


class WorldSettings(FileModel):
    """A plan of rooms from the origin and its content, with either ``tags`` or ``density``."""

    plan: Literal["office", "hall", "warehouse", "corridors"] = "office"
    """hall: one empty room; corridors: an H with a half-turn symmetry and three hanging tags, which alone distinguish its ends"""
    width: Annotated[float, Field(ge=2.0, le=500.0), InUnit("m")] = 20.0
    """size along x"""
    depth: Annotated[float, Field(ge=2.0, le=500.0), InUnit("m")] = 12.0
    """size along y"""
    tags: Annotated[int, Field(ge=0, le=MOST_TAGS)] | None = None
    """number of tags"""
    density: Annotated[float, Field(ge=1e-4, le=100.0), InUnit("tags per m^2")] | None = None
    """density of tags, instead of their number"""
    surfaces: Annotated[tuple[Surface, ...], Field(min_length=1)] = ("wall", "shelf")
    """where tags are; shelf includes furniture"""
    tag_height: Annotated[float, Field(ge=0.0, le=10.0), InUnit("m")] = 1.2
    """height of the tags that are not on the floor"""
    even: bool = False
    """whether tags are at equal distances along the walls, symmetric on both sides, rather than at random"""
    landmarks: Annotated[int, Field(ge=0, le=10_000)] = 0
    """number of landmarks on the walls"""
    points: Annotated[int, Field(ge=0, le=10_000)] = 0
    """number of named points on walls and furniture for a camera"""

    @model_validator(mode="after")
    def _has_one_number(self) -> WorldSettings:
        if (self.tags is None) == (self.density is None):
            raise ValueError("expected either tags or density")
        if self.tag_count() > MOST_TAGS:
            raise ValueError(f"density makes {self.tag_count():,} tags, expected at most {MOST_TAGS:,}")
        return self

    def tag_count(self) -> int:
        if self.tags is not None:
            return self.tags
        return round((self.density or 0.0) * self.width * self.depth)


class DriveSettings(FileModel):
    """A drive between random places."""

    duration: Annotated[float, Field(ge=1.0, le=36_000.0), InUnit("s")] = 600.0
    """duration of the log"""
    speed: Annotated[float, Field(ge=0.01, le=3.0), InUnit("m/s")] = 0.5
    """highest speed"""
    turn_rate: Annotated[float, Field(ge=0.01, le=6.0), InUnit("rad/s")] = 1.0
    """highest turn rate"""
    rate: Annotated[float, Field(ge=10.0, le=50.0), InUnit("1/s")] = 10.0
    """poses of the reference per second"""
    clearance: Annotated[float, Field(ge=0.25, le=2.0), InUnit("m")] = 0.3
    """least distance of the path from walls"""


class ImageSettings(FileModel):
    """Images of the rendered building. The noise of a pixel of value v (0 to 255) has the variance ``read_noise``^2 +
    ``shot_noise`` v."""

    rate: Hertz = 5.0
    """images per second"""
    exposure: Annotated[float, Field(ge=0.0, le=0.2), InUnit("s")] = 0.005
    """exposure time, which blurs what moves; stamps are in the middle of it"""
    read_noise: Annotated[float, Field(ge=0.0, le=50.0), InUnit("of 255")] = 1.5
    """standard deviation of a dark pixel"""
    shot_noise: Annotated[float, Field(ge=0.0, le=10.0)] = 0.03
    """additional variance of a pixel per unit of its value"""
    vignetting: Annotated[float, Field(ge=0.0, le=0.9)] = 0.3
    """relative loss of brightness at the corners"""


class SimulationSettings(FileModel):
    """All settings but the seed. Sensors register further sections: ``sightings``, ``rssi`` and ``phase`` of reads, ``faults`` of
    them, ``pixels``."""

    name: str = "office"
    """name of the log"""
    world: WorldSettings
    world_seed: Annotated[int, Field(ge=0, le=2**63 - 1)] | None = None
    """seed of the world, its appearance and its survey, for several drives in one world; by default the seed of the log"""
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
                    f"{what} are observed {count:,.0f} times in all, expected at most {MOST_OBSERVATIONS:,}"
                )
        return self

    def observation_counts(self) -> dict[str, float]:
        """The number of simulated observations of tags, landmarks and points, summed over all objects of a kind. Raises
        ValueError if the settings are inconsistent.
        """
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


# eight antennas at the tags' height; the odometry's noise is that of wheel_odometry
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
    # slightly upwards: walls have more texture than floors
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
# Fades affect a fraction f of the time and have the mean duration d. p: probability of a read outside of fades. Relative to
# independent rounds they increase the variance of the number of reads in many rounds at intervals dt by 1 + 2 rho / (1 - rho) f p
# / (1 - (1 - f) p), with rho = exp(-dt / (d (1 - f))): 1.9 at p = 0.5. The inverse is too conservative as a tempering, since the
# robot moves. This tempering makes the smoother's causal ANEES 3: 3.0 over six runs of 300 s, 2.8 at 0.6.
_BURSTY: Mapping[str, Any] = {
    "faults": {"fading": {"duration": 2.0, "share": 0.2}},
    "rig": {"rfid": {"miss": 0.2, "tempering": 0.7}},
}


EXCLUSIVE = (("tags", "density"), ("antennas", "preset"))  # setting one removes the other


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """``base`` with ``changes``, merged recursively; a table of another ``kind`` replaces the old one."""
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


PRESETS: Mapping[str, Mapping[str, Any]] = {
    "office": _OFFICE,
    "sparse": merged(_OFFICE, {"world": {"tags": 15}}),
    "bursty": merged(_OFFICE, _BURSTY),
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
    """The settings of a preset, with ``changes`` as nested tables. Raises InputError for a wrong preset, key or value."""
    content = merged(_preset(name, "the settings"), changes or {})
    return parse_model(SimulationSettings, content, "the settings")


def read_settings(path: Path, changes: Mapping[str, Any] | None = None) -> SimulationSettings:
    """Read settings from a TOML file: ``preset`` (default office), and changes to it. ``rig`` may name a file below the folder.
    Raises InputError with file, key and what is expected.
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
    """The settings of a preset, or of a file if ``what`` looks like a path."""
    return read_settings(Path(what), changes) if what.endswith(".toml") else preset(what, changes)


def _preset(name: Any, source: object) -> dict[str, Any]:
    if not isinstance(name, str) or name not in PRESETS:
        raise InputError(f"{source}: preset is {quoted(name)}{nearest(str(name), list(PRESETS))}")
    return {"name": name, **PRESETS[name]}
