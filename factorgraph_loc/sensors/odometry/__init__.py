"""Wheel odometry and gyro, which measure the motion of the robot."""

from factorgraph_loc.model.sections import Section
from factorgraph_loc.sensors.registry import Channel, SensorType

__all__ = ["SENSOR", "jumps", "measurement", "settings", "simulation"]

SENSOR = SensorType(
    "odometry",
    channels=(
        Channel(
            "odometry",
            tables=(
                "factorgraph_loc.sensors.odometry.measurement:VELOCITIES",
                "factorgraph_loc.sensors.odometry.measurement:INCREMENTS",
            ),
            described=(
                "factorgraph_loc.sensors.odometry.measurement:WAYS",
                "factorgraph_loc.sensors.odometry.measurement:WHEELS",
            ),
            assemble="factorgraph_loc.sensors.odometry.measurement:assemble",
            disassemble="factorgraph_loc.sensors.odometry.measurement:disassemble",
            intake="factorgraph_loc.sensors.odometry.measurement:Increments",
            section="odometry",
        ),
        Channel(
            "imu",
            tables=("factorgraph_loc.sensors.odometry.measurement:IMU",),
            section="imu",
        ),
    ),
    settings={
        "odometry": Section("factorgraph_loc.sensors.odometry.settings:OdometrySettings", always=True),
        "imu": Section("factorgraph_loc.sensors.odometry.settings:ImuSettings"),
    },
    summarize="factorgraph_loc.sensors.odometry.summary:summarize",
    simulate="factorgraph_loc.sensors.odometry.simulation:simulate",
    calibrator="factorgraph_loc.sensors.odometry.calibrator:CALIBRATOR",
)
