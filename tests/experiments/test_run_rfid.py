"""What a run makes of reads of tags: their sensors, and tags that are never read."""

from dataclasses import replace

import numpy as np
import pytest
from by_hand import reads

from factorgraph_loc import InputError, Tag
from factorgraph_loc.experiments.preparation import use_of
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.registry import settings_of
from factorgraph_loc.model.belief import Learnt
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.sensors.rfid.summary import doubts

ALL = ("odometry", "rfid", "rssi", "phase")


@pytest.fixture
def reading(log):
    """The short log with reads of tag a and of an unknown one; RSSI is known of the first read, phase of none."""
    stream = replace(reads((0.5, 0, "1", "a", 0.0), (1.0, 1, "1", "x", 0.0)), rssi=np.array((-60.0, np.nan)))
    world = log.world.model_copy(update={"tags": {name: Tag(x=1.0, y=1.0) for name in ("a", "b", "c")}})
    return replace(log, streams=dict(log.streams) | {"rfid": stream}, world=world)


def test_rssi_and_phase_are_sensors_of_the_reads(reading, fake):
    run(reading, RunConfig("fake", sensors=ALL[:3]))
    assert fake.made.setup.sensors == ALL[:3]
    assert sum(kind == "RfidScan" for kind, _ in fake.made.calls) == 2
    with pytest.raises(InputError, match="has no sensor 'phase': no row of rfid has a value of it"):
        run(reading, RunConfig("fake", sensors=ALL))
    stream = replace(reading.streams["rfid"], phase=np.array((np.nan, 0.5)))
    run(replace(reading, streams=dict(reading.streams) | {"rfid": stream}), RunConfig("fake", sensors=ALL))
    assert fake.made.setup.sensors == ALL


def test_what_the_rig_lists_and_the_reads_lack_is_left_out(reading, fake):
    rig = reading.rig.model_copy(update={"sensors": ALL})
    result = run(replace(reading, rig=rig), RunConfig("fake"))
    assert fake.made.setup.sensors == ALL[:3]
    assert [w.fields["sensor"] for w in result.warnings if w.kind == "no_stream"] == ["phase"]


def test_an_estimator_is_given_all_tags_whatever_the_log_reads_later(reading, fake):
    result = run(reading, RunConfig("fake", sensors=ALL[:2]))
    assert set(fake.made.setup.world.tags) == {"a", "b", "c"}
    assert not any("tags" in warning.fields for warning in result.warnings)


def test_tags_that_are_believed_dead_are_named(reading):
    found = Diagnostics(doubted={"dead_tags": {"b": 0.7, "c": 0.999}})
    use = use_of(reading, ALL, "smoother", settings_of("smoother", {}))
    (told,) = doubts(use, found, Learnt())
    assert str(told).startswith("straight: 2 of 3 tags of the map are believed dead")
    assert str(told).endswith("c (> 99 %), b (70 %)")
    assert list(doubts(use, Diagnostics(), Learnt())) == []


@pytest.mark.usefixtures("fake")
def test_no_tag_of_the_map_is_ever_read(reading):
    stream = replace(reading.streams["rfid"], epc=["", "x"])
    result = run(replace(reading, streams=dict(reading.streams) | {"rfid": stream}), RunConfig("fake", sensors=ALL[:2]))
    assert "straight: none of the 3 tags of the map is read" in map(str, result.warnings)
    unmapped = replace(reading, world=reading.world.model_copy(update={"tags": {}}))
    result = run(unmapped, RunConfig("fake", sensors=ALL[:2]))
    assert any(warning.kind == "no_map" for warning in result.warnings)
