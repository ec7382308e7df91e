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
        experiment,
        features,
        images,
        info,
        load,
        map,
        report,
        run,
        simulate,
    )
    from factorgraph_loc.experiments.index import load_results
    from factorgraph_loc.localizer import Localizer

__version__ = "0.1.0"
__all__ = [
    "Localizer",
    "calibrate",
    "compare",
    "convert",
    "datasets",
    "experiment",
    "features",
    "images",
    "info",
    "load",
    "load_results",
    "map",
    "report",
    "run",
    "simulate",
]

# by name: those that are not among the verbs; to read a table, nothing that estimates is needed
_ELSEWHERE = {"Localizer": "factorgraph_loc.localizer", "load_results": "factorgraph_loc.experiments.index"}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_ELSEWHERE.get(name, "factorgraph_loc.api")), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
