"""Readers of RFID tags: detection, strength and phase."""

from factorgraph_loc.model.sections import Layer, Section
from factorgraph_loc.sensors.registry import Channel, SensorType

SENSOR = SensorType(
    "rfid",
    channels=(
        Channel(
            "rfid",
            streams=("factorgraph_loc.sensors.rfid.stream:RfidStream",),
            measurements=("factorgraph_loc.sensors.rfid.measurement:RfidScan",),
            section="rfid",
        ),
        Channel("rssi"),
        Channel("phase"),
    ),
    settings={
        "rfid": Section("factorgraph_loc.sensors.rfid.settings:RfidSettings"),
        "survey": Section("factorgraph_loc.sensors.rfid.settings:SurveySettings", always=True),
    },
    layers={"tags": Layer("factorgraph_loc.sensors.rfid.map:Tag")},
    summarize="factorgraph_loc.sensors.rfid.summary:summarize",
)
