"""Derivatives by central differences, which Jacobians are compared with."""

import numpy as np

from factors import se2

STEP = 1e-6


def derivative(function, size, step=STEP):
    """Of a number or array by a vector of ``size``, at zero: the last axis is that of the vector."""
    return np.stack([(function(d) - function(-d)) / (2.0 * step) for d in step * np.eye(size)], axis=-1)


def by_pose(function, pose, step=STEP):
    """Of a number or array by a pose that is perturbed in its own frame."""
    return derivative(lambda d: function(se2.compose(pose, se2.exp(d))), 3, step)


def by_each(function, values, poses=(0,), step=STEP):
    """Of a number or array by each of its values, a list; those in the places ``poses`` are poses."""

    def by(i):
        def at(value):
            return function([*values[:i], value, *values[i + 1 :]])

        return (
            by_pose(at, values[i], step)
            if i in poses
            else derivative(lambda d: at(values[i] + d), len(values[i]), step)
        )

    return [by(i) for i in range(len(values))]
