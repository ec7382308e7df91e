"""Descriptions of what a run can do with RFID tags."""

from collections.abc import Iterator, Sequence

from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factorgraph_loc.sensors.usage import Use

SHOWN = 5  # names in a warning


def findable(log: Log, sensors: Sequence[str]) -> tuple[str, str] | None:
    """The kind of map elements that ``sensors`` could detect, and the message if none were detected."""
    return ("tags", "no tag of the map was read") if log.world.tags and "rfid" in sensors else None


def mappable(log: Log) -> str | None:
    """The map layer that can be made from a log's reads, or None."""
    return "tags" if "rfid" in log.streams else None


def doubts(use: Use, diagnostics: Diagnostics) -> Iterator[str]:
    """Warnings that an estimator does not use RFID, that no tag is read, or that tags are believed dead."""
    log, rounds = use.log, diagnostics.ignored.get("rfid", 0)
    if rounds and use.estimator != "dead_reckoning":  # obvious from its name
        yield f"{log.name}: {use.estimator} does not use RFID: all {rounds} inventory rounds are ignored"
    if "rfid" not in use.sensors:
        return
    stream, tags = log.streams.get("rfid"), log.world.tags
    if isinstance(stream, RfidStream) and tags and not any(epc in tags for epc in stream.epc):
        yield f"{log.name}: none of the {len(tags)} tags of the map is read"
        return
    found = sorted(diagnostics.dead_tags.items(), key=lambda row: -row[1])
    if found:
        names = ", ".join(f"{name} ({_percent(dead)})" for name, dead in found[:SHOWN])
        more = f" and {len(found) - SHOWN} more" if len(found) > SHOWN else ""
        yield (
            f"{log.name}: {len(found)} of {len(tags)} tags of the map are believed dead, as they were not read from where "
            f"they should have been: {names}{more}"
        )


def _percent(probability: float) -> str:
    return "> 99 %" if probability > 0.99 else f"{100.0 * probability:.0f} %"
