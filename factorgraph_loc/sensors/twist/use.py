"""Use of measured motion in space by estimators in three dimensions."""

from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.sensors.twist.measurement import Twist
from factorgraph_loc.sensors.twist.settings import TwistSettings


def in_space(m: Measurement) -> Twist | None:
    """The measurement if it is a :class:`Twist`, else None."""
    return m if isinstance(m, Twist) else None


def twist_settings(setup: Setup) -> TwistSettings | None:
    """The settings of a run, or None if motion in space is not used."""
    return setup.rig.find(TwistSettings) if "twist" in setup.sensors else None
