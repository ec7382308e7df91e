"""Ranges and bearings of landmarks: model and factor."""
