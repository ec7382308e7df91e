"""A compass: it measures the robot's heading, with a constant bias."""

from factorgraph_loc.model.sections import Section
from factorgraph_loc.sensors.registry import Channel, SensorType

SENSOR = SensorType(
    "compass",
    channels=(
        Channel(
            "compass",
            tables=("compass.stream:HEADINGS",),
            section="compass",
        ),
    ),
    settings={"compass": Section("compass.settings:CompassSettings")},
    simulation={"compass": Section("compass.settings:CompassSimulation", always=True)},
    simulate="compass.simulation:simulate",
    summarize="compass.summary:summarize",
    bind="compass.sensor:bind",
    calibrator="compass.calibration:CALIBRATOR",
)
