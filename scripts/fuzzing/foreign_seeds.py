"""Small files of foreign formats for the fuzzer: each function writes into an empty folder."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.io import savemat

import factorgraph_loc as fgloc
from factorgraph_loc.io.bags.file import open_bag
from factorgraph_loc.io.bags.manifest import propose
from factorgraph_loc.io.bags.proposed import manifest_of, manifest_text
from fuzzing.seeds import TAGS, WORLD_TABLES, drive, occupancy

START = 1_700_000_000  # s since 1970
HEAD = 'title = "m"\nreader = "mapped"\npath = "day"\nlicence = "none"\norigin = "own"\n'
ODOMETRY = """
[options.odometry]
file = "wheels.csv"
separator = ";"
decimal = ","
columns = { t = "millis", x = "x", y = "y", heading = "heading" }
units = { t = "ms", heading = "deg" }
clock_offset = 1700000000
"""
REFERENCE = '\n[options.reference]\nfile = "truth.txt"\nformat = "tum"\n'
RFID = {
    "itemtest": 'file = "reads.csv"\npreset = "impinj_itemtest"\nantennas = { 1 = "left" }\n',
    "sllurp": 'file = "sl.csv"\npreset = "sllurp_log"\nepc_case = "upper"\n',
    "llrp": 'file = "llrp.jsonl"\npreset = "sllurp_reports"\nchannels = [865.7, 866.3, 866.9, 867.5]\n',
    "iot": 'file = "iot.jsonl"\npreset = "impinj_iot"\n',
}
INVENTORIES = """
[options.inventories]
file = "rounds.csv"
columns = { t = "end", antenna = "antenna", duration = "duration_ms" }
units = { t = "s", duration = "ms" }
"""
OTHERS = """
[options.imu]
file = "imu.csv"
columns = { t = "t", wx = "wx", wy = "wy", wz = "wz" }
units = { t = "us", wx = "deg/s", wy = "deg/s", wz = "deg/s" }
axes = "body"
[options.bearing_range]
file = "seen.jsonl"
columns = { t = "t", landmark = "id", range = "at.r", bearing = "at.b" }
units = { t = "s", bearing = "deg" }
"""


def _wheels() -> str:
    rows = [f"{50 * i};{0.02 * i:.3f};0,1;{3 * i}".replace(".", ",") for i in range(20)]
    return "\n".join(["millis;x;y;heading", *rows, ""])


def tables(folder: Path) -> None:
    """A manifest with mapped columns of every sensor."""
    _mapped(folder, "itemtest", INVENTORIES + OTHERS)
    (folder / "hall.world.toml").write_text('name = "hall"' + WORLD_TABLES)
    (folder / "tags.csv").write_text(TAGS)
    occupancy(folder, "pgm")
    (folder / "m.toml").write_text('world = "hall.world.toml"\n' + (folder / "m.toml").read_text())
    day = folder / "day"
    ends = [f"{START + 0.1 * i:.3f},1,30" for i in range(1, 12)]
    (day / "rounds.csv").write_text("\n".join(["end,antenna,duration_ms", *ends, ""]))
    rows = [f"{(START * 1000 + 50 * i) * 1000},0.1,0.2,{i}" for i in range(20)]
    (day / "imu.csv").write_text("\n".join(["t,wx,wy,wz", *rows, ""]))
    seen = [{"t": START + 0.2 * i, "id": "door", "at": {"r": 2.0, "b": 10.0 * i}} for i in range(4)]
    (day / "seen.jsonl").write_text("".join(json.dumps(one) + "\n" for one in seen))


def sllurp(folder: Path) -> None:
    _mapped(folder, "sllurp")


def llrp(folder: Path) -> None:
    _mapped(folder, "llrp")


def iot(folder: Path) -> None:
    _mapped(folder, "iot")


def _mapped(folder: Path, kind: str, more: str = "") -> None:
    day = folder / "day"
    day.mkdir()
    (folder / "m.toml").write_text(HEAD + ODOMETRY + REFERENCE + f"\n[options.rfid]\n{RFID[kind]}" + more)
    (day / "wheels.csv").write_text(_wheels())
    poses = [f"{START + 0.05 * i:.3f} {0.02 * i:.3f} 0.1 0 0 0 0 1" for i in range(20)]
    (day / "truth.txt").write_text("\n".join(["# t x y z qx qy qz qw", *poses, ""]))
    stamps = [f"2023-11-14T22:13:20.{50_000 * i:06d}" for i in range(1, 12)]
    if kind == "itemtest":
        head = "// ReaderName=example, AntennaIDs=1-8\n// Timestamp, EPC, TID, Antenna, RSSI, Frequency, Hostname, PhaseAngle\n"
        rows = [f"{t}+00:00,E20{i % 3},,1,-60.5,866.3,example,1.5" for i, t in enumerate(stamps)]
        (day / "reads.csv").write_text(head + "\n".join(rows) + "\n")
    elif kind == "sllurp":
        rows = [f"{START + 0.05 * i:.6f},r,1,-60,E20{i % 3}" for i in range(12)]
        (day / "sl.csv").write_text("\n".join(["timestamp,reader,antenna,rssi,epc", *rows, ""]))
    elif kind == "llrp":
        (day / "llrp.jsonl").write_text("".join(json.dumps(_llrp(i)) + "\n" for i in range(12)))
    else:
        events = [_iot(i, f"{t}Z") for i, t in enumerate(stamps)]
        (day / "iot.jsonl").write_text("".join(json.dumps(one) + "\n" for one in events))


def _llrp(i: int) -> dict[str, Any]:
    us = START * 1_000_000 + 50_000 * i
    of_impinj = {"ImpinjRFPhaseAngle": 1000, "ImpinjPeakRSSI": -6010}
    stamps = {"FirstSeenTimestampUTC": us, "LastSeenTimestampUTC": us + 1000}
    return {
        "AntennaID": 1,
        "EPC": f"E20{i % 3}",
        "PeakRSSI": -60,
        "TagSeenCount": 2,
        "ChannelIndex": 3,
        **stamps,
        **of_impinj,
    }


def _iot(i: int, stamp: str) -> dict[str, Any]:
    read = {"epcHex": f"E20{i % 3}", "antennaPort": 1, "peakRssiCdbm": -6010, "frequency": 866300, "phaseAngle": 1.0}
    return {"timestamp": stamp, "hostname": "r", "eventType": "tagInventory", "tagInventoryEvent": read}


def _bag(folder: Path, suffix: str) -> None:
    fgloc.write_log(drive(1.0), folder / f"sim.{suffix}")
    with open_bag(folder / f"sim.{suffix}") as bag:
        proposal = propose(bag)
        content = manifest_of(proposal, f"sim.{suffix}", {"rig": "sim.rig.toml", "world": "sim.world.toml"})
        (folder / "run.toml").write_text(manifest_text(content, []))


def ros1(folder: Path) -> None:
    _bag(folder, "bag")


def sqlite(folder: Path) -> None:
    _bag(folder, "db3")


def mcap(folder: Path) -> None:
    _bag(folder, "mcap")


def _picture(width: int, height: int, channels: int) -> np.ndarray:
    rng = np.random.default_rng(width)
    picture = np.zeros((height, width, channels), dtype=np.uint8)
    picture[: height // 2] = rng.integers(0, 255, channels)
    return picture


POSES = ("a.tum", "b.csv", "c.kitti")


def poses(folder: Path) -> None:
    bend = [(0.3 * i, 0.02 * i * i, 0.1) for i in range(20)]
    tum, euroc, kitti = (folder / name for name in POSES)
    tum.write_text(
        "# t x y z q\n"
        + "".join(f"{1305031102 + 0.1 * i:.4f} {x} {y} {z} 0 0 0 1\n" for i, (x, y, z) in enumerate(bend))
    )
    euroc.write_text(
        "#t\n" + "".join(f"{13050311020 + i}00000000,{x},{y},{z},1,0,0,0,9\n" for i, (x, y, z) in enumerate(bend))
    )
    kitti.write_text("".join(f"1 0 0 {x} 0 1 0 {y} 0 0 1 {z}\n" for x, y, z in bend))


def mrclam(folder: Path) -> None:
    t = 1248444187.1
    (folder / "Barcodes.dat").write_text("# comment\n  1 \t 5\n  2 \t 14\n  6 \t 63\n  7 \t 81\n")
    (folder / "Landmark_Groundtruth.dat").write_text(
        "# c\n 6 \t 0.5 \t -4.2 \t 0.0001 \t 0.0002\n 7 1.5 2.0 0.0003 0.0001\n"
    )
    rows = [f"{t + 0.03 * i:.3f} \t 0.086 \t -0.398\n" for i in range(8)]
    (folder / "Robot1_Odometry.dat").write_text("# comment\n" + "".join(rows))
    seen = [f"{t + 0.02 * i:.3f} \t {(63, 81, 14, 99)[i % 4]} \t 3.787 \t -0.257\n" for i in range(8)]
    (folder / "Robot1_Measurement.dat").write_text("# comment\n" + "".join(seen))
    poses = [f"{t + 0.05 * i:.3f} 1.{i} -3.0 2.25\n" for i in range(5)]
    (folder / "Robot1_Groundtruth.dat").write_text("# comment\n" + "".join(poses))


def _save(path: Path, fields: dict[str, Any]) -> None:
    savemat(path, fields)
    content = path.read_bytes()
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(116) + content[116:])  # without the time of day


def plaza(folder: Path) -> None:
    t = 10.0 + 0.1 * np.arange(6.0)[:, None]
    zero = np.zeros_like(t)
    fields = {
        "DR": np.hstack((t, zero + 0.5, zero + 0.1)),
        "TD": np.hstack((t, zero + 2, zero + 1, zero + 5.0)),
        "GT": np.hstack((t, t, zero, zero)),
        "TL": np.array([[1.0, 3, 4], [6, -3, 4]]),
    }
    _save(folder / "p.mat", fields)


def woods(folder: Path) -> None:
    column = np.zeros((4, 1))
    r = np.zeros((4, 17))
    r[0, 0], r[2, 16] = 0.5, 2.0
    fields = {"t": 0.1 * np.arange(4.0)[:, None], "v": column + 0.25, "om": column, "r": r, "b": 0.5 * (r > 0)}
    fields |= {"l": np.arange(34.0).reshape(17, 2), "x_true": column, "y_true": column, "th_true": column + 4.0}
    _save(folder / "w.mat", fields | {"true_valid": np.array([[1], [0], [1], [1]], dtype=np.uint8)})


def sevenscenes(folder: Path) -> None:
    for number in (0, 2, 10):
        cv2.imwrite(
            str(folder / f"frame-{number:06d}.color.jpg"), _picture(640, 480, 3), [cv2.IMWRITE_JPEG_QUALITY, 10]
        )
        c, s = math.cos(0.1 * number), math.sin(0.1 * number)
        rows = f"{c:.7e} {-s:.7e} 0 {number}\n{s:.7e} {c:.7e} 0 2\n0 0 1 3\n0 0 0 1\n"
        (folder / f"frame-{number:06d}.pose.txt").write_text(rows)


def rf_robot(folder: Path) -> None:
    t0 = 1_673_511_856_000_000
    run = folder / "run4"
    run.mkdir()
    (folder / "tags.csv").write_text(
        "epc,label,x_m,y_m,z_m,facing_deg\nE-1,A1,1.0,-2.0,1.5,90\nE-2,A2,3.0,-1.0,0.5,-90\n"
    )
    poses = [f"{0.001 * k:.6f} 0.0 0.1 {t0 / 1e6 + 0.005 * k:.6f}" for k in range(61)]
    (run / "reference_pose.txt").write_text("\n".join(poses) + "\n")
    for j, antenna in enumerate(("first", "second", "third")):
        us = [t0 + 10_000 * j + 40_000 * i for i in range(6)]
        rows = [f"1 E-{1 + i % 2} 1 920.625 90 -60.5 {t + 5_000_000} {t}\n" for i, t in enumerate(us)]
        (run / f"{antenna}.txt").write_text("".join(rows))
