"""Survey and lever arm from phases; RSSI: what was put into simulated reads is found again."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from factorgraph_loc import InputError, Log, RfidStream, Rig, Tag, Trajectory, World
from factorgraph_loc.sensors.rfid.calibration.signals import PhaseFit, fit_phase, fit_rssi
from factorgraph_loc.sensors.rfid.known_tags import tag_map
from factorgraph_loc.sensors.rfid.settings import (
    AntennaSettings,
    PhaseSettings,
    RfidSettings,
    RssiSettings,
    SurveySettings,
)
from factors import se2
from factors.rfid.signals import SPEED_OF_LIGHT, RssiReads, features
from factors.se2 import Array

SETTINGS = RfidSettings(
    antennas={"low": AntennaSettings(y=-0.2, z=0.5, yaw=-1.57), "high": AntennaSettings(y=-0.2, z=1.2, yaw=-1.57)}
)
SURVEY = SurveySettings(x=0.08, y=-0.12, heading=0.025)
LEVER_ARM = (0.05, 0.06)
RSSI = RssiSettings(coefficients=(-50.0, 2.0, -5.0, -1.0, 2.0, 1.5), sigma=2.0, dof=6.0)
FREQUENCY = 920.625e6
READS = 12_000
DURATION = 120.0  # s


def path(t: Array) -> Array:
    """Up and down between two rows of tags, in arcs, at about 0.25 m/s."""
    u = 2.0 * math.pi * t / 60.0
    x, y = 2.0 * np.cos(u), 0.5 * np.sin(u)
    return np.column_stack((x, y, np.arctan2(0.5 * np.cos(u), -2.0 * np.sin(u))))


def simulated(seed: int) -> Log:
    """A log with RSSI and phases good to 0.3 rad; the antennas sit ``LEVER_ARM`` off, the tags by the survey's errors."""
    rng = np.random.default_rng(seed)
    tags = {
        f"{row}{i}": Tag(x=-2.5 + 0.25 * i, y=y, z=z, facing=-math.copysign(math.pi / 2.0, y))
        for row, (y, z) in enumerate(((1.2, 0.4), (-1.2, 0.8), (1.2, 1.4), (-1.2, 1.0)))
        for i in range(21)
    }
    world = World(tags=tags)
    true = tag_map(world, SURVEY.model_copy(update={"about_x": 0.0, "about_y": 0.0}))
    t = np.sort(rng.uniform(0.0, DURATION, READS))
    poses = path(t)
    antenna = rng.integers(0, 2, READS)
    mounting = np.array([(a.x + LEVER_ARM[0], a.y + LEVER_ARM[1], a.z) for a in SETTINGS.antennas.values()])
    places = np.column_stack((se2.transform_from(poses, mounting[antenna, :2]), mounting[antenna, 2]))
    distances = np.linalg.norm(places[:, None] - true.tags.points, axis=2)
    # any of the tags within 1.5 m
    tag = np.argmax(np.where(distances < 1.5, rng.random(distances.shape), -1.0), axis=1)
    distance = distances[np.arange(READS), tag]
    offsets = rng.uniform(0.0, 2.0 * np.pi, (2, len(tags)))[antenna, tag]
    phase = offsets - 4.0 * np.pi * FREQUENCY / SPEED_OF_LIGHT * distance + np.pi * (rng.random(READS) < 0.2)
    antennas = tuple(replace(a, x=a.x + LEVER_ARM[0], y=a.y + LEVER_ARM[1]) for a in SETTINGS.model().antennas)
    reads = RssiReads(poses, antenna, tag, np.zeros(READS))
    rssi = features(antennas, true.tags, np.zeros(3), reads) @ np.array(RSSI.coefficients)
    stamps = np.arange(0.0, DURATION + 0.1, 0.05)
    stream = RfidStream(
        t=t,
        round=np.arange(READS),
        antenna=[tuple(SETTINGS.antennas)[a] for a in antenna],
        epc=[true.names[i] for i in tag],
        age=np.zeros(READS),
        rssi=rssi + RSSI.sigma * rng.standard_t(RSSI.dof, READS),
        phase=np.mod(phase + rng.normal(0.0, 0.3, READS), 2.0 * np.pi),
        frequency=np.full(READS, FREQUENCY),
    )
    return Log("simulated", Rig(rfid=SETTINGS), world, {"rfid": stream}, Trajectory(stamps, path(stamps)))


