"""Wheel odometry and gyro."""
