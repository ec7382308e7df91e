"""Simulated logs: worlds, drives through them, and sensor measurements."""

from factorgraph_loc.simulation.filming import Film, film, with_images
from factorgraph_loc.simulation.settings import PRESETS, SimulationSettings, named_settings, preset, read_settings
from factorgraph_loc.simulation.simulate import simulate

__all__ = [
    "PRESETS",
    "Film",
    "SimulationSettings",
    "film",
    "named_settings",
    "preset",
    "read_settings",
    "settings",
    "simulate",
    "with_images",
    "worlds",
]
