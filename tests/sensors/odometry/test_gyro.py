"""A gyro from the file to the estimate: it is used whatever the odometry and the rig, or it is said that it is not."""

import numpy as np
import pytest

import factorgraph_loc as fgloc

T = np.arange(101) * 0.1
RATE = 0.3  # rad/s: 3 rad in 10 s, while the wheels say that the robot goes straight on
WALK = np.full(101, 0.05)
ODOMETRY = {
    "increments": fgloc.IncrementStream(T, WALK, 0.0 * WALK, 0.0 * WALK),
    "velocities": fgloc.VelocityStream(T, 10.0 * WALK, 0.0 * WALK),
}


@pytest.fixture
def drive(tmp_path):
    """``drive(odometry, rig)``: the log of a circle, written and read; without a rig it has none."""

    def of(odometry, rig):
        gyro = fgloc.YawRateStream(T + 0.033, np.full(101, RATE))
        start = fgloc.StartPose(0.0, np.zeros(3), np.full(3, 0.01))
        log = fgloc.Log("circle", rig or fgloc.Rig(), fgloc.World(), {"odometry": odometry, "imu": gyro}, start=start)
        fgloc.write_native(log, tmp_path / "circle")
        if rig is None:
            text = (tmp_path / "circle/run.toml").read_text()
            (tmp_path / "circle/run.toml").write_text(text.replace('rig = "circle.rig.toml"\n', ""))
        return fgloc.read_log(tmp_path / "circle")

    return of


@pytest.mark.parametrize("kind", list(ODOMETRY))
@pytest.mark.parametrize("rig", [None, fgloc.Rig(name="cart", sensors=["odometry", "imu"])], ids=["none", "no [imu]"])
@pytest.mark.parametrize("estimator", ["dead_reckoning", "ekf", "smoother"])
def test_a_gyro_turns_the_robot(drive, kind, rig, estimator):
    result = fgloc.run(drive(ODOMETRY[kind], rig), estimator).result
    assert result.diagnostics.ignored == {}
    assert result.final.poses[-1, 2] == pytest.approx(RATE * 10.0, abs=0.03)
    radius = 0.5 / RATE
    assert result.final.poses[-1, :2] == pytest.approx((radius * np.sin(3.0), radius * (1.0 - np.cos(3.0))), abs=0.05)


def test_a_gyro_that_the_rig_does_not_name_is_told_of(drive):
    log = drive(ODOMETRY["increments"], fgloc.Rig(name="cart", sensors=["odometry"]))
    assert [w.kind for w in log.warnings] == ["unused_gyro"]
    alone = fgloc.run(log, "dead_reckoning").result
    assert alone.final.poses[-1, 2] == 0.0
    asked = fgloc.run(log, "dead_reckoning", sensors=["odometry", "imu"]).result
    assert asked.final.poses[-1, 2] == pytest.approx(3.0, abs=0.03)
