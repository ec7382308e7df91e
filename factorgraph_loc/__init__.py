"""Indoor robot localization from wheel odometry, RFID tags, landmarks and cameras.

The public names are imported from here: the commands as functions, such as ``factorgraph_loc.run(log, "ekf")``, the types of
their arguments and results, functions that read and write files, and the online ``Localizer``. Imports are lazy.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from factorgraph_loc import builtin as builtin
from factorgraph_loc.version import __version__ as __version__

if TYPE_CHECKING:
    from factorgraph_loc.api.experimenting import active, experiment, report, status
    from factorgraph_loc.api.learning import build_map, calibrate, features
    from factorgraph_loc.api.logs import convert, datasets, info, manifest, simulate
    from factorgraph_loc.api.lookups import (
        known_estimators,
        known_policies,
        known_presets,
        known_readers,
        known_rigs,
        known_sensors,
        new_rig,
    )
    from factorgraph_loc.api.results import export, view
    from factorgraph_loc.api.running import Run, compare, run
    from factorgraph_loc.errors import FglocError, InputError, RunFailedError
    from factorgraph_loc.evaluation.inference import contrast
    from factorgraph_loc.experiments.result_table import load_results
    from factorgraph_loc.experiments.trajectory_score import score
    from factorgraph_loc.io.native.native import write_native
    from factorgraph_loc.io.native.rig_file import read_rig, write_rig
    from factorgraph_loc.io.native.world_file import read_world, write_world
    from factorgraph_loc.io.readers.load import load, read_log
    from factorgraph_loc.live.localizer import Localizer
    from factorgraph_loc.maps.points import PointMap
    from factorgraph_loc.model.belief import PoseEstimate
    from factorgraph_loc.model.log import Log, StartPose
    from factorgraph_loc.model.measurement import Measurement, Tick
    from factorgraph_loc.model.rig import Rig
    from factorgraph_loc.model.trajectory import Trajectory, read_tum, write_tum
    from factorgraph_loc.model.trajectory3 import Trajectory3
    from factorgraph_loc.model.world import World
    from factorgraph_loc.sensors.camera.measurement import PixelSightings
    from factorgraph_loc.sensors.camera.stream import FeatureStream, ImageStream, SightingStream
    from factorgraph_loc.sensors.landmarks.measurement import BearingRange, BearingRangeStream
    from factorgraph_loc.sensors.landmarks.settings import Landmark
    from factorgraph_loc.sensors.loops.measurement import Loops, LoopStream
    from factorgraph_loc.sensors.measurements import Exteroceptive, Odometry
    from factorgraph_loc.sensors.odometry.measurement import (
        IncrementOdometry,
        IncrementStream,
        VelocityOdometry,
        VelocityStream,
        YawRate,
        YawRateStream,
    )
    from factorgraph_loc.sensors.rfid.grids import read_grid, write_grid
    from factorgraph_loc.sensors.rfid.map import Tag
    from factorgraph_loc.sensors.rfid.measurement import RfidScan
    from factorgraph_loc.sensors.rfid.pushed import RfidRead
    from factorgraph_loc.sensors.rfid.stream import RfidStream
    from factorgraph_loc.vision.frame import CameraFrame

__all__ = [
    "BearingRange",
    "BearingRangeStream",
    "CameraFrame",
    "Exteroceptive",
    "FeatureStream",
    "FglocError",
    "ImageStream",
    "IncrementOdometry",
    "IncrementStream",
    "InputError",
    "Landmark",
    "Localizer",
    "Log",
    "LoopStream",
    "Loops",
    "Measurement",
    "Odometry",
    "PixelSightings",
    "PointMap",
    "PoseEstimate",
    "RfidRead",
    "RfidScan",
    "RfidStream",
    "Rig",
    "Run",
    "RunFailedError",
    "SightingStream",
    "StartPose",
    "Tag",
    "Tick",
    "Trajectory",
    "Trajectory3",
    "VelocityOdometry",
    "VelocityStream",
    "World",
    "YawRate",
    "YawRateStream",
    "active",
    "build_map",
    "calibrate",
    "compare",
    "contrast",
    "convert",
    "datasets",
    "experiment",
    "export",
    "features",
    "info",
    "known_estimators",
    "known_policies",
    "known_presets",
    "known_readers",
    "known_rigs",
    "known_sensors",
    "load",
    "load_results",
    "manifest",
    "new_rig",
    "read_grid",
    "read_log",
    "read_rig",
    "read_tum",
    "read_world",
    "report",
    "run",
    "score",
    "simulate",
    "status",
    "view",
    "write_grid",
    "write_native",
    "write_rig",
    "write_tum",
    "write_world",
]

# module of each public name
_MODULES = {
    "api.experimenting": ("active", "experiment", "report", "status"),
    "api.learning": ("features", "build_map", "calibrate"),
    "api.logs": ("convert", "datasets", "info", "manifest", "simulate"),
    "api.lookups": (
        "known_estimators",
        "new_rig",
        "known_policies",
        "known_presets",
        "known_readers",
        "known_rigs",
        "known_sensors",
    ),
    "api.results": ("export", "view"),
    "api.running": ("Run", "compare", "run"),
    "errors": ("FglocError", "InputError", "RunFailedError"),
    "evaluation.inference": ("contrast",),
    "experiments.result_table": ("load_results",),
    "experiments.trajectory_score": ("score",),
    "io.native.native": ("write_native",),
    "io.native.rig_file": ("read_rig", "write_rig"),
    "io.native.world_file": ("read_world", "write_world"),
    "io.readers.load": ("load", "read_log"),
    "live.localizer": ("Localizer",),
    "sensors.rfid.pushed": ("RfidRead",),
    "maps.points": ("PointMap",),
    "model.belief": ("PoseEstimate",),
    "model.log": ("Log", "StartPose"),
    "model.measurement": ("Measurement", "Tick"),
    "sensors.measurements": ("Exteroceptive", "Odometry"),
    "model.rig": ("Rig",),
    "model.trajectory": ("Trajectory", "read_tum", "write_tum"),
    "model.trajectory3": ("Trajectory3",),
    "model.world": ("World",),
    "sensors.camera.measurement": ("PixelSightings",),
    "sensors.camera.stream": ("FeatureStream", "ImageStream", "SightingStream"),
    "sensors.landmarks.settings": ("Landmark",),
    "sensors.landmarks.measurement": ("BearingRange", "BearingRangeStream"),
    "sensors.loops.measurement": ("LoopStream", "Loops"),
    "sensors.odometry.measurement": (
        "IncrementOdometry",
        "VelocityOdometry",
        "YawRate",
        "IncrementStream",
        "VelocityStream",
        "YawRateStream",
    ),
    "sensors.rfid.grids": ("read_grid", "write_grid"),
    "sensors.rfid.map": ("Tag",),
    "sensors.rfid.measurement": ("RfidScan",),
    "sensors.rfid.stream": ("RfidStream",),
    "vision.frame": ("CameraFrame",),
}
_PLACES = {name: f"{__name__}.{module}" for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_PLACES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
