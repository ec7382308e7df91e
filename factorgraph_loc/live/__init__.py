"""The library for a robot that drives."""
