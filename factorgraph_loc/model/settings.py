"""Types for the settings of sensors: bounded numbers with units, estimated constants, and the base class of sections of a rig.

Bounds reject values in a wrong unit (degrees for radians, mm for m).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Self

import numpy as np
from pydantic import AfterValidator, Field

from factorgraph_loc.files.models import FileModel, InUnit
from factors.se2 import Array

if TYPE_CHECKING:
    from factorgraph_loc.model.world import World

Angle = Annotated[float, Field(ge=-math.pi, le=math.pi), InUnit("rad")]
Offset = Annotated[float, Field(ge=-10.0, le=10.0), InUnit("m")]
Scale = Annotated[float, Field(ge=0.2, le=5.0)]
Seconds = Annotated[float, Field(ge=-5.0, le=5.0), InUnit("s")]
Rate = Annotated[float, Field(ge=-1.0, le=1.0), InUnit("rad/s")]
Noise = Annotated[float, Field(ge=0.0, le=5.0)]


Metres = Annotated[float, Field(ge=1e-3, le=1000.0), InUnit("m")]
Duration = Annotated[float, Field(ge=0.0, le=1e5), InUnit("s")]
Hertz = Annotated[float, Field(ge=1e-3, le=100.0), InUnit("1/s")]
Share = Annotated[float, Field(ge=0.0, lt=1.0)]


def _positive_semidefinite(value: tuple[float, float, float]) -> tuple[float, float, float]:
    xx, xy, yy = value
    # rounding may make the determinant of a singular matrix slightly negative
    if xx < 0.0 or yy < 0.0 or xy * xy > xx * yy * (1.0 + 1e-9):
        raise ValueError("expected (xx, xy, yy) [m^2] of a positive semi-definite matrix")
    return value


Variance = Annotated[float, Field(ge=-1e8, le=1e8), InUnit("m^2")]
Covariance = Annotated[tuple[Variance, Variance, Variance], AfterValidator(_positive_semidefinite)]


def spread_of(sigma: float, covariance: tuple[float, float, float] | None) -> Array:
    """Return the covariance (2, 2) [m^2] of a position. ``covariance``: its elements (xx, xy, yy) [m^2], or None.

    ``sigma`` [m]: the standard deviation of each coordinate, used if ``covariance`` is None.
    """
    if covariance is None:
        return sigma**2 * np.eye(2)
    xx, xy, yy = covariance
    return np.array(((xx, xy), (xy, yy)))


@dataclass(frozen=True)
class Estimated:
    """The P calibration constants of a sensor that are estimated, as corrections to the values in the rig.

    ``names`` (P,): their names. ``indices`` (P,): their indices in the field ``constants`` of the sensor's settings.
    ``sigmas`` (P,): their prior standard deviations.
    """

    names: tuple[str, ...]
    indices: tuple[int, ...]
    sigmas: Array

    @staticmethod
    def of(names: Sequence[str], uncertainty: FileModel | None) -> Estimated:
        """Return the constants among ``names`` that have a prior standard deviation above zero. ``uncertainty``: an
        object with standard deviations as attributes with these names. None means that all are zero."""
        return Estimated.among(names, np.array([getattr(uncertainty, name, 0.0) for name in names]))

    @staticmethod
    def among(names: Sequence[str], sigmas: Array) -> Estimated:
        """Return the constants among ``names`` (M,) that are estimated: those with ``sigmas`` (M,) above zero."""
        indices = tuple(np.flatnonzero(sigmas).tolist())
        return Estimated(tuple(names[i] for i in indices), indices, sigmas[list(indices)])

    def full(self, values: Array, count: int) -> Array:
        """Return corrections (..., count) of all ``count`` constants of the sensor. They are ``values`` (..., P) for
        the P estimated constants, and zero for the rest."""
        out = np.zeros((*np.shape(values)[:-1], count))
        out[..., list(self.indices)] = values
        return out


NOTHING = Estimated((), (), np.zeros(0))


class SensorSettings(FileModel):
    """The base class of the section of a sensor in a rig. ``constants``: names of its calibration constants.

    Constants with a standard deviation in the key ``uncertainty`` of the section may be estimated.
    """

    constants: ClassVar[tuple[str, ...]] = ()
    time_offset: Seconds = 0.0
    """added to the timestamps of the sensor"""

    def estimated(self) -> Estimated:
        """Return the constants that are estimated, those with an uncertainty above zero."""
        return Estimated.of(self.constants, getattr(self, "uncertainty", None))

    def map_error(self, world: World) -> Callable[[Array], Array] | None:
        """Return a function from poses (N, 3) to covariances (N, 3, 3) of the map's error, None if the map is exact.
        The error (x, y, heading) displaces and rotates the part of the map near a pose. ``world``: the map."""
        return None

    def placed(self, folder: Path) -> Self:
        """Return a copy of these settings for a rig file in ``folder``: paths of files are relative to it."""
        return self

    def write_beside(self, folder: Path) -> None:
        """Write the files that the settings name into ``folder``, the folder of the rig's file."""
