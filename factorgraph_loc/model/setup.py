"""The common arguments of all estimators."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World


@dataclass(frozen=True)
class Setup:
    """The common arguments of all estimators: robot, map, usable sensors, and a random generator of their own."""

    rig: Rig
    world: World
    sensors: tuple[str, ...]
    rng: np.random.Generator


MapUse = Literal["known", "extended", "unknown"]
# which uncertain constants an estimator learns: all, those that may differ between particles, or none
Calibration = Literal["all", "particles", "none"]
