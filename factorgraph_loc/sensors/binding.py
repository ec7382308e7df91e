"""Binding of the sensors of a run."""

from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.setup import Calibration, MapUse, Setup
from factorgraph_loc.sensors.base import Binding, Sensor
from factorgraph_loc.sensors.motion import Motion
from factorgraph_loc.sensors.registry import functions


def bound_sensors(
    setup: Setup,
    motion: Motion,
    diagnostics: Diagnostics,
    *,
    use: MapUse = "known",
    points: MapUse = "known",
    calibration: Calibration = "all",
) -> dict[str, Sensor]:
    """The exteroceptive sensors of a run by modality. ``use``: how landmarks of the map are used, ``points``: how its points are
    used."""
    binding = Binding(setup, motion, diagnostics, use, points, calibration)
    sensors: list[Sensor | None] = [bind(binding) for _, bind in functions("bind")]
    return {sensor.modality: sensor for sensor in sensors if sensor is not None}
