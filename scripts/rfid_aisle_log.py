"""Reader of the rfid-aisle recordings: a robot with three UHF RFID antennas between shelves.

The recordings are a folder with ``tags.csv`` and a folder for each run. A run has reads and reference poses. It has no odometry,
which is simulated by :func:`~factorgraph_loc.sensors.odometry.simulation.wheel_odometry`.
"""

from pathlib import Path

import numpy as np

from factorgraph_loc.files import checks
from factorgraph_loc.files.shipped import rigs
from factorgraph_loc.io.native.rig_file import read_rig
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.odometry import simulation as simulated_odometry
from factorgraph_loc.sensors.odometry.simulation import wheel_odometry
from factorgraph_loc.sensors.rfid.map import TagsFile, read_tags
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factorgraph_loc.sensors.rfid.tables import ROUND_GAP, ReadsByRound, ends_of, rounds_from_gaps
from factorgraph_loc.text import Notice, notice
from factors import se2

ANTENNAS = ("first", "second", "third")
EPC, CARRIER, PHASE, RSSI, HOST_CLOCK = 1, 3, 4, 5, 7  # columns of a file of reads; units: none, MHz, degrees, dBm, us
THINNING = 4  # every fourth pose of the reference, which has 200 Hz, is stored
TAGS = TagsFile(
    file="tags.csv",
    columns={"epc": "epc", "x": "x_m", "y": "y_m", "z": "z_m", "facing": "facing_deg"},
    units={"facing": "deg"},
)
ABOUT = {
    "title": "A robot with three UHF RFID antennas between shelves with 60 tags; wheel odometry is simulated",
    "licence": "none stated: internal use",
    "origin": "a robot with three UHF RFID antennas in an aisle of shelves, recorded 2023",
}


def read_rfid_aisle(folder: Path, run: int, odometry_seed: int = 0) -> Log:
    """Read a run of the recordings in ``folder``. The time 0 is that of the first pose of the reference."""
    files = folder / f"run{run}"
    reference, t0_ns = read_reference(files / "reference_pose.txt")
    odometry = wheel_odometry(reference, odometry_seed)
    reads, warnings = read_reads(files, t0_ns, float(odometry.t[-1]))
    return Log(
        name=f"rfid-aisle-run{run}",
        rig=read_rig(rigs()["rfid-aisle"]),
        world=World(name=folder.resolve().name, tags=read_tags(folder / TAGS.file, TAGS)),
        streams={"odometry": odometry, "rfid": reads},
        reference=Trajectory(reference.t[::THINNING], reference.poses[::THINNING]),
        t0_ns=t0_ns,
        warnings=warnings,
        metadata={**ABOUT, "odometry": f"{simulated_odometry.DESCRIPTION}; seed {odometry_seed}"},
    )


def read_reference(path: Path) -> tuple[Trajectory, int]:
    """Read the reference. Returns its poses, with times in seconds after the first pose, and the stamp of the first pose [ns]."""
    x, y, heading, t = np.loadtxt(path).T
    t_ns = np.rint(t * 1e6).astype(np.int64) * 1000  # the resolution of such large doubles is about a microsecond
    keep = checks.in_order(path, np.arange(1, len(t) + 1), t_ns, [])
    poses = np.column_stack((x, y, se2.wrap(heading)))
    return Trajectory(checks.seconds(t_ns[keep], int(t_ns[0])), poses[keep]), int(t_ns[0])


def read_reads(folder: Path, t0_ns: int, end: float) -> tuple[RfidStream, tuple[Notice, ...]]:
    """Read the inventory rounds of all antennas at times from 0 to ``end`` [s], where there is odometry. Returns them with
    warnings."""
    tables = [np.loadtxt(folder / f"{antenna}.txt", dtype=str, ndmin=2).reshape(-1, 8) for antenna in ANTENNAS]
    table = np.concatenate(tables)
    t_ns = table[:, HOST_CLOCK].astype(np.int64) * 1000
    order = np.argsort(t_ns, kind="stable")
    table, t_ns = table[order], t_ns[order]
    antenna = np.repeat(ANTENNAS, [len(one) for one in tables])[order].tolist()
    rssi, phase, carrier = (table[:, column].astype(float) for column in (RSSI, PHASE, CARRIER))
    number = rounds_from_gaps(t_ns, antenna, ROUND_GAP)
    end_ns = ends_of(t_ns, number, ROUND_GAP)
    first = np.searchsorted(number, np.arange(len(end_ns)))
    whole = (t_ns[first] >= t0_ns) & ((end_ns - t0_ns) / 1e9 <= end)
    keep = whole[number]
    sentence = "{source}: {outside} of {reads} reads are outside of the reference and skipped"
    left_out = notice("outside_reference", sentence, folder, np.count_nonzero(~keep), len(keep))
    reads = ReadsByRound(
        t_ns[keep],
        (np.cumsum(whole) - 1)[number[keep]],
        table[keep, EPC].tolist(),
        (rssi[keep], np.radians(phase[keep]), carrier[keep] * 1e6),
        end_ns[whole],
        [antenna[i] for i in first[whole].tolist()],
    )
    return reads.stream(t0_ns), () if np.all(keep) else (left_out,)
