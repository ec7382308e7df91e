"""Validation of pushed motion in space."""

from typing import Any

from factorgraph_loc.files.values import within
from factorgraph_loc.sensors.twist.columns import TWIST
from factorgraph_loc.sensors.twist.measurement import Twist


def check(m: Twist, where: str) -> dict[str, Any]:
    """The fields of a measurement, with three axes each; InputError names the first invalid one."""
    return {name: within(where, TWIST[name], getattr(m, name), (3,)) for name in ("v", "w")}
