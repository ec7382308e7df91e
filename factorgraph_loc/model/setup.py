"""What every estimator is made from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World


@dataclass(frozen=True)
class Setup:
    """What every estimator is made from: robot, map, the sensors it may use, and its own random generator."""

    rig: Rig
    world: World
    sensors: tuple[str, ...]
    rng: np.random.Generator


MapUse = Literal["known", "extended", "unknown"]
# which uncertain constants of sensors an estimator learns: all, those that may differ from particle to particle, or none
Calibration = Literal["all", "particles", "none"]
