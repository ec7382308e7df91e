"""Simulated phase and strength of reads."""

import numpy as np

from factorgraph_loc.sensors.rfid.settings import RfidSettings
from factorgraph_loc.sensors.rfid.simulation import Hits
from factorgraph_loc.sensors.rfid.simulation_settings import SimulatedPhaseSettings, SimulatedRssiSettings
from factors import se2
from factors.rfid import strength as rfid_rssi
from factors.rfid.detection import TagArray
from factors.rfid.phase import SPEED_OF_LIGHT
from factors.rfid.strength import RssiReads
from factors.se2 import Array


def strengths(
    rfid: RfidSettings,
    tags: TagArray,
    poses: Array,
    hits: Hits,
    settings: SimulatedRssiSettings,
    rng: np.random.Generator,
) -> Array:
    """RSSI [dBm] (N, A, T) of the reads ``hits`` (N, A, T) at poses (N, 3), NaN elsewhere: :mod:`factors.rfid.strength`."""
    n, a, tag = np.nonzero(hits)
    reads = RssiReads(poses[n], a, tag, np.full(len(n), np.nan))
    features = rfid_rssi.features(rfid.model().antennas, tags, np.zeros(3), reads)
    out = np.full(hits.shape, np.nan)
    out[hits] = features @ np.array(settings.coefficients) + settings.sigma * rng.standard_t(settings.dof, len(n))
    return out


def phases(
    rfid: RfidSettings, tags: TagArray, poses: Array, settings: SimulatedPhaseSettings, rng: np.random.Generator
) -> Array:
    """Phase (N, A, T) in [0, 2 pi) of a read of each tag by each antenna at poses (N, 3).

    ``offset - 4 pi f d / c`` (Nikitin et al., IEEE RFID 2010, eq. 4) with a random offset for each antenna and tag, noise, and an
    additional pi for a share of the reads.
    """
    at = np.array([(antenna.x, antenna.y, antenna.z) for antenna in rfid.all_antennas().values()])
    planar = se2.transform_from(poses[:, None], at[None, :, :2])[:, :, None] - tags.points[:, :2]
    height = at[:, None, 2] - tags.points[:, 2]
    distance = np.sqrt((planar**2).sum(axis=-1) + height**2)
    offset = rng.uniform(0.0, 2.0 * np.pi, distance.shape[1:])
    phase = offset - 4.0 * np.pi * settings.frequency / SPEED_OF_LIGHT * distance
    phase += settings.sigma * rng.standard_normal(phase.shape)
    phase += np.pi * (rng.random(phase.shape) < settings.flips)
    return np.asarray(np.mod(phase, 2.0 * np.pi))
