"""Cameras: features of images, and points by name."""
