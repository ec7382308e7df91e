"""Radius and track of wheels, which the rig, or else a manifest, tells: one of them is taken to the other."""

from collections.abc import Mapping
from typing import Any

from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.odometry.settings import DifferentialDrive, OdometrySettings

TURNS, WAYS = {"left_angle", "left_rate"}, {"left", "left_speed"}  # columns of a mapped table


def with_wheels_of(rig: Rig | None, options: Mapping[str, Any]) -> Mapping[str, Any]:
    """The options of a reader with radius and track of the rig, where they tell of wheels and the rig knows these."""
    drive = None if rig is None else rig.of(OdometrySettings).wheels
    told = options.get("odometry")
    if drive is None or not isinstance(told, Mapping):
        return options
    known = drive.model_dump(exclude_none=True)
    if isinstance(wheels := told.get("wheels"), Mapping):
        return {**options, "odometry": {**told, "wheels": {**wheels, **_needed(known, wheels.get("unit") != "m")}}}
    if isinstance(columns := told.get("columns"), Mapping) and (TURNS | WAYS) & columns.keys():
        return {**options, "odometry": {**told, **_needed(known, bool(TURNS & columns.keys()))}}
    return options


def _needed(known: Mapping[str, Any], turns: bool) -> dict[str, Any]:
    return {name: value for name, value in known.items() if turns or name != "radius"}


def with_wheels_in(rig: Rig, options: Mapping[str, Any]) -> Rig:
    """The rig with the wheels that valid options tell of, if it has none."""
    told = options.get("odometry")
    settings = rig.of(OdometrySettings)
    if settings.wheels is not None or not isinstance(told, Mapping):
        return rig
    sizes = told.get("wheels") or told
    if sizes.get("track") is None:
        return rig
    drive = DifferentialDrive(radius=sizes.get("radius"), track=sizes["track"])
    return rig.model_copy(update={"odometry": settings.model_copy(update={"wheels": drive})})
