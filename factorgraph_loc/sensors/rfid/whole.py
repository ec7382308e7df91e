"""The scans of a whole log."""

from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.rfid.measurement import RfidScan


def whole_scans(log: Log) -> list[RfidScan]:
    """All RFID scans in order of arrival; empty without a reader."""
    return [m for m in log.measurements(("rfid",)) if isinstance(m, RfidScan)]
