"""Positions of the robot that another system measures, such as UWB, GNSS or motion capture."""

from factorgraph_loc.model.sections import Section
from factorgraph_loc.sensors.registry import Channel, SensorType

__all__ = ["SENSOR", "measurement"]

SENSOR = SensorType(
    "positions",
    channels=(
        Channel(
            "position",
            tables=(
                "factorgraph_loc.sensors.positions.measurement:POSITIONS",
                "factorgraph_loc.sensors.positions.measurement:POSITIONS_ON_EARTH",
            ),
            assemble="factorgraph_loc.sensors.positions.measurement:assemble",
            section="position",
        ),
    ),
    settings={"position": Section("factorgraph_loc.sensors.positions.measurement:PositionSettings", several=True)},
    locates=True,
    simulation={"positions": Section("factorgraph_loc.sensors.positions.simulation:PositionSimulation", always=True)},
    simulate="factorgraph_loc.sensors.positions.simulation:simulate",
    bind="factorgraph_loc.sensors.positions.sensor:bind",
    summarize="factorgraph_loc.sensors.positions.summary:summarize",
)
