"""What is simulated: the world, the drive, the sensors and their faults; presets of them, and files that change a preset."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, model_validator

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import FileModel, add_fields, inside, nearest, parse_model, read_toml
from factorgraph_loc.io.native.rig_file import read_rig
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.simulation_units import Hertz
from factorgraph_loc.plugins import load
from factorgraph_loc.sensors.registry import functions, sensors
from factorgraph_loc.text import quoted

MOST_TAGS = 10_000
MOST_LOOKS = 50_000_000  # of a kind of sensor at tags, landmarks or points: all are in memory at once
Surface = Literal["wall", "shelf", "floor"]


class WorldSettings(FileModel):
    """A plan of ``width`` times ``depth`` metres, from (0, 0) to there; ``hall``: one room with nothing in it; ``corridors``: an H
    that looks the same when it is turned by half, with three tags that hang, which alone tell its ends apart.

    ``tags``: how many, or ``density`` of them per m^2, spread over ``surfaces`` (``shelf``: furniture too) at ``tag_height``;
    ``even``: at equal distances along the walls, alike on both sides, in place of at random. ``landmarks``: on the walls.
    ``points``: named points on walls and furniture that a camera may see.
    """

    plan: Literal["office", "hall", "warehouse", "corridors"] = "office"
    width: Annotated[float, Field(ge=2.0, le=500.0, description="m")] = 20.0
    depth: Annotated[float, Field(ge=2.0, le=500.0, description="m")] = 12.0
    tags: Annotated[int, Field(ge=0, le=MOST_TAGS)] | None = None
    density: Annotated[float, Field(ge=1e-4, le=100.0, description="tags per m^2")] | None = None
    surfaces: Annotated[tuple[Surface, ...], Field(min_length=1)] = ("wall", "shelf")
    tag_height: Annotated[float, Field(ge=0.0, le=10.0, description="m")] = 1.2
    even: bool = False
    landmarks: Annotated[int, Field(ge=0, le=10_000)] = 0
    points: Annotated[int, Field(ge=0, le=10_000)] = 0

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
    """A drive between random places. ``rate``: of the reference. ``clearance``: from walls, for the path's points."""

    duration: Annotated[float, Field(ge=1.0, le=14_400.0, description="s")] = 600.0
    speed: Annotated[float, Field(ge=0.01, le=3.0, description="m/s")] = 0.5
    turn_rate: Annotated[float, Field(ge=0.01, le=6.0, description="rad/s")] = 1.0
    rate: Annotated[float, Field(ge=10.0, le=50.0, description="1/s")] = 10.0
    clearance: Annotated[float, Field(ge=0.25, le=2.0, description="m")] = 0.3


class ImageSettings(FileModel):
    """Images of the rendered building: ``rate`` of them, ``exposure`` time, noise of the variance ``read_noise``^2 + ``shot_noise``
    times the value of a pixel (0 to 255), brightness that wanders by the share ``gain_drift`` over some ten seconds, and the
    share ``vignetting`` of it that is lost at the corners."""

    rate: Hertz = 5.0
    exposure: Annotated[float, Field(ge=0.0, le=0.2, description="s")] = 0.005
    read_noise: Annotated[float, Field(ge=0.0, le=50.0, description="of 255")] = 1.5
    shot_noise: Annotated[float, Field(ge=0.0, le=10.0)] = 0.03
    gain_drift: Annotated[float, Field(ge=0.0, le=0.5)] = 0.1
    vignetting: Annotated[float, Field(ge=0.0, le=0.9)] = 0.3


class SimulationSettings(FileModel):
    """Everything but the seed. ``rounds_per_second``: inventory rounds of each antenna. ``rig``: what estimators are told, and what
    reads and sightings are drawn from. ``world_seed``: of the world, its look and its survey, if several drives are to go through
    one world; else the seed of the log is theirs too. Other sections are those that sensors register: ``sightings``, ``rssi`` and
    ``phase``, which reads have if they are given, ``faults`` of them, ``pixels``."""

    name: str = "office"
    world: WorldSettings
    world_seed: Annotated[int, Field(ge=0, le=2**63 - 1)] | None = None
    drive: DriveSettings = DriveSettings()
    rounds_per_second: Hertz = 2.0
    images: ImageSettings = ImageSettings()
    rig: Rig

    if TYPE_CHECKING:

        def __init__(self, **values: Any) -> None: ...
        def __getattr__(self, section: str) -> Any: ...

    @model_validator(mode="after")
    def _fits(self) -> SimulationSettings:
        for what, looks in self.looks().items():
            if looks > MOST_LOOKS:
                raise ValueError(f"{what} are looked for {looks:,.0f} times in all, expected at most {MOST_LOOKS:,}")
        return self

    def looks(self) -> dict[str, float]:
        """How often a drive looks for each of its tags, landmarks and points, added up over all that there are of a kind.
        ValueError where the settings do not fit together."""
        per_second = {what: often for _, looks in functions("looks") for what, often in looks(self).items()}
        return {what: self.drive.duration * often for what, often in per_second.items()}


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
    # a little upwards: there is more to see on walls than on floors
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
# Fades of a share f that last d in the mean make the count of reads in many rounds, dt apart, vary more than independent rounds
# would: 1 + 2 rho / (1 - rho) f p / (1 - (1 - f) p) times as much, with rho = exp(-dt / (d (1 - f))), where a share p of the rounds
# outside fades read the tag: 1.9 times at p = 0.5. One over that is too cautious, since the robot moves on.
# The tempering is that at which the smoother's causal ANEES is 3: 3.0 over six runs of 300 s, 2.8 at 0.6.
_BURSTY: Mapping[str, Any] = {
    "faults": {"fading": {"duration": 2.0, "share": 0.2}},
    "rig": {"rfid": {"miss": 0.2, "tempering": 0.7}},
}


EXCLUSIVE = (("tags", "density"), ("antennas", "preset"))  # a change to one takes the other away


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """``base`` with ``changes``, tables within tables merged alike; a table of another ``kind`` takes the place of the old one."""
    if "kind" in changes and changes["kind"] != base.get("kind"):
        return dict(changes)
    out = dict(base)
    for pair in EXCLUSIVE:
        for key, other in (pair, pair[::-1]):
            if key in changes and other not in changes:
                out.pop(other, None)
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
    """The settings of a preset, with ``changes`` as nested tables. InputError names a wrong preset, key or value."""
    content = merged(_preset(name, "the settings"), changes or {})
    return parse_model(SimulationSettings, content, "the settings")


def read_settings(path: Path, changes: Mapping[str, Any] | None = None) -> SimulationSettings:
    """The settings of a TOML file: ``preset`` (default office), and what differs from it. ``rig`` may be the name of a file below
    the folder. InputError names file, key and what is expected."""
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
    """The settings of a preset, or of a file where ``what`` looks like one."""
    return read_settings(Path(what), changes) if what.endswith(".toml") else preset(what, changes)


def _preset(name: Any, source: object) -> dict[str, Any]:
    if not isinstance(name, str) or name not in PRESETS:
        raise InputError(f"{source}: preset is {quoted(name)}{nearest(str(name), list(PRESETS))}")
    return {"name": name, **PRESETS[name]}
