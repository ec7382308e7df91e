"""Pixels of points in space: model, kernels, factors."""
