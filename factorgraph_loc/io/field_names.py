"""Common names of the fields of messages and tables, and the units that names end in."""

import re
from collections.abc import Sequence

TRUTH = re.compile(
    r"truth|(^|[/_.])gt($|[/_.])|reference|mocap|vicon|optitrack|qualisys|total_station|leica", re.IGNORECASE
)
# of the last part of a field's path, without separators and without a unit at the end
READ: dict[str, tuple[str, ...]] = {
    "epc": ("epc", "epchex", "tagepc", "tagid", "epcid", "uid", "tag", "serial", "tagserial"),
    "antenna": ("antenna", "antennaid", "antennaport", "antennaname", "ant", "port", "portnumber", "readerport"),
    "rssi": ("rssi", "peakrssi", "signalstrength", "power"),
    "phase": ("phase", "phaseangle", "rfphase", "rfphaseangle"),
    "frequency": ("frequency", "freq", "carrier", "channelfrequency", "channelmhz", "channelkhz"),
    "stamp": ("firstseen", "firstseentimestamp", "firstseentimestamputc", "readtime", "timestamp"),
}
# of a range to a radio or another landmark, the likeliest first
LANDMARK = ("anchorid", "anchor", "anchorname", "responderid", "beaconid", "beacon", "landmarkid", "nodeid", "id")
RANGE = ("range", "distance", "dist", "dis", "rangem", "distancem")
UNIT = re.compile(r"(deg(rees)?|rad(ians)?|[mk]?hz|[mun]s|dbm)$")


def plain(name: str) -> str:
    """A name in lower case, without separators."""
    return re.sub(r"[\s_\-.]", "", name).lower()


def rank(name: str, known: Sequence[str]) -> int | None:
    """The index of a plain name in ``known``, with its unit or without; None if it is unknown."""
    return next((known.index(text) for text in (name, UNIT.sub("", name)) if text in known), None)
