"""Measured positions of a point of the robot."""
