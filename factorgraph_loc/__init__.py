"""Indoor localization from wheel odometry and landmarks: a GTSAM smoother and the filters that it is compared with.

What a script needs is imported from here: the verbs of the command line as functions, such as
``factorgraph_loc.run(log, "ekf")``, the values that they take and return, their files, and the ``Localizer`` of a robot that
drives. What a name needs is imported when it is first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from factorgraph_loc.api import (
        calibrate,
        compare,
        convert,
        datasets,
        experiment,
        features,
        images,
        info,
        map,
        report,
        run,
        simulate,
    )
    from factorgraph_loc.errors import FglocError, InputError, RunFailedError
    from factorgraph_loc.estimators.base import PoseEstimate
    from factorgraph_loc.evaluation.inference import contrast
    from factorgraph_loc.experiments.index import load_results
    from factorgraph_loc.grids import read_grid, write_grid
    from factorgraph_loc.localizer import Localizer
    from factorgraph_loc.log import (
        BearingRangeStream,
        FeatureStream,
        ImageStream,
        IncrementStream,
        Log,
        RfidStream,
        RightSightingStream,
        SightingStream,
        StartPose,
        TwistStream,
        VelocityStream,
        YawRateStream,
    )
    from factorgraph_loc.measurements import (
        BearingRange,
        CameraFrame,
        Exteroceptive,
        IncrementOdometry,
        Measurement,
        Odometry,
        PixelSightings,
        RfidScan,
        Tick,
        Twist,
        VelocityOdometry,
        YawRate,
    )
    from factorgraph_loc.points import PointMap
    from factorgraph_loc.pushed import RfidRead
    from factorgraph_loc.readers.load import load, read_log
    from factorgraph_loc.readers.native import write_native
    from factorgraph_loc.readers.write import write_log
    from factorgraph_loc.rig import Rig, read_rig, write_rig
    from factorgraph_loc.trajectory import Trajectory, read_tum, write_tum
    from factorgraph_loc.trajectory3 import Trajectory3
    from factorgraph_loc.world import Landmark, Tag, World, read_world, write_world

__version__ = "0.1.0"
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
    "Measurement",
    "Odometry",
    "PixelSightings",
    "PointMap",
    "PoseEstimate",
    "RfidRead",
    "RfidScan",
    "RfidStream",
    "Rig",
    "RightSightingStream",
    "RunFailedError",
    "SightingStream",
    "StartPose",
    "Tag",
    "Tick",
    "Trajectory",
    "Trajectory3",
    "Twist",
    "TwistStream",
    "VelocityOdometry",
    "VelocityStream",
    "World",
    "YawRate",
    "YawRateStream",
    "calibrate",
    "compare",
    "contrast",
    "convert",
    "datasets",
    "experiment",
    "features",
    "images",
    "info",
    "load",
    "load_results",
    "map",
    "read_grid",
    "read_log",
    "read_rig",
    "read_tum",
    "read_world",
    "report",
    "run",
    "simulate",
    "write_grid",
    "write_log",
    "write_native",
    "write_rig",
    "write_tum",
    "write_world",
]

# names by their module, below this package; all others are in `api`. To read a table, nothing that estimates is needed.
_MODULES = {
    "errors": ("FglocError", "InputError", "RunFailedError"),
    "estimators.base": ("PoseEstimate",),
    "evaluation.inference": ("contrast",),
    "experiments.index": ("load_results",),
    "grids": ("read_grid", "write_grid"),
    "localizer": ("Localizer",),
    "log": (
        "BearingRangeStream",
        "FeatureStream",
        "ImageStream",
        "IncrementStream",
        "Log",
        "RfidStream",
        "RightSightingStream",
        "SightingStream",
        "StartPose",
        "TwistStream",
        "VelocityStream",
        "YawRateStream",
    ),
    "measurements": (
        "BearingRange",
        "CameraFrame",
        "Exteroceptive",
        "IncrementOdometry",
        "Measurement",
        "Odometry",
        "PixelSightings",
        "RfidScan",
        "Tick",
        "Twist",
        "VelocityOdometry",
        "YawRate",
    ),
    "points": ("PointMap",),
    "pushed": ("RfidRead",),
    "readers.load": ("load", "read_log"),
    "readers.native": ("write_native",),
    "readers.write": ("write_log",),
    "rig": ("Rig", "read_rig", "write_rig"),
    "trajectory": ("Trajectory", "read_tum", "write_tum"),
    "trajectory3": ("Trajectory3",),
    "world": ("Landmark", "Tag", "World", "read_world", "write_world"),
}
_ELSEWHERE = {name: f"{__name__}.{module}" for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_ELSEWHERE.get(name, f"{__name__}.api")), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
