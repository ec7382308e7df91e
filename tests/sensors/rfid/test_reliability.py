"""Reads observed over reads predicted, along the final trajectory."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from changed_logs import with_rig

from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.rfid.settings import BeamSettings, PriorSettings, RfidSettings
from factorgraph_loc.simulation import preset, simulate

KNOWN = PriorSettings(range_scale=0.0, read_rate=0.0)


@cache
def office(share: float = 0.0) -> Log:
    faults = {"fading": {"duration": 5.0, "share": share}}
    return simulate(preset("office", {"drive": {"duration": 120.0}, "faults": faults}), 3)


def told(log: Log, **changes: float):
    """The reliability of a run whose rig has other parameters of its beam, which it is sure of, and the run's warnings."""
    result = run(with_rig(log, "rfid", models={"default": BeamSettings(prior=KNOWN, **changes)}), RunConfig("ekf"))
    return result.reliability["rfid"], [line for line in result.warnings if "reads" in line]


def test_a_right_model_is_not_doubted():
    """All groups within four standard deviations: one in a thousand logs would fail by chance."""
    found, warnings = told(office())
    assert not warnings
    assert found.overdispersion < 1.3
    assert np.all(np.abs(found.observed - found.predicted) < 4.0 * found.sigma)
    assert {"1 to 2 m", "4 to 5 m", "antenna 1", "antenna 8"} <= {*found.groups}


def test_a_range_that_is_too_long_shows_at_the_far_end():
    found, warnings = told(office(), r_max=5.4)
    share = dict(zip(found.groups, found.observed / found.predicted, strict=True))
    assert share["5 to 6 m"] < 0.6
    assert share["1 to 2 m"] == pytest.approx(1.0, abs=0.15)
    (line,) = warnings
    assert "by distance and antenna: 5 to 6 m: 0." in line


def test_a_rate_that_is_too_high_shows_everywhere():
    found, warnings = told(office(), p0=0.6)
    assert np.all(found.observed > 1.1 * found.predicted)
    assert any("over those that the detection models predict" in line for line in warnings)


def test_bursts_are_counted_as_few():
    found, warnings = told(office(0.4), p0=0.6)
    assert found.overdispersion > 2.5
    assert any("come in bursts" in line for line in warnings)
    tempered = office(0.4).rig.of(RfidSettings).model_copy(update={"tempering": 0.2})
    log = replace(office(0.4), rig=office(0.4).rig.model_copy(update={"rfid": tempered}))
    result = run(log, RunConfig("ekf"))
    assert not any("come in bursts" in line for line in result.warnings)
