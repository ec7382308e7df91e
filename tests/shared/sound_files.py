"""Small sound files of each format: a function writes them into an empty folder."""

import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import mapped_hall
import numpy as np
import pose_files
from bag_maker import BagMaker
from scipy.io import savemat

import factorgraph_loc as fgloc
from factors.rfid.model import GridModel

START = 1_700_000_000  # s since 1970
MAP = """
walls = "hall.yaml"
tags = { file = "tags.csv", separator = ";", decimal = ",", columns = { epc = "ID", x = "X", y = "Y" }, units = { x = "cm" } }
markers = { "tag36h11-7" = { x = 4.0, y = 1.0, z = 1.2, size = 0.16, facing = 3.1416, sigma = 0.005 } }
landmarks = { door = { x = 4.0, y = 1.0, sigma = 0.02 }, beacon = { x = 1.0, y = -2.0, covariance = [0.0025, 0.0004, 0.0009] } }
"""
OCCUPANCY = """
image: hall.pgm
resolution: 0.25
origin: [-1.0, -3.0, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""
GRID = """
name = "g"
sensors = ["odometry", "rfid"]
rfid = { antennas = { left = { y = 0.2, z = 1.0 } }, models = { default = { kind = "grid", file = "g.default.npz" } } }
"""
EXPERIMENT = """
name = "e"
logs = [{ simulate = "office", seeds = "0:2", settings = { drive = { duration = 2.0 } } }]
estimators = ["dead_reckoning", { name = "particle_filter", label = "pf", settings = { particles = 50 } }]
sweep = { "pf.particles" = [20, 30] }
report = { baseline = "dead_reckoning" }
"""
PYFG = """
VERTEX_SE2 10.0 A0 1.0 2.0 0.0
VERTEX_SE2 10.5 A1 2.0 2.0 0.0
VERTEX_SE2 11.0 A2 2.0 2.0 7.0
VERTEX_XY L0 5.0 2.0
EDGE_SE2 10.5 A0 A1 1.0 0.0 0.0 0.02 0.0 0.0 0.005 0.0 0.0008
EDGE_SE2 11.0 A1 A2 0.0 0.0 7.0 0.02 0.0 0.0 0.005 0.0 0.0008
EDGE_RANGE 10.6 A1 L0 3.1 0.09
EDGE_RANGE 10.2 A0 L0 3.9 0.09
"""


@cache
def drive():
    """A short drive in a small world, with each sensor that needs no images."""
    seen = {"sightings": {"max_range": 20.0, "rate": 4.0}, "rssi": {}, "phase": {}, "rig": {"rfid": {"phase": {}}}}
    world = {"tags": 8, "landmarks": 8, "points": 20}
    log = fgloc.simulate("office", 3, changes={"drive": {"duration": 3.0}, "world": world, **seen})
    moved = log.streams["odometry"]
    gyro = fgloc.YawRateStream(moved.t[1:], moved.dtheta[1:] / np.diff(moved.t))
    return replace(log, name="sim", streams={**log.streams, "imu": gyro})


def csv(folder):
    fgloc.write_native(drive(), folder)


def several(folder):
    """A log with two radios and with measured positions."""
    log = drive()
    t, x, y = log.reference.t[::5], log.reference.poses[::5, 0], log.reference.poses[::5, 1]
    unknown = np.full(len(t), np.nan)
    ranges = log.streams["bearing_range"]
    streams = {name: stream for name, stream in log.streams.items() if name in ("odometry", "imu")}
    streams |= {f"bearing_range.{name}": ranges for name in ("front", "rear")}
    streams["position"] = fgloc.PositionStream(t, x, y, unknown, unknown, unknown)
    radio = log.rig.bearing_range.model_dump(exclude_unset=True)
    rig = fgloc.Rig.model_validate(
        {"name": "sim", "bearing_range": {"front": {**radio, "x": 0.2}, "rear": radio}, "position": {"sigma": 0.1}}
    )
    fgloc.write_native(replace(log, rig=rig, streams=streams), folder)


def pyfg(folder):
    """A drive of three poses with two ranges to one landmark."""
    folder.mkdir()
    (folder / "p.pyfg").write_text(PYFG)


def parquet(folder):
    fgloc.write_native(drive(), folder, format="parquet")


def images(folder):
    """A log with two images of any content."""
    csv(folder)
    rig = fgloc.read_rig(folder / "sim.rig.toml").model_dump(exclude_unset=True)
    lens = {"width": 32, "height": 24, "fx": 20.0, "fy": 20.0, "cx": 16.0, "cy": 12.0, "z": 1.0}
    fgloc.write_rig(fgloc.Rig.model_validate({**rig, "camera": lens}), folder / "sim.rig.toml")
    for name in ("a.png", "b.jpg"):
        noise = np.random.default_rng(0).integers(0, 255, (24, 32, 3), dtype=np.uint8)
        cv2.imwrite(str(folder / name), noise)
    (folder / "camera.csv").write_text("t_ns,file\n0,a.png\n2000000000,b.jpg\n")


def world(folder):
    """A map with tags in a spreadsheet's table, an occupancy map, landmarks and markers."""
    folder.mkdir()
    (folder / "hall.world.toml").write_text(MAP)
    (folder / "tags.csv").write_text("ID;X;Y\nE201;100,0;-50,5\nE202;310,5;80,0\n")
    cells = np.full((24, 32), 254, dtype=np.uint8)
    cells[4, 3:28] = cells[19, 3:28] = cells[4:20, 3] = cells[4:20, 27] = 0
    cv2.imwrite(str(folder / "hall.pgm"), cells)
    (folder / "hall.yaml").write_text(OCCUPANCY)


