"""Compiled loops of :mod:`factorgraph_loc.planning.information`: particles along a path, and their covariance and entropy."""

import math

import numpy as np

from factorgraph_loc.sensors.interfaces import Array32, Places
from factors.compiled import compiled
from factors.se2 import Array


@compiled
def station_poses(
    particles: Array, along: Array, steps: Places, last: Places, sigmas: Array, normals: Array, out: Array
) -> None:
    """Compute the poses of M particles at S stations of a path: the start, the poses of measurements, and the end.

    ``particles`` (M, 3): the poses at the start. ``along`` (P, 3): the poses of the path, relative to the start.
    ``steps`` (S,): the indices of the stations among the poses of the path.
    ``last`` (M,): the index of the last pose that each particle reaches. The particle stays there.
    ``sigmas`` (S, 3): standard deviations of the motion to each station, in the robot frame. ``normals`` (S, M, 3):
    standard normal random numbers for the motion. ``out`` (S, M, 3): output, the poses.
    """
    count = len(particles)
    errors = np.zeros((count, 3))
    for k in range(len(steps)):
        end = along[steps[k]]
        begin = along[steps[k - 1]] if k else end
        # adjoint of the inverse motion: transforms the error at the previous station to the frame of this one
        ce, se = math.cos(end[2]), math.sin(end[2])
        c, s = math.cos(end[2] - begin[2]), math.sin(end[2] - begin[2])
        back_x, back_y = (
            ce * (begin[0] - end[0]) + se * (begin[1] - end[1]),
            ce * (begin[1] - end[1]) - se * (begin[0] - end[0]),
        )
        for i in range(count):
            if k == 0 or steps[k - 1] < last[i]:
                ex, ey, eh = errors[i]
                errors[i, 0] = c * ex + s * ey + back_y * eh + sigmas[k, 0] * normals[k, i, 0]
                errors[i, 1] = c * ey - s * ex - back_x * eh + sigmas[k, 1] * normals[k, i, 1]
                errors[i, 2] = eh + sigmas[k, 2] * normals[k, i, 2]
            at = along[min(steps[k], last[i])]
            ch, sh = math.cos(particles[i, 2]), math.sin(particles[i, 2])
            heading = particles[i, 2] + at[2]
            cn, sn = math.cos(heading), math.sin(heading)
            ex, ey, eh = errors[i]
            out[k, i, 0] = particles[i, 0] + ch * at[0] - sh * at[1] + cn * ex - sn * ey
            out[k, i, 1] = particles[i, 1] + sh * at[0] + ch * at[1] + sn * ex + cn * ey
            out[k, i, 2] = heading + eh


@compiled
def covariances(poses: Array, index: Places, weights: Array32, out: Array) -> None:
    """Compute J weighted covariances of (x, y, heading) of M particles.

    ``poses`` (S, M, 3): the particles at S stations, the points of a path at which the belief is evaluated. ``index``
    (J,): the index of the station of each covariance. ``weights`` (J, M): the weights of the particles for each
    covariance. ``out`` (J, 3, 3): output. Heading differences are wrapped to (-pi, pi].
    """
    count = poses.shape[1]
    d = np.empty(3)
    first, second = np.empty(3), np.empty((3, 3))
    for n in range(len(index)):
        first[:], second[:] = 0.0, 0.0
        at = poses[index[n]]
        total = 0.0
        for i in range(count):
            w = weights[n, i]
            if w < 1e-9:
                continue
            d[0], d[1] = at[i, 0] - at[0, 0], at[i, 1] - at[0, 1]
            turn = at[i, 2] - at[0, 2]
            d[2] = turn - 2.0 * math.pi * math.floor(turn / (2.0 * math.pi) + 0.5)
            total += w
            for a in range(3):
                first[a] += w * d[a]
                for b in range(a + 1):
                    second[a, b] += w * d[a] * d[b]
        for a in range(3):
            for b in range(a + 1):
                out[n, a, b] = out[n, b, a] = second[a, b] / total - first[a] * first[b] / (total * total)


@compiled
def cell_entropies(poses: Array, index: Places, weights: Array32, cell: Array, dims: int, out: Array) -> None:
    """Compute the entropies [nats] of J weighted histograms of M particles.

    ``poses`` (S, M, 3): the particles at S stations of a path. ``index`` (J,): the index of the station of each
    histogram. ``weights`` (J, M): the weights of the particles in each. ``cell`` (3,): the size of a cell in x, y and
    heading. ``dims``: the number of leading coordinates that are considered. ``out`` (J,): output.
    """
    stations, count, _ = poses.shape
    volume = 0.0
    for a in range(dims):
        volume += math.log(cell[a])
    numbers = np.full((stations, count), -1, np.int64)
    mass = np.zeros(count)
    for n in range(len(index)):
        number = numbers[index[n]]
        if number[0] < 0:
            _number_cells(poses[index[n]], cell, dims, number)
        total = 0.0
        for i in range(count):
            mass[number[i]] += weights[n, i]
            total += weights[n, i]
        entropy = 0.0
        for i in range(count):
            p = mass[i] / total
            if p > 0.0:
                entropy -= p * math.log(p)
            mass[i] = 0.0
        out[n] = entropy + volume


@compiled
def _number_cells(poses: Array, cell: Array, dims: int, out: Places) -> None:
    """Write to ``out`` (M,) the index of the histogram cell that contains each of the particles ``poses`` (M, 3).
    Indices are below M. Particles in the same cell have the same index. ``cell`` (3,): the size of a cell. ``dims``:
    the number of leading coordinates that are considered."""
    count = len(poses)
    size = 1
    while size < 4 * count:
        size *= 2
    owner = np.full(size, -1, np.int64)
    keys = np.zeros((count, 3), np.int64)
    for i in range(count):
        for a in range(dims):
            value = poses[i, a]
            if a == 2:
                value -= 2.0 * math.pi * math.floor(value / (2.0 * math.pi))
            keys[i, a] = math.floor(value / cell[a])
        slot = (keys[i, 0] * 73856093 ^ keys[i, 1] * 19349663 ^ keys[i, 2] * 83492791) & (size - 1)
        while owner[slot] >= 0:
            key = keys[owner[slot]]
            if key[0] == keys[i, 0] and key[1] == keys[i, 1] and key[2] == keys[i, 2]:
                break
            slot = (slot + 1) & (size - 1)
        if owner[slot] < 0:
            owner[slot] = i
        out[i] = owner[slot]
