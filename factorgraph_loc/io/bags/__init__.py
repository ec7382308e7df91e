"""Reading of ROS 1 and ROS 2 bags."""

__all__ = ["file", "poses", "proposed", "rosbag"]
