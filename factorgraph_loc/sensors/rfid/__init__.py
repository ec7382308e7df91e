"""Reads of RFID tags, with their signal strength and phase."""

from factorgraph_loc.model.sections import Layer, Section
from factorgraph_loc.sensors.registry import Channel, SensorType

__all__ = [
    "SENSOR",
    "calibration",
    "known_tags",
    "map",
    "settings",
    "stream",
    "tables",
]

SENSOR = SensorType(
    "rfid",
    channels=(
        Channel(
            "rfid",
            tables=(
                "factorgraph_loc.sensors.rfid.stream:RFID",
                "factorgraph_loc.sensors.rfid.stream:INVENTORIES",
            ),
            described=("factorgraph_loc.sensors.rfid.stream:READS",),
            assemble="factorgraph_loc.sensors.rfid.tables:assemble",
            disassemble="factorgraph_loc.sensors.rfid.tables:disassemble",
            check="factorgraph_loc.sensors.rfid.stream:check",
            section="rfid",
        ),
        Channel("rssi"),
        Channel("phase"),
    ),
    settings={
        "rfid": Section("factorgraph_loc.sensors.rfid.settings:RfidSettings"),
        "survey": Section("factorgraph_loc.sensors.rfid.settings:SurveySettings", always=True),
    },
    layers={
        "tags": Layer(
            "factorgraph_loc.sensors.rfid.map:Tag",
            table="factorgraph_loc.sensors.rfid.map:TAGS",
            read="factorgraph_loc.sensors.rfid.map:read_layer",
            write="factorgraph_loc.sensors.rfid.map:write_layer",
            suffix=".tags.csv",
        ),
        "antennas": Layer("factorgraph_loc.sensors.rfid.settings:FixedAntenna"),
    },
    detects="tags",
    bind="factorgraph_loc.sensors.rfid.sensor:bind",
    summarize="factorgraph_loc.sensors.rfid.summary:summarize",
    review="factorgraph_loc.sensors.rfid.summary:review",
    check="factorgraph_loc.sensors.rfid.installation:check",
    draw="factorgraph_loc.sensors.rfid.installation:draw",
    simulation={
        "rssi": Section("factorgraph_loc.sensors.rfid.simulation:SimulatedRssiSettings"),
        "phase": Section("factorgraph_loc.sensors.rfid.simulation:SimulatedPhaseSettings"),
        "faults": Section("factorgraph_loc.sensors.rfid.simulation:FaultSettings", always=True),
    },
    simulate="factorgraph_loc.sensors.rfid.simulation:simulate",
    looks="factorgraph_loc.sensors.rfid.simulation:looks",
    on_robot="factorgraph_loc.sensors.rfid.simulation:on_robot",
    forecast="factorgraph_loc.sensors.rfid.forecast:forecast",
    calibrator="factorgraph_loc.sensors.rfid.calibration.calibrator:CALIBRATOR",
)
