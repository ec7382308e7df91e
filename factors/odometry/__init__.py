"""Increments of wheel odometry: model, chain of states, kernels."""