def without_signals(log: Log) -> Log:
    """The same reads, without phase and RSSI."""
    stream = log.streams["rfid"]
    assert isinstance(stream, RfidStream)
    unknown = np.full(READS, np.nan)
    return replace(log, streams={"rfid": replace(stream, phase=unknown, rssi=unknown)})


@pytest.fixture(scope="module")
def log() -> Log:
    return simulated(0)


@pytest.fixture(scope="module")
def fit(log: Log) -> PhaseFit:
    return fit_phase([log], SETTINGS)


def test_survey_and_lever_arm_are_found(fit: PhaseFit) -> None:
    """Five standard deviations and 2 mm for the bends of the reference: false alarms below 1e-4, as the jackknife's spread is
    itself known to a quarter."""
    point = np.array((fit.survey.about_x, fit.survey.about_y))
    shift = se2.transform_from(SURVEY.transform(), point) - point
    found = (fit.survey.x, fit.survey.y, fit.survey.heading, *fit.lever_arm)
    error = np.abs(np.array(found) - (*shift, SURVEY.heading, *LEVER_ARM))
    assert np.all(fit.sigmas[[0, 1, 3, 4]] < 0.01)
    assert fit.sigmas[2] < 0.005
    assert np.all(error < 5.0 * fit.sigmas + 0.002)
    assert fit.agreement > fit.initial_agreement + 0.02


def test_nothing_is_found_where_nothing_is_wrong(log: Log) -> None:
    rfid = SETTINGS.model_copy(
        update={
            "antennas": {
                name: a.model_copy(update={"x": a.x + LEVER_ARM[0], "y": a.y + LEVER_ARM[1]})
                for name, a in SETTINGS.antennas.items()
            }
        }
    )
    fit = fit_phase([log], rfid, SURVEY)
    assert np.all(np.abs(fit.lever_arm) < 5.0 * fit.sigmas[3:] + 0.002)
    assert fit.agreement - fit.initial_agreement < 0.002


def test_without_reference_or_reads_it_says_what_is_missing(log: Log) -> None:
    with pytest.raises(InputError, match="no reference"):
        fit_phase([replace(log, reference=None)], SETTINGS)
    with pytest.raises(InputError, match="no RFID reads"):
        fit_phase([replace(log, streams={})], SETTINGS)
    with pytest.raises(InputError, match="0 reads have a phase"):
        fit_phase([without_signals(log)], SETTINGS)
    with pytest.raises(InputError, match="0 reads have an RSSI"):
        fit_rssi([without_signals(log)], SETTINGS, SURVEY)


def test_settings_make_models_of_one_window() -> None:
    antennas = SETTINGS.model().antennas
    model = PhaseSettings(tempering=0.06, window=3.0, step=1.0).model(antennas)
    assert model.tempering == pytest.approx(0.02)
    assert model.antennas == antennas
    with pytest.raises(ValueError, match="leaves gaps"):
        PhaseSettings(window=1.0, step=2.0)
    assert RSSI.model(antennas).coefficients == RSSI.coefficients


def test_logs_are_focused_together(log: Log, fit: PhaseFit) -> None:
    """The same log twice says the same, to the accuracy of the search: windows of different logs are never mixed."""
    twice = fit_phase([log, without_signals(log), log], SETTINGS)
    assert twice.reads == 2 * fit.reads
    assert twice.agreement == pytest.approx(fit.agreement, abs=1e-5)


def test_rssi_is_found() -> None:
    """The mean strength of other reads is known to 8 % of the noise, which is worth 0.003 a read."""
    antennas = {
        name: a.model_copy(update={"x": a.x + LEVER_ARM[0], "y": a.y + LEVER_ARM[1]})
        for name, a in SETTINGS.antennas.items()
    }
    rfid = SETTINGS.model_copy(update={"antennas": antennas})
    fit = fit_rssi([simulated(1)], rfid, SURVEY)
    assert fit.sigma == pytest.approx(RSSI.sigma, rel=0.05)
    d, w, c = np.random.default_rng(0).uniform((0.5, 0.0, -0.9), (2.0, 0.6, 0.9), (200, 3)).T
    table = np.column_stack((np.ones(200), -10.0 * np.log10(d), w, w**2, c, c**2))
    error = table @ np.subtract(fit.coefficients, RSSI.coefficients)
    assert np.sqrt(np.mean(error**2)) < 0.08 * RSSI.sigma
