"""Measured motion in space."""