def grid(folder):
    """A rig with a learnt model of reads."""
    folder.mkdir()
    logits = np.random.default_rng(0).normal(-2.0, 1.0, (2, 6, 5, 5))
    fgloc.write_grid(GridModel(logits, -2.5, -2.5, 1.0, np.array([0.0, 1.0])), folder / "g.default.npz")
    (folder / "g.rig.toml").write_text(GRID)


def result(folder):
    """A log, and a run on it."""
    fgloc.write_native(drive(), folder / "log")
    fgloc.run(str(folder / "log"), "dead_reckoning", out=folder / "run")
    shutil.rmtree(folder / "run" / "plots", ignore_errors=True)


def experiment(folder):
    """An experiment that was not run."""
    folder.mkdir()
    (folder / "e.toml").write_text(EXPERIMENT)


def tables(folder):
    """A manifest of other programs' tables, and those tables."""
    world(folder)
    (folder / "run").mkdir()
    (folder / "m.toml").write_text('world = "hall.world.toml"\n' + mapped_hall.MANIFEST)
    for name, text in (("wheels", mapped_hall.ODOMETRY), ("reads", mapped_hall.READS), ("truth", mapped_hall.TRUTH)):
        (folder / f"run/{name}.csv").write_text(text)


def bag(name):
    """A ROS bag of odometry: of version 1, or of version 2 in either storage."""

    def make(folder):
        folder.mkdir()
        is_1 = name.endswith(".bag")
        with BagMaker(folder / (name if is_1 else "made"), "mcap" if name.endswith("mcap") else "sqlite3") as made:
            for i in range(20):
                made.odometry("/odom", (START + i) * 10**9, (0.1 * i, 0.0, 0.0))
        if not is_1:
            next(file for file in made.path.iterdir() if file.suffix == Path(name).suffix).rename(folder / name)
            shutil.rmtree(made.path)

    return make


def poses(folder):
    """A reference and an estimate in each format of trajectories."""
    folder.mkdir()
    for poses, name in zip(pose_files.wander(0, 20), ("reference", "estimate"), strict=True):
        for suffix in (".tum", ".csv", ".kitti"):
            pose_files.write(folder / (name + suffix), poses)


def plaza(folder):
    folder.mkdir()
    t = 10.0 + 0.1 * np.arange(6.0)[:, None]
    moved, seen, truth = t * (1, 0, 0) + (0, 0.5, 0.1), t * (1, 0, 0, 0) + (0, 2, 1, 5), t * (1, 1, 0, 0)
    savemat(folder / "p.mat", {"DR": moved, "TD": seen, "GT": truth, "TL": np.array([[1.0, 3, 4], [6, -3, 4]])})
