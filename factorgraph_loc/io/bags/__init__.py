"""Reading and writing of ROS 1 and ROS 2 bags."""

__all__ = ["export", "file", "poses", "proposed", "rosbag"]
