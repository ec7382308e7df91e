"""Reading of ROS 1 and ROS 2 bags."""

__all__ = ["file", "manifest", "poses", "rosbag"]
