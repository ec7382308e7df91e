"""Descriptions of what a run can do with RFID tags."""

import math
from collections.abc import Iterator, Mapping

from factorgraph_loc.model.belief import Learnt
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.sensors.interfaces import Ending, Review, Use
from factorgraph_loc.sensors.rfid.reliability import reliability
from factorgraph_loc.sensors.rfid.settings import RfidSettings
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factorgraph_loc.text import quoted
from factors.rfid.adjustment import MOST_CERTAIN, rate_of

SHOWN = 5  # names in a warning
CLEARLY = 3.0  # standard deviations
DIFFERENT = 0.1  # of a range or of a probability: less is nothing to warn of


def review(use: Use, ending: Ending) -> Review:
    """The warnings of a run, and the reliability of the detection models along its final trajectory."""
    reliable = reliability(use, ending.final_diagnostics, ending.learnt, ending.final)
    return Review(tuple(doubts(use, ending.diagnostics, ending.learnt)), reliable)


def doubts(use: Use, diagnostics: Diagnostics, learnt: Learnt) -> Iterator[str]:
    """That an estimator takes no tags, that no tag of a map is read, which are believed dead or moved at the end, the surest first,
    and how the antennas differ from the rig's models."""
    log, rounds = use.log, diagnostics.ignored.get("rfid", 0)
    if rounds and use.estimator != "dead_reckoning":  # obvious from its name
        yield f"{log.name}: {use.estimator} does not use RFID: all {rounds} inventory rounds are ignored"
    if "rfid" not in use.sensors:
        return
    stream, tags = log.streams.get("rfid"), log.world.tags
    if isinstance(stream, RfidStream) and not any(epc in tags for epc in stream.epc):
        what = f"none of the {len(tags)} tags of the map is read" if tags else "reads are of no use without a map"
        yield f"{log.name}: {what}"
        return
    for suspects, why in (
        (diagnostics.dead_tags, "are believed dead, as they were not read from where they should have been"),
        (
            diagnostics.moved_tags,
            "are believed to have moved, as they were read from elsewhere than they should have been",
        ),
    ):
        if suspects:
            yield f"{log.name}: {len(suspects)} of {len(tags)} tags of the map {why}: {suspected(suspects)}"
    settings = log.rig.find(RfidSettings)
    if settings is not None:
        yield from (f"{log.name}: {line}" for line in _differences(settings, learnt))


def suspected(tags: Mapping[str, float]) -> str:
    """Tags with their probabilities, the surest first."""
    found = sorted(tags.items(), key=lambda row: -row[1])
    names = ", ".join(f"{name} ({_percent(probability)})" for name, probability in found[:SHOWN])
    return names + (f" and {len(found) - SHOWN} more" if len(found) > SHOWN else "")


def _differences(settings: RfidSettings, learnt: Learnt) -> Iterator[str]:
    """What was learnt of the antennas' models and is clearly not what the rig says."""
    names = settings.parameter_names()
    for name, parameters in names.items():
        peak = min(settings.models[name].model().peak, MOST_CERTAIN)
        of = "the antennas" if len(names) == 1 else f"the antennas of model {quoted(name)}"
        ranges, rate = (learnt.values.get(f"rfid.{parameter}", (0.0, 0.0)) for parameter in parameters)
        factor = math.exp(ranges[0])
        if abs(ranges[0]) > CLEARLY * ranges[1] and abs(factor - 1.0) > DIFFERENT:
            more = f"{100.0 * abs(factor - 1.0):.0f} % {'farther' if factor > 1.0 else 'less far'}"
            yield f"{of} reach {more} than the rig says"
        found = peak * rate_of(peak, rate[0])
        if abs(rate[0]) > CLEARLY * rate[1] and abs(found - peak) > DIFFERENT:
            yield f"{of} read {100.0 * found:.0f} % of the tags next to them, where the rig says {100.0 * peak:.0f} %"


def _percent(probability: float) -> str:
    return "> 99 %" if probability > 0.99 else f"{100.0 * probability:.0f} %"
