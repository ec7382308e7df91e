"""Wheel odometry and gyro."""

from factorgraph_loc.model.sections import Section
from factorgraph_loc.sensors.registry import Channel, SensorType

__all__ = ["SENSOR", "calibration", "columns", "measurement", "model", "settings", "simulation", "stream", "whole"]

SENSOR = SensorType(
    "odometry",
    channels=(
        Channel(
            "odometry",
            streams=(
                "factorgraph_loc.sensors.odometry.stream:VelocityStream",
                "factorgraph_loc.sensors.odometry.stream:IncrementStream",
            ),
            measurements=(
                "factorgraph_loc.sensors.odometry.measurement:VelocityOdometry",
                "factorgraph_loc.sensors.odometry.measurement:IncrementOdometry",
            ),
            tables=(
                "factorgraph_loc.sensors.odometry.columns:VELOCITIES",
                "factorgraph_loc.sensors.odometry.columns:INCREMENTS",
            ),
            described=(
                "factorgraph_loc.sensors.odometry.columns:WAYS",
                "factorgraph_loc.sensors.odometry.columns:WHEELS",
            ),
            assemble="factorgraph_loc.sensors.odometry.tables:assemble",
            sequence="factorgraph_loc.sensors.odometry.pushed:Increments",
            section="odometry",
            motion="floor",
        ),
        Channel(
            "imu",
            streams=("factorgraph_loc.sensors.odometry.stream:YawRateStream",),
            measurements=("factorgraph_loc.sensors.odometry.measurement:YawRate",),
            tables=("factorgraph_loc.sensors.odometry.columns:IMU",),
            section="imu",
            motion="turn",
        ),
    ),
    settings={
        "odometry": Section("factorgraph_loc.sensors.odometry.settings:OdometrySettings", always=True),
        "imu": Section("factorgraph_loc.sensors.odometry.settings:ImuSettings"),
    },
    predict="factorgraph_loc.sensors.odometry.motion:OdometryMotion",
    summarize="factorgraph_loc.sensors.odometry.summary:summarize",
    simulate="factorgraph_loc.sensors.odometry.simulation:simulate",
    calibrator="factorgraph_loc.sensors.odometry.calibration.calibrator:CALIBRATOR",
)
