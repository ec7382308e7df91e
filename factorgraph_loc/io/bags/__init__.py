"""ROS 1 and ROS 2 bags, read and written."""

__all__ = ["export", "file", "manifest", "rosbag"]
