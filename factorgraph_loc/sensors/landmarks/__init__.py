"""Ranges and bearings of identified landmarks."""
