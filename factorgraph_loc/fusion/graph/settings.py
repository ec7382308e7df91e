"""Settings of the graph estimators."""

import math
from typing import Annotated, Any

from pydantic import Field, PlainSerializer, ValidatorFunctionWrapHandler, WrapValidator, model_validator

from factorgraph_loc.files.models import FileModel, InUnit
from factorgraph_loc.model.setup import MapUse


class GraphSettings(FileModel):
    """Settings that all estimators with a factor graph have."""

    max_delay: Annotated[float, Field(ge=0.0, le=4.0), InUnit("s")] = 0.5
    """largest delay of a measurement; later measurements are counted and ignored"""
    self_calibration: bool = True
    """whether sensor constants that have an uncertainty in the rig are estimated"""
    landmarks: MapUse = "known"
    """known: landmarks of the map are fixed, others are ignored; extended: landmarks that the map lacks are estimated too; unknown:
    all landmarks are estimated, the default of runs with only images and odometry if the map has no points"""


def _lag(value: Any, bounded: ValidatorFunctionWrapHandler) -> Any:
    """Return infinity if the setting ``lag`` has the ``value`` "all". Otherwise return the value checked by the
    function ``bounded``."""
    return math.inf if value in ("all", math.inf) else bounded(value)


def _written(lag: float | None) -> float | str | None:
    """Return the setting ``lag`` for a file: "all" instead of infinity, otherwise the value."""
    return "all" if lag == math.inf else lag


class SmootherSettings(GraphSettings):
    """Settings of the smoother. The value ``all`` of ``lag`` in files is infinity in Python."""

    lag: Annotated[
        float | None, Field(ge=0.1, le=3600.0), InUnit("s"), WrapValidator(_lag), PlainSerializer(_written)
    ] = None
    """length of the window; older poses are final. The value all keeps the full history in the solver. By default,
    causal estimates come from a window of 10 s and the final trajectory from the whole problem; with loops, or if
    landmarks or points are estimated, the default is all"""
    smooth: bool = True
    """whether the final trajectory uses all measurements; otherwise it equals the causal estimates"""
    final_only: bool = False
    """whether the problem is solved only at the end, without causal estimates"""

    @model_validator(mode="after")
    def _has_a_final(self) -> "SmootherSettings":
        if self.final_only and not (self.smooth and self.lag in (None, math.inf)):
            given, remedy = (
                (f"lag is {self.lag:g}", "lag to all") if self.smooth else ("smooth is false", "smooth to true")
            )
            raise ValueError(f"final_only is true, but {given}: set {remedy}, or final_only to false")
        return self


class BatchSettings(GraphSettings):
    """Settings of the estimator ``Batch``, which optimises the whole log at its end."""
