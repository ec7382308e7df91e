"""Robust fits that calibrations are made of."""
