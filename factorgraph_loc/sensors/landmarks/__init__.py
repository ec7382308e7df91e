"""Measures ranges and bearings of identified landmarks."""

from factorgraph_loc.model.sections import Layer, Section
from factorgraph_loc.sensors.registry import Channel, SensorType

__all__ = ["SENSOR", "measurement", "summary"]

SENSOR = SensorType(
    "landmarks",
    channels=(
        Channel(
            "bearing_range",
            tables=("factorgraph_loc.sensors.landmarks.measurement:BEARING_RANGE",),
            section="bearing_range",
        ),
    ),
    settings={
        "bearing_range": Section("factorgraph_loc.sensors.landmarks.measurement:BearingRangeSettings", several=True)
    },
    layers={
        "landmarks": Layer(
            "factorgraph_loc.sensors.landmarks.measurement:Landmark",
            read="factorgraph_loc.sensors.landmarks.measurement:read_layer",
        ),
    },
    detects="landmarks",
    bind="factorgraph_loc.sensors.landmarks.sensor:bind",
    summarize="factorgraph_loc.sensors.landmarks.summary:summarize",
    check="factorgraph_loc.sensors.landmarks.summary:check",
    draw="factorgraph_loc.sensors.landmarks.summary:draw",
    simulation={
        "sightings": Section("factorgraph_loc.sensors.landmarks.measurement:SightingSettings", always=True),
    },
    simulate="factorgraph_loc.sensors.landmarks.simulation:simulate",
    looks="factorgraph_loc.sensors.landmarks.simulation:looks",
    on_robot="factorgraph_loc.sensors.landmarks.simulation:on_robot",
    forecast="factorgraph_loc.sensors.landmarks.simulation:forecast",
    calibrator="factorgraph_loc.sensors.landmarks.calibrator:CALIBRATOR",
)
