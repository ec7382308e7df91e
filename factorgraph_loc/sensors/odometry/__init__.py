"""Wheel odometry and gyro."""

from factorgraph_loc.model.sections import Section
from factorgraph_loc.sensors.registry import Channel, SensorType

__all__ = ["SENSOR", "calibration", "measurement", "settings", "simulation", "tables"]

SENSOR = SensorType(
    "odometry",
    channels=(
        Channel(
            "odometry",
            streams=(
                "factorgraph_loc.sensors.odometry.measurement:VelocityStream",
                "factorgraph_loc.sensors.odometry.measurement:IncrementStream",
            ),
            measurements=(
                "factorgraph_loc.sensors.odometry.measurement:VelocityOdometry",
                "factorgraph_loc.sensors.odometry.measurement:IncrementOdometry",
            ),
            tables=(
                "factorgraph_loc.sensors.odometry.tables:VELOCITIES",
                "factorgraph_loc.sensors.odometry.tables:INCREMENTS",
            ),
            described=(
                "factorgraph_loc.sensors.odometry.tables:WAYS",
                "factorgraph_loc.sensors.odometry.tables:WHEELS",
            ),
            assemble="factorgraph_loc.sensors.odometry.tables:assemble",
            sequence="factorgraph_loc.sensors.odometry.measurement:Increments",
            section="odometry",
        ),
        Channel(
            "imu",
            streams=("factorgraph_loc.sensors.odometry.measurement:YawRateStream",),
            measurements=("factorgraph_loc.sensors.odometry.measurement:YawRate",),
            tables=("factorgraph_loc.sensors.odometry.tables:IMU",),
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
