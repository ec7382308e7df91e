"""Loop closures that another program has detected: the robot is near an earlier pose again. Some may be false."""

from factorgraph_loc.model.sections import Section
from factorgraph_loc.sensors.registry import Channel, SensorType

__all__ = ["SENSOR", "measurement"]

SENSOR = SensorType(
    "loops",
    channels=(
        Channel(
            "loops",
            tables=(
                "factorgraph_loc.sensors.loops.measurement:LOOPS",
                "factorgraph_loc.sensors.loops.measurement:LOOPS_BY_STAMP",
            ),
            assemble="factorgraph_loc.sensors.loops.measurement:assemble",
            check="factorgraph_loc.sensors.loops.measurement:check",
            section="loops",
        ),
    ),
    settings={"loops": Section("factorgraph_loc.sensors.loops.measurement:LoopSettings")},
    summarize="factorgraph_loc.sensors.loops.sensor:summarize",
    bind="factorgraph_loc.sensors.loops.sensor:bind",
)
