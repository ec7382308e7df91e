"""Strength and phase of reads: windows of phases, going back in time, rigs that lack what a sensor needs."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from by_hand import scan as scan_by_hand

from factorgraph_loc import InputError, Rig, Tag, World
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.settings import NOTHING
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.sensors.base import Binding
from factorgraph_loc.sensors.motion import Motion
from factorgraph_loc.sensors.rfid.known_tags import KnownTags, TagSignals
from factorgraph_loc.sensors.rfid.sensor import TagSensor
from factorgraph_loc.sensors.rfid.settings import AntennaSettings, PhaseSettings, RfidSettings, RssiSettings
from factorgraph_loc.simulation import preset, simulate
from factors import se2
from factors.rfid.signals import PhaseLikelihood

SENSORS = ("odometry", "rfid", "rssi", "phase")
STRENGTH = RssiSettings(coefficients=(-50.0, 2.0, -8.0, 0.0, 2.0, 0.0), sigma=2.0, dof=4.0)
WORLD = World(tags={"a": Tag(x=1.0, y=0.0), "far": Tag(x=9.0, y=0.0)})


def signals(sensors=SENSORS):
    rfid = RfidSettings(antennas={"ahead": AntennaSettings()}, rssi=STRENGTH, phase=PhaseSettings(window=2.0, step=1.0))
    setup = Setup(Rig(rfid=rfid), WORLD, sensors, np.random.default_rng(1))
    return TagSignals(setup, KnownTags(setup, Diagnostics()))


def scan(t, *reads, rssi=-50.0, phase=1.0):
    return scan_by_hand(t, *reads, ages=np.linspace(0.0, 0.05, len(reads)), rssi=rssi, phase=phase)


def test_windows_end_a_step_apart_and_are_as_long_as_the_rig_says():
    kept = signals()
    times = 0.25 * np.arange(24)
    ends = [t for t in times if kept.keep(scan(t, "a"))]
    assert ends == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    np.testing.assert_allclose(kept.times(), 3.75 + 0.25 * np.arange(9))


def test_reads_are_of_their_own_time():
    kept = signals()
    assert kept.keep(scan(3.0, "a", "a"))
    np.testing.assert_allclose(kept.times(), (3.0, 2.95))


def test_going_back_leaves_no_trace():
    kept, straight = signals(), signals()
    for i in range(30):
        kept.keep(scan(0.1 * i, "a"))
    kept.forget(2.45)
    for i in range(25):
        straight.keep(scan(0.1 * i, "a"))
    for i in range(25, 45):
        m = scan(0.1 * i, "a")
        assert kept.keep(m) == straight.keep(m)
        np.testing.assert_array_equal(kept.times(), straight.times())


def test_a_window_is_a_factor_of_the_reads_that_are_near():
    kept = signals()
    for i in range(6):
        kept.keep(scan(0.2 * i, "a", "far", "unknown"))
    offsets = np.zeros((len(kept.times()), 3))
    window = kept.phases(offsets, np.zeros(3))
    assert window is not None
    assert isinstance(window.likelihood, PhaseLikelihood)
    assert len(window.reads.phase) == 6
    assert kept.phases(offsets, np.array((5.0, 5.0, 0.0))) is None


def test_reads_without_phase_or_strength_tell_none():
    kept = signals()
    assert not kept.keep(scan(0.0, "a", phase=np.nan))
    assert kept.strengths(scan(0.0, "a", rssi=np.nan)) is None
    reads = kept.strengths(scan(0.0, "a", "unknown"))
    assert reads is not None
    assert len(reads.rssi) == 1


def test_sensors_that_are_not_asked_for_tell_nothing():
    kept = signals(("odometry", "rfid"))
    assert not kept.keep(scan(0.0, "a"))
    assert kept.strengths(scan(0.0, "a")) is None


def test_strengths_place_the_robot_but_are_no_evidence():
    """Other places are judged by what was read and not read: what the track is judged by must be the same."""
    rfid = RfidSettings(antennas={"ahead": AntennaSettings()}, rssi=STRENGTH)
    pose, covariance = np.zeros(3), np.diag((0.3, 0.3, 0.2)) ** 2
    view = SimpleNamespace(t=0.5, offset=None, newest=True, localized=False, pose=pose, covariance=covariance)
    found = {}
    for sensors in (SENSORS[:2], SENSORS[:3]):
        setup = Setup(Rig(rfid=rfid), WORLD, sensors, np.random.default_rng(1))
        binding = Binding(setup, Motion(setup.rig, sensors, Diagnostics()), Diagnostics())
        found[len(sensors)] = list(TagSensor(binding, NOTHING).observe(scan(0.5, "a", rssi=-45.0), view))
    (alone,), (detection, strength) = found.values()
    without, first = (one.correct(pose, covariance, {}, {}) for one in (alone, detection))
    assert first.evidence == pytest.approx(without.evidence)
    assert first.excess_nll == pytest.approx(without.excess_nll)
    assert detection.is_judged
    assert not strength.is_judged
    assert strength.at_its_time() is None
    # twice as strong as from where the robot was thought to be: nearer to the tag
    placed = se2.compose(pose, first.delta)
    assert strength.correct(placed, first.covariance, {}, {}).delta[0] > 1e-3


@pytest.mark.parametrize("estimator", ["smoother", "particle_filter"])
@pytest.mark.parametrize("sensor", ["rssi", "phase"])
@pytest.mark.parametrize("without", ["signals", "rfid"])
def test_a_rig_without_what_the_sensor_needs(estimator, sensor, without):
    log = simulate(preset("office", {"drive": {"duration": 5.0}, "rssi": {}, "phase": {}}), 1)
    if without == "rfid":
        log = replace(log, rig=log.rig.model_copy(update={"rfid": None}))
    with pytest.raises(
        InputError, match=rf"^the rig has no \[rfid\.{sensor}\]: add it, or do not use the sensor {sensor}$"
    ):
        run(log, RunConfig(estimator, sensors=("odometry", "rfid", sensor)))
