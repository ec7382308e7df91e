"""Logs of a robot in space on the command line."""

from dataclasses import replace

import numpy as np
import pytest
from space_world import RIG_INERTIAL, swayed

from factorgraph_loc.io.native.native import write_native
from factorgraph_loc.model.trajectory3 import Trajectory3


@pytest.fixture
def native(tmp_path):
    """A log of an inertial unit and a camera, without wheels and without a reference."""
    log = swayed(1)
    streams = {name: log.streams[name] for name in RIG_INERTIAL.sensors}
    rig = RIG_INERTIAL.model_copy(update={"camera_right": None, "twist": None})
    write_native(replace(log, rig=rig, streams=streams, reference3=None), tmp_path / "log")
    return tmp_path / "log"


def test_a_native_log_of_an_inertial_unit(native, tmp_path, fgloc):
    arguments = ["run", native, "-e", "space_smoother", "--prior", "unknown", "-o", tmp_path / "run"]
    found = fgloc(*arguments)
    assert found.exit_code == 0, found.output
    final, truth = Trajectory3.read(tmp_path / "run" / "final.tum"), swayed(1).reference3
    ends = final.positions[-1] - truth.at(final.t[-1:] - final.t[0] + truth.t[1]).positions[0]
    assert np.linalg.norm(ends) < 0.03
    assert "force_bias_x" in (tmp_path / "run" / "learnt.json").read_text()


def test_rows_that_are_none_are_told_in_a_line(native, fgloc):
    header, first, *rows = (native / "inertial.csv").read_text().splitlines()
    stamp, _, rest = first.split(",", 2)
    (native / "inertial.csv").write_text("\n".join([header, f"{stamp},12000,{rest}", *rows]))
    found = fgloc("info", native)
    assert found.exit_code == 2
    (line,) = found.stderr.strip().splitlines()
    assert "inertial.csv:2: ax is 12000.0, expected" in line
    (native / "inertial.csv").write_text("t_ns,ax,ay,az,wx,wy\n1,0,0,9.8,0,0\n")
    found = fgloc("info", native)
    assert found.exit_code == 2
    assert len(found.stderr.strip().splitlines()) == 1


def test_a_robot_on_the_floor_does_not_use_it(native, tmp_path, fgloc):
    """Estimators in the plane count its rows as ignored, and say so."""
    stamps = [row.split(",", 1)[0] for row in (native / "inertial.csv").read_text().splitlines()[1:]]
    rows = (f"{stamp},0.1,0.0" for stamp in stamps)
    (native / "odometry.csv").write_text("\n".join(["t_ns,v,w", *rows]))
    found = fgloc(
        "run", native, "-e", "ekf", "--sensors", "odometry,inertial", "--prior", "0,0,0", "-o", tmp_path / "run"
    )
    assert found.exit_code == 0, found.output
    assert f"{len(stamps)} ignored" in found.output
