"""An inertial unit: specific force and turn rate about three axes."""

from factorgraph_loc.model.sections import Section
from factorgraph_loc.sensors.registry import Channel, SensorType

__all__ = ["SENSOR", "measurement", "settings"]

SENSOR = SensorType(
    "inertial",
    channels=(
        Channel(
            "inertial",
            streams=("factorgraph_loc.sensors.inertial.measurement:InertialStream",),
            measurements=("factorgraph_loc.sensors.inertial.measurement:Inertial",),
            tables=("factorgraph_loc.sensors.inertial.measurement:INERTIAL",),
            section="inertial",
            needs_section=True,
            motion="space",
        ),
    ),
    settings={"inertial": Section("factorgraph_loc.sensors.inertial.settings:InertialSettings")},
)
