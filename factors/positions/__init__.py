"""The factor of a measured position of a point of the robot, such as a GNSS antenna."""

__all__ = ["factor"]
