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
            needs_section=True,
        ),
        Channel(
            "sightings",
            streams=("factorgraph_loc.sensors.camera.stream:SightingStream",),
            measurements=("factorgraph_loc.sensors.camera.measurement:PixelSightings",),
            tables=("factorgraph_loc.sensors.camera.columns:SIGHTINGS",),
            check="factorgraph_loc.sensors.camera.pushed:check_sightings",
            section="camera",
            needs_section=True,
        ),
    ),
    settings={"camera": Section("factorgraph_loc.sensors.camera.settings:CameraSettings")},
    bind="factorgraph_loc.sensors.camera.bound:bind",
    frame_error="factorgraph_loc.sensors.camera.describe:frame_error",
    summarize="factorgraph_loc.sensors.camera.summary:summarize",
    prepare="factorgraph_loc.sensors.camera.prepare:prepare",
    doubts="factorgraph_loc.sensors.camera.describe:doubts",
    unmapped="factorgraph_loc.sensors.camera.describe:unmapped",
    findable="factorgraph_loc.sensors.camera.describe:findable",
    mappable="factorgraph_loc.sensors.camera.describe:mappable",
    draw="factorgraph_loc.sensors.camera.draw:draw",
    simulation={
        "pixels": Section("factorgraph_loc.sensors.camera.simulation_settings:PixelSettings", always=True),
    },
    simulate="factorgraph_loc.sensors.camera.simulation:simulate",
    looks="factorgraph_loc.sensors.camera.simulation:looks",
    forecast="factorgraph_loc.sensors.camera.forecast:forecast",
)
