"""Cameras: image features and named points."""

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
    "tables",
    "turn_check",
    "use",
]

SENSOR = SensorType(
    "camera",
    channels=(
        Channel(
            "camera",
            streams=(
                "factorgraph_loc.sensors.camera.measurement:ImageStream",
                "factorgraph_loc.sensors.camera.measurement:FeatureStream",
            ),
            measurements=("factorgraph_loc.vision.frame:CameraFrame",),
            tables=("factorgraph_loc.sensors.camera.tables:CAMERA",),
            described=("factorgraph_loc.sensors.camera.tables:FEATURES",),
            assemble="factorgraph_loc.sensors.camera.tables:assemble",
            disassemble="factorgraph_loc.sensors.camera.tables:disassemble",
            check="factorgraph_loc.sensors.camera.tables:check_frame",
            sequence="factorgraph_loc.sensors.camera.tables:Widths",
            section="camera",
        ),
        Channel(
            "sightings",
            streams=("factorgraph_loc.sensors.camera.measurement:SightingStream",),
            measurements=("factorgraph_loc.sensors.camera.measurement:PixelSightings",),
            tables=("factorgraph_loc.sensors.camera.tables:SIGHTINGS",),
            check="factorgraph_loc.sensors.camera.tables:check_sightings",
            section="camera",
        ),
    ),
    settings={"camera": Section("factorgraph_loc.sensors.camera.settings:CameraSettings")},
    detects="points",
    undetected="no point of the map was found in an image",
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
    forecast="factorgraph_loc.sensors.camera.simulation:forecast",
)
