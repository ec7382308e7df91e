"""Measured motion in space, as estimators of a robot in space take it in."""

from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.sensors.twist.measurement import Twist
from factorgraph_loc.sensors.twist.settings import TwistSettings


def in_space(m: Measurement) -> Twist | None:
    """The motion in space that a measurement tells; None for another one."""
    return m if isinstance(m, Twist) else None


def twist_settings(setup: Setup) -> TwistSettings | None:
    """Those of a run; None where motion in space is not used."""
    return setup.rig.find(TwistSettings) if "twist" in setup.sensors else None
