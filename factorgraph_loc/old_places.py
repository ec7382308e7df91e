"""Import paths of version 0.1.0 that have moved. Importing from them gives a DeprecationWarning."""

import importlib
import warnings
from collections.abc import Callable, Sequence
from functools import partial, update_wrapper
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

from factorgraph_loc.plugins import MOVED, load

_SENSORS = tuple(f"factorgraph_loc.sensors.{name}" for name in ("odometry", "twist", "landmarks", "rfid", "camera"))
_MODULES: dict[str, tuple[str, ...]] = {
    "factorgraph_loc.calibration.mapping": (
        "factorgraph_loc.mapping.mapping",
        "factorgraph_loc.sensors.landmarks.mapping",
    ),
    "factorgraph_loc.calibration.phase": ("factorgraph_loc.sensors.rfid.calibration.phase",),
    "factorgraph_loc.calibration.rssi": ("factorgraph_loc.sensors.rfid.calibration.rssi",),
    "factorgraph_loc.calibration.tag_mapping": ("factorgraph_loc.mapping.tag_mapping",),
    "factorgraph_loc.camera_settings": ("factorgraph_loc.sensors.camera.settings", "factorgraph_loc.vision.settings"),
    "factorgraph_loc.estimators.base": (
        "factorgraph_loc.fusion.base",
        "factorgraph_loc.model.belief",
        "factorgraph_loc.model.diagnostics",
        "factorgraph_loc.model.belief",
    ),
    "factorgraph_loc.evaluation.result": ("factorgraph_loc.model.result",),
    "factorgraph_loc.grids": ("factorgraph_loc.sensors.rfid.grids",),
    "factorgraph_loc.localizer": ("factorgraph_loc.live.localizer",),
    "factorgraph_loc.log": (
        "factorgraph_loc.model.log",
        *(f"{sensor}.measurement" for sensor in _SENSORS[:3]),
        *(f"{sensor}.stream" for sensor in _SENSORS[3:]),
    ),
    "factorgraph_loc.measurements": (
        "factorgraph_loc.model.measurement",
        "factorgraph_loc.sensors.measurements",
        *(f"{sensor}.measurement" for sensor in _SENSORS),
        "factorgraph_loc.vision.frame",
    ),
    "factorgraph_loc.points": ("factorgraph_loc.maps.points",),
    "factorgraph_loc.pushed": ("factorgraph_loc.sensors.pushed", "factorgraph_loc.sensors.rfid.pushed"),
    "factorgraph_loc.readers": (
        "factorgraph_loc.io.readers",
        "factorgraph_loc.io.native.native",
        "factorgraph_loc.io.write",
        "factorgraph_loc.files.shipped",
    ),
    "factorgraph_loc.readers.simulated_odometry": ("factorgraph_loc.sensors.odometry.simulation",),
    "factorgraph_loc.rfid_settings": ("factorgraph_loc.sensors.rfid.settings",),
    "factorgraph_loc.rig": (
        "factorgraph_loc.model.rig",
        "factorgraph_loc.io.native.rig_file",
        *(f"{sensor}.settings" for sensor in _SENSORS),
    ),
    "factorgraph_loc.tag_map": ("factorgraph_loc.sensors.rfid.tag_map",),
    "factorgraph_loc.trajectory": ("factorgraph_loc.model.trajectory",),
    "factorgraph_loc.trajectory3": ("factorgraph_loc.model.trajectory3",),
    "factorgraph_loc.vision.feature_evaluation": ("factorgraph_loc.evaluation.features.feature_evaluation",),
    "factorgraph_loc.vision.frontend": ("factorgraph_loc.sensors.camera.frontend",),
    "factorgraph_loc.vision.repeatability": ("factorgraph_loc.evaluation.features.repeatability",),
    "factorgraph_loc.vision.sequences": ("factorgraph_loc.evaluation.features.sequences",),
    "factorgraph_loc.world": (
        "factorgraph_loc.model.world",
        "factorgraph_loc.io.native.world_file",
        "factorgraph_loc.sensors.landmarks.settings",
        "factorgraph_loc.sensors.rfid.map",
    ),
}
_PACKAGES = ("factorgraph_loc.estimators", "factorgraph_loc.readers")
_SCRIPTS = {  # used by the project's own benchmarks only
    "factorgraph_loc.evaluation.ensembles": "benchmarks/benchmarking/statistics.py",
    "factorgraph_loc.evaluation.grid_filter": "benchmarks/rfid_benchmark/grid_filter.py",
    "factorgraph_loc.evaluation.paper_figures": "paper_figures.py",
    "factorgraph_loc.experiments.ensemble": "benchmarks/benchmarking/ensemble.py",
    "factorgraph_loc.experiments.optimal": "benchmarks/rfid_benchmark/optimal.py",
    "factorgraph_loc.experiments.simulated_trials": "benchmarks/rfid_benchmark/simulated_trials.py",
    "factorgraph_loc.experiments.trials": "benchmarks/benchmarking/trials.py",
    "factorgraph_loc.vision.weight_learning": "weight_learning.py",
}


class OldPlaces(MetaPathFinder, Loader):
    """Import hook that finds the old modules."""

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """The spec of the module, if it is an old one."""
        if name in _MODULES or name in _PACKAGES:
            return ModuleSpec(name, self, is_package=name in _PACKAGES)
        if name in _SCRIPTS:
            raise ImportError(
                f"{name} is no longer installed: it is scripts/{_SCRIPTS[name]} in the source repository", name=name
            )
        return None

    def exec_module(self, module: ModuleType) -> None:
        """Let the module resolve its names at their new locations."""

        def found(name: str) -> Any:
            for place in _MODULES.get(module.__name__, ()):
                if not name.startswith("__") and hasattr(where := importlib.import_module(place), name):
                    told = f"{module.__name__}.{name} is deprecated: import it from factorgraph_loc, or {place}"
                    warnings.warn(told, DeprecationWarning, stacklevel=2)
                    return getattr(where, name)
            raise AttributeError(f"module {module.__name__!r} has no attribute {name!r}")

        module.__dict__["__getattr__"] = found


def odometry_model(rig: Any, **options: bool) -> Any:
    """factorgraph_loc.sensors.odometry.motion.odometry_model"""
    return load("factorgraph_loc.sensors.odometry.motion:odometry_model")(rig, **options)


def estimated(rig: Any, *, section: str) -> Any:
    """factorgraph_loc.Rig.estimated"""
    return rig.estimated(section)


def _of(section: str) -> Callable[..., Any]:
    return update_wrapper(partial(estimated, section=section), estimated)


MOVED |= {"odometry_model": odometry_model}
MOVED |= {f"estimated_{section}": _of(section) for section in ("odometry", "bearing_range", "camera")}
