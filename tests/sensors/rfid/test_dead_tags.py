"""Dead tags, as a robot can know of them: by the way it goes, not by the whole log."""

from functools import cache

import numpy as np
import pytest
from by_hand import scan

import factorgraph_loc as fgloc
from factorgraph_loc import Log, Rig, Tag, VelocityOdometry, World
from factorgraph_loc.sensors.rfid.settings import AntennaSettings, RfidSettings
from factorgraph_loc.simulation import preset, simulate

SENSORS = ("odometry", "rfid")


@cache
def office(seed: int = 2) -> tuple[Log, frozenset[str]]:
    """A minute with 30 % of the tags dead, and which these are."""
    log = simulate(preset("office", {"drive": {"duration": 60.0}, "faults": {"dead": 0.3}}), seed)
    return log, frozenset(log.metadata["dead"].split(", "))


def robot(estimator: str, **settings: float) -> fgloc.Localizer:
    """A robot that stands 1 m before a tag."""
    rfid = RfidSettings(antennas={"ahead": AntennaSettings()}, dead_tags=0.03)
    world = World(tags={"ahead": Tag(x=1.0, y=0.0), "aside": Tag(x=2.0, y=1.0), "far": Tag(x=30.0, y=0.0)})
    out = fgloc.Localizer(Rig(rfid=rfid), world, estimator, sensors=SENSORS, settings=settings)
    out.initialize((0.0, 0.0, 0.0), np.diag((0.02, 0.02, 0.02)) ** 2, 0.0)
    out.push(VelocityOdometry(0.0, 0.0, 0.0))
    return out


@pytest.mark.parametrize("estimator", ["smoother", "particle_filter", "switching"])
def test_a_tag_is_given_up_and_taken_back(estimator: str) -> None:
    live = robot(estimator)
    for i in range(1, 14):
        live.push(scan(0.1 * i, "aside"))
    # 13 silences of 0.1 each, from odds of 3 to 97; a weak tag, or one that has moved, may be silent as well
    assert live.diagnostics().doubted["dead_tags"].keys() == {"ahead"}
    assert live.diagnostics().doubted["dead_tags"]["ahead"] > 0.9
    live.push(scan(1.4, "aside", "ahead"))
    assert not live.diagnostics().doubted["dead_tags"]


@pytest.mark.parametrize("estimator", ["smoother", "particle_filter"])
def test_a_tag_that_comes_back_is_no_reason_to_doubt_the_place(estimator: str) -> None:
    live = robot(estimator)
    for i in range(1, 40):
        live.push(VelocityOdometry(0.1 * i, 0.0, 0.0))
        live.push(scan(0.1 * i, "aside"))
    assert live.diagnostics().doubted["dead_tags"].keys() == {"ahead"}
    for i in range(40, 50):
        live.push(VelocityOdometry(0.1 * i, 0.0, 0.0))
        live.push(scan(0.1 * i, "aside", "ahead"))
        assert live.estimate().status == "localized"


@pytest.mark.parametrize("estimator", ["smoother", "particle_filter"])
def test_a_late_scan_counts_once(estimator: str) -> None:
    """Each second scan comes after the one that follows it: what is known of the tags is the same, as the robot stands."""
    in_time, late = robot(estimator), robot(estimator)
    stamps = [0.05 * k for k in range(1, 7)]
    for t in stamps:
        in_time.push(scan(t, "aside"))
    for k in (1, 0, 3, 2, 5, 4):
        late.push(scan(stamps[k], "aside"))
    expected = in_time.diagnostics().doubted["dead_tags"]["ahead"]
    assert late.diagnostics().doubted["dead_tags"]["ahead"] == pytest.approx(expected, abs=0.02)
    assert not late.diagnostics().late
