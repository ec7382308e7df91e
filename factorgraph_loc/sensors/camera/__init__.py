"""Cameras: image features and named points."""

from factorgraph_loc.model.sections import Section
from factorgraph_loc.sensors.registry import Channel, SensorType

__all__ = [
    "SENSOR",
    "bound",
    "columns",
    "draw",
    "frontend",
    "live",
    "map_frame",
    "markers",
    "measurement",
    "prepare",
    "sensor",
    "settings",
    "stream",
    "tables",
    "turn_check",
]

SENSOR = SensorType(
    "camera",
    channels=(
        Channel(
            "camera",
            streams=(
                "factorgraph_loc.sensors.camera.stream:ImageStream",
                "factorgraph_loc.sensors.camera.stream:FeatureStream",
            ),
            measurements=("factorgraph_loc.vision.frame:CameraFrame",),
            tables=("factorgraph_loc.sensors.camera.columns:CAMERA",),
            described=("factorgraph_loc.sensors.camera.columns:FEATURES",),
            assemble="factorgraph_loc.sensors.camera.tables:assemble",
            disassemble="factorgraph_loc.sensors.camera.tables:disassemble",
            check="factorgraph_loc.sensors.camera.pushed:check_frame",
            sequence="factorgraph_loc.sensors.camera.pushed:Widths",
            section="camera",
        ),
        Channel(
            "sightings",
            streams=("factorgraph_loc.sensors.camera.stream:SightingStream",),
            measurements=("factorgraph_loc.sensors.camera.measurement:PixelSightings",),
            tables=("factorgraph_loc.sensors.camera.columns:SIGHTINGS",),
            check="factorgraph_loc.sensors.camera.pushed:check_sightings",
            section="camera",
        ),
    ),
    settings={"camera": Section("factorgraph_loc.sensors.camera.settings:CameraSettings")},
    detects="points",
    undetected="no point of the map was found in an image",
    bind="factorgraph_loc.sensors.camera.bound:bind",
    summarize="factorgraph_loc.sensors.camera.summary:summarize",
    check="factorgraph_loc.sensors.camera.describe:check",
    review="factorgraph_loc.sensors.camera.describe:review",
    draw="factorgraph_loc.sensors.camera.draw:draw",
    simulation={
        "pixels": Section("factorgraph_loc.sensors.camera.simulation_settings:PixelSettings", always=True),
    },
    simulate="factorgraph_loc.sensors.camera.simulation:simulate",
    looks="factorgraph_loc.sensors.camera.simulation:looks",
    forecast="factorgraph_loc.sensors.camera.forecast:forecast",
)
