"""Indoor localization from wheel odometry and landmarks: a GTSAM smoother and the filters that it is compared with.

The verbs of the command line are functions here: ``factorgraph_loc.load("plaza2")``, ``factorgraph_loc.run(log, "ekf")``. What they
need is imported when one is first used.
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
        features,
        images,
        info,
        load,
        map,
        run,
        simulate,
    )

__version__ = "0.1.0"
__all__ = [
    "calibrate",
    "compare",
    "convert",
    "datasets",
    "features",
    "images",
    "info",
    "load",
    "map",
    "run",
    "simulate",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module("factorgraph_loc.api"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
