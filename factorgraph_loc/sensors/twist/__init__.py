"""Measured motion in space."""

from factorgraph_loc.model.sections import Section
from factorgraph_loc.sensors.registry import Channel, SensorType

__all__ = ["SENSOR", "measurement", "settings"]

SENSOR = SensorType(
    "twist",
    channels=(
        Channel(
            "twist",
            streams=("factorgraph_loc.sensors.twist.measurement:TwistStream",),
            measurements=("factorgraph_loc.sensors.twist.measurement:Twist",),
            described=("factorgraph_loc.sensors.twist.measurement:TWIST",),
            check="factorgraph_loc.sensors.twist.measurement:check",
            section="twist",
            motion="space",
        ),
    ),
    settings={"twist": Section("factorgraph_loc.sensors.twist.settings:TwistSettings")},
)
