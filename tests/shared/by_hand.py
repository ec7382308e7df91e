"""What tests need to feed an estimator by hand: one for a rig and a map, a localizer that has begun, and reads of tags."""

import math

import numpy as np

from factorgraph_loc import Localizer, RfidScan, RfidStream
from factorgraph_loc.experiments.preparation import resolve_prior
from factorgraph_loc.fusion.registry import create, settings_of
from factorgraph_loc.model.setup import Setup


def made(name, rig, world, sensors, seed=0, **settings):
    """An estimator, as a run makes it."""
    return create(name, Setup(rig, world, sensors, np.random.default_rng(seed)), settings_of(name, settings))


def started(log, name="smoother", prior=None, **options):
    """A localizer at the start of a log."""
    localizer = Localizer(log.rig, log.world, name, **options)
    start, _ = resolve_prior(log, prior)
    if start is None:
        localizer.initialize()
    elif not start.has_heading:
        localizer.initialize((*start.pose[:2], math.nan), start.covariance[:2, :2], start.t)
    else:
        localizer.initialize(start.pose, start.covariance, start.t)
    return localizer


def scan(t, *tags, antennas=("ahead",), ages=0.0, rssi=np.nan, phase=np.nan, frequency=9.2e8):
    """A scan of which the first antenna read all ``tags``."""
    full, none = np.ones(len(tags)), np.zeros(len(tags), np.int64)
    return RfidScan(t, antennas, none, tags, ages * full, rssi * full, phase * full, frequency * full)


def reads(*rows):
    """Rows of (t, round, antenna, EPC, age); RSSI and the like unknown."""
    t, number, antenna, epc, age = zip(*rows, strict=True)
    nothing = np.full(len(t), np.nan)
    return RfidStream(
        np.array(t), np.array(number), list(antenna), list(epc), np.array(age, float), nothing, nothing, nothing
    )
