"""Short logs of every sensor, of an office and of a room, and a recorded one of ranges."""

from dataclasses import replace
from functools import cache

import numpy as np
from camera_world import simulate as simulate_room
from camera_world import with_frames
from changed_logs import rows, with_rig

from factorgraph_loc import YawRateStream, load
from factorgraph_loc.model.log import cut
from factorgraph_loc.sensors.odometry.settings import ImuSettings
from factorgraph_loc.sensors.rfid.settings import PhaseSettings, RfidUncertainty, RssiSettings
from factorgraph_loc.simulation import preset
from factorgraph_loc.simulation import simulate as simulate_office


@cache
def plaza():
    (log,) = load("plaza2")
    start = log.span()[0]
    part = cut(log, start, start + 24.0)
    return replace(part, start=log.start)


@cache
def office():
    """Reads with strength and phase; some tags are first read in the second half, others never."""
    world = {"tags": 12, "landmarks": 20}
    changes = {"drive": {"duration": 14.0}, "phase": {}, "rssi": {}, "world": world}
    return with_signals(simulate_office(preset("office", changes), 3))


# of the reader that the simulation draws
SIGNALS = {
    "rssi": RssiSettings(coefficients=(-50.0, 2.0, -8.0, 0.0, 2.0, 0.0), sigma=2.0, dof=4.0, tempering=0.3),
    "phase": PhaseSettings(tempering=0.5, max_range=4.0),
}


def with_signals(log):
    """The log of a rig that knows how strength and phase were simulated."""
    return with_reader(log, **SIGNALS)


def mounted_exactly(log):
    """The log with a rig that says that mounting and clock of the RFID reader are known exactly."""
    exact = RfidUncertainty(yaw=0.0, antenna_yaw=0.0, time_offset=0.0)
    return log if log.rig.rfid is None else with_reader(log, uncertainty=exact)


def with_reader(log, **changes):
    """The log with a rig of which the section of the RFID reader is another one."""
    return with_rig(log, "rfid", **changes)


def late(log, sensor):
    """The log, in which each other measurement of a sensor arrives after the one that follows it."""
    stream = log.streams[sensor]
    looks = np.unique(stream.t, return_inverse=True)[1]
    order = np.lexsort((np.arange(len(looks)), looks ^ 1))
    return rows(log, sensor, order)


def with_gyro(log):
    """The log of increments of odometry, with a gyro."""
    wheels = log.streams["odometry"]
    t = np.arange(0.0, wheels.t[-1], 0.05)
    rate = np.interp(t, wheels.t[1:], wheels.dtheta[1:] / np.diff(wheels.t)) + 0.01
    rig = log.rig.model_copy(update={"imu": ImuSettings()})
    return replace(log, rig=rig, streams=log.streams | {"imu": YawRateStream(t, rate)})


@cache
def room():
    return simulate_room(seconds=8.0)


@cache
def frames():
    return with_frames(room(), clutter=30)
