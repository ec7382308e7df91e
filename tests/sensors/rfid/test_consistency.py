"""Reads against those that the detection models predict: status and events on the way, and groups along the final trajectory."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from changed_logs import with_rig

from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.rfid.monitor import ConsistencyMonitor
from factorgraph_loc.sensors.rfid.settings import BeamSettings, PriorSettings
from factorgraph_loc.simulation import preset, simulate
from factors.rfid.detection import ExpectedReads, TagReadCounts

ANTENNAS, TAGS, STEP = 4, 30, 0.5
DISTANCE = np.tile(np.linspace(0.2, 5.8, TAGS), (ANTENNAS, 1))
RIGHT = 1.0 / (1.0 + np.exp(2.0 * (DISTANCE - 4.0)))
ALL = np.ones(RIGHT.shape, dtype=bool)
KNOWN = PriorSettings(range_scale=0.0, read_rate=0.0)


def scans(monitor, seed, count, chance, *, p=RIGHT, begin=0.0, stays=0.0, together=1.0):
    """Whether a model that says ``p`` is doubted after each of some scans of tags that are read with a ``chance``. ``stays``: how
    often a tag does as in the scan before."""
    rng = np.random.default_rng(seed)
    hits, out = rng.random(chance.shape) < chance, []
    for i in range(count):
        hits = np.where(rng.random(chance.shape) < stays, hits, rng.random(chance.shape) < chance)
        looks = TagReadCounts(np.zeros((ANTENNAS, 3)), np.arange(ANTENNAS), np.ones(ANTENNAS, int), hits.astype(int))
        reads = ExpectedReads(looks.tags, looks.hits, p, DISTANCE)
        monitor.add(begin + STEP * i, looks, reads, ALL, together)
        out.append(monitor.doubted)
    return np.array(out)


def monitor():
    return ConsistencyMonitor([str(a) for a in range(ANTENNAS)])


@pytest.mark.parametrize("seed", range(3))
def test_a_right_model_is_not_doubted(seed):
    """Some 70 windows with two chances of 1e-5: one in 700 such runs would be doubted if a difference of 15 % were none."""
    assert not scans(monitor(), seed, 2000, RIGHT).any()


@pytest.mark.parametrize(("share", "named"), [(0.6, "0 to 1 m: 0.6"), (2.0, "4 to 5 m: ")])
def test_what_is_wrong_is_doubted_and_named_until_it_is_right_again(share, named):
    one = monitor()
    found = scans(one, 1, 60, np.minimum(share * RIGHT, 1.0))
    assert found[20:].all()
    assert named in one.shares
    later = scans(one, 2, 200, RIGHT, begin=30.0)
    assert not later[120:].any()


def test_reads_from_where_hardly_any_are_predicted():
    """Far tags are read that should not be, and so few of the others that no band and no antenna has 30 predicted reads."""
    few = 0.05 * RIGHT
    assert scans(monitor(), 6, 60, np.where(DISTANCE > 4.6, 0.1, few), p=few)[20:].all()


@pytest.mark.parametrize("seed", range(3))
def test_few_reads_of_a_right_model_are_not_doubted(seed):
    """At one of these rates one of 25 such runs was doubted, at three others none of 25 each."""
    assert not scans(monitor(), seed, 2000, 0.05 * RIGHT, p=0.05 * RIGHT).any()


def test_rounds_that_go_together_are_no_reason_for_doubt():
    """Of a chain that stays with 0.8, nine rounds tell as much as one."""
    p = np.full(RIGHT.shape, 0.1)
    assert not scans(monitor(), 3, 1000, p, p=p, stays=0.8, together=9.0).any()
    assert scans(monitor(), 3, 1000, p, p=p, stays=0.8).any()


def test_scans_that_come_again_count_once():
    one, again = monitor(), monitor()
    for m in (one, again):
        scans(m, 4, 40, 0.5 * RIGHT)
    scans(again, 5, 40, RIGHT)
    assert again.shares == one.shares


@cache
def office() -> Log:
    return simulate(preset("office", {"drive": {"duration": 60.0}}), 7)


def told(log: Log, **changes: float) -> Log:
    """The log with a rig that is sure of other antennas."""
    return with_rig(log, "rfid", models={"default": BeamSettings(prior=KNOWN, **changes)})


def test_antennas_that_are_not_as_the_rig_says_are_a_doubted_model_not_a_doubted_pose():
    for changes, right in (({}, True), ({"r_max": 5.4}, False)):
        result = run(told(office(), **changes), RunConfig("smoother"))
        late = result.t > 20.0
        doubts, status = np.array(result.doubts_model)[late], np.array(result.status)[late]
        events = [event for event in result.diagnostics.events if event.kind == "doubted_model"]
        if right:
            assert set(status) == {"localized"}
            assert not doubts.any()
            assert not events
        else:
            assert np.mean(doubts) > 0.9
            assert np.mean(status == "localized") > 0.5
            assert "m: 0." in events[0].fields["shares"]


def test_a_dead_antenna_is_named_and_ignored():
    """Its rounds go on without reads; the pose is that of a rig without this antenna, but for the first seconds."""
    log = office()
    stream = log.streams["rfid"]
    tags = ["" if antenna == "3" else tag for antenna, tag in zip(stream.antenna, stream.epc, strict=True)]
    silent = replace(stream, epc=tags)
    right, found = (run(one, RunConfig("ekf")) for one in (log, replace(log, streams={**log.streams, "rfid": silent})))
    (named,) = [event for event in found.diagnostics.events if event.kind == "dead_antenna"]
    assert named.fields == {"antenna": "3"}
    assert set(np.array(found.status)[found.t > 10.0]) == {"localized"}
    errors = [score(one, log)["causal.position_rmse"] for one in (right, found)]
    assert errors[1] < 1.3 * errors[0]


@cache
def long_office(share: float = 0.0) -> Log:
    faults = {"fading": {"duration": 5.0, "share": share}}
    return simulate(preset("office", {"drive": {"duration": 120.0}, "faults": faults}), 3)


def reliability(log: Log, **changes: float):
    """Reads observed over reads predicted along the final trajectory, and the warnings."""
    result = run(told(log, **changes), RunConfig("ekf"))
    return result.reliability["rfid"], [w for w in result.warnings if w.kind in ("detection_model", "bursts")]


def test_a_right_model_predicts_all_groups():
    """All groups within four standard deviations: one in a thousand logs would fail by chance."""
    found, warnings = reliability(long_office())
    assert not warnings
    assert found.overdispersion < 1.3
    assert np.all(np.abs(found.observed - found.predicted) < 4.0 * found.sigma)
    assert {"1 to 2 m", "4 to 5 m", "antenna 1", "antenna 8"} <= {*found.groups}


def test_a_range_that_is_too_long_shows_at_the_far_end():
    found, warnings = reliability(long_office(), r_max=5.4)
    share = dict(zip(found.groups, found.observed / found.predicted, strict=True))
    assert share["5 to 6 m"] < 0.6
    assert share["1 to 2 m"] == pytest.approx(1.0, abs=0.15)
    (line,) = warnings
    assert "at these distances and antennas: 5 to 6 m: 0." in str(line)


def test_a_rate_that_is_too_high_shows_everywhere():
    found, warnings = reliability(long_office(), p0=0.6)
    assert np.all(found.observed > 1.1 * found.predicted)
    assert any(w.kind == "detection_model" for w in warnings)


def test_bursts_are_counted_as_few():
    found, warnings = reliability(long_office(0.4), p0=0.6)
    assert found.overdispersion > 2.5
    assert any(w.kind == "bursts" for w in warnings)
    result = run(with_rig(long_office(0.4), "rfid", tempering=0.2), RunConfig("ekf"))
    assert not any(w.kind == "bursts" for w in result.warnings)
