"""Detects image features and named points with a camera."""

from factorgraph_loc.model.sections import Section
from factorgraph_loc.sensors.registry import Channel, SensorType

__all__ = [
    "SENSOR",
    "frontend",
    "known_points",
    "measurement",
    "sensor",
    "settings",
    "summary",
    "use",
]

SENSOR = SensorType(
    "camera",
    channels=(
        Channel(
            "camera",
            tables=("factorgraph_loc.sensors.camera.measurement:CAMERA",),
            described=("factorgraph_loc.sensors.camera.measurement:FEATURES",),
            assemble="factorgraph_loc.sensors.camera.measurement:assemble",
            disassemble="factorgraph_loc.sensors.camera.measurement:disassemble",
            check="factorgraph_loc.sensors.camera.measurement:check_frame",
            intake="factorgraph_loc.sensors.camera.use:CameraIntake",
            section="camera",
        ),
        Channel(
            "sightings",
            tables=("factorgraph_loc.sensors.camera.measurement:SIGHTINGS",),
            check="factorgraph_loc.sensors.camera.measurement:check_sightings",
            section="camera",
        ),
    ),
    settings={"camera": Section("factorgraph_loc.sensors.camera.settings:CameraSettings")},
    detects="points",
    bind="factorgraph_loc.sensors.camera.sensor:bind",
    summarize="factorgraph_loc.sensors.camera.summary:summarize",
    check="factorgraph_loc.sensors.camera.use:check",
    review="factorgraph_loc.sensors.camera.use:review",
    draw="factorgraph_loc.sensors.camera.summary:draw",
    simulation={
        "pixels": Section("factorgraph_loc.sensors.camera.settings:PixelSettings", always=True),
    },
    simulate="factorgraph_loc.sensors.camera.simulation:simulate",
    looks="factorgraph_loc.sensors.camera.simulation:looks",
)
