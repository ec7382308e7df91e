"""Detects a wrong time offset and a wrong focal length of the camera by how images turn, whatever is known of the points in them.

Features followed from one image to the next tell by how much the camera turned between them. What the odometry says of that depends
on when the images were taken: of a grid of time offsets one fits best (compare Kelly, Sukhatme, International Journal of Robotics
Research 33(12), 2014). Noise and slip of the wheels are the same at each of them. They may turn by another share than they say; so
that of the images tells nothing of the focal length. But when a camera turns, what it sees at the edges moves faster than in the
middle, the more so the shorter its focal length is.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.settings import Estimated
from factorgraph_loc.sensors.camera.known_points import Pixels
from factorgraph_loc.sensors.motion import Motion
from factorgraph_loc.vision.frame_motion import turned
from factors import se2
from factors.camera.model import FOCAL, TIME_OFFSET, CameraModel
from factors.se2 import Array

OFFSETS = np.linspace(-0.3, 0.3, 31)  # s that are tried
SHORTEST, LONGEST = 0.15, 1.0  # s between images that are compared
TURN, CHANGE = 0.05, 0.02  # rad: least turn between them, or least change of it by a fifth of a second
# rad, and relative: largest standard deviations of what two images tell of turn and focal length
SHARP, CLEAR = 0.003, 0.1
SLIPPED = 5.0  # standard deviations from what the wheels say at any offset
FEWEST, MOST = 40, 200  # pairs of images: what is right until then stays so
LATE, WRONG = 0.03, 0.01  # s, and relative: what is not told
SIGNIFICANT = 5.0  # standard deviations beyond that


class _Image(NamedTuple):
    t: float
    names: NDArray[Any]
    pixels: Array


class TurnCheck:
    """Tells each constant that is wrong once, as an event; see the module. ``estimated``: constants that are not checked. Without a
    ``model`` nothing is."""

    def __init__(
        self, model: CameraModel | None, motion: Motion, diagnostics: Diagnostics, estimated: Estimated
    ) -> None:
        self._model, self._motion, self._diagnostics = model, motion, diagnostics
        self._open = {FOCAL, TIME_OFFSET} - set(estimated.indices)
        self.told = False  # whether a constant is wrong
        self._left = MOST
        self._last: _Image | None = None
        self._waiting: deque[tuple[_Image, _Image]] = deque()  # for the odometry of after them
        # number of turns, their squares, products with those of the wheels, and the squares of these, by offset
        self._turns = np.zeros((4, len(OFFSETS)))
        self._focal = np.zeros(4)  # number, and moments of the error of the focal length with their weight

    def add(self, m: Pixels) -> None:
        """Add an image; a late one is left out."""
        model, last, t = self._model, self._last, m.t
        if model is None or not self._open or not self._left:
            return
        if last is not None and t < last.t + SHORTEST:
            return
        while self._waiting and self._waiting[0][1].t + OFFSETS[-1] < t:
            first, second = self._waiting.popleft()
            if t - first.t < self._motion.horizon - LONGEST:  # the odometry of then is still kept
                self._compare(model, first, second)
        names = m.names if m.frame is None else m.frame.tracks
        self._last = _Image(t, np.asarray(names), np.asarray(m.pixels, dtype=float))
        if last is not None and t < last.t + LONGEST:
            self._waiting.append((last, self._last))

    def _compare(self, model: CameraModel, first: _Image, second: _Image) -> None:
        """Compare the turn between two images with those of the wheels at all offsets."""
        motion, middle = self._motion, len(OFFSETS) // 2
        begin, constants = motion.state(first.t), np.zeros(len(motion.constants.names))
        before, after = (motion.poses_at(begin, image.t + OFFSETS, constants)[:, 2] for image in (first, second))
        turns = se2.wrap(after - before)
        if abs(turns[middle]) < TURN and abs(turns[middle + 5] - turns[middle - 5]) < CHANGE:
            return
        self._left -= 1
        _, rows, others = np.intersect1d(first.names, second.names, return_indices=True)
        step = motion.relative(begin, motion.state(second.t))
        starts = [np.append(step.delta[:2], turn) for turn in turns[::5].tolist()]
        found = turned(model, first.pixels[rows], second.pixels[others], starts)
        if found is None:
            return
        (turn, sigma), (focal, spread) = found
        if spread < CLEAR:
            self._focal += np.array((spread**2, 1.0, focal, focal**2)) / spread**2
            self._tell_focal(second.t)
        variance = float(step.covariance[2, 2]) + SHARP**2
        if sigma < SHARP and np.min(np.abs(turn - turns)) < SLIPPED * math.sqrt(variance):
            same = np.ones_like(turns)
            self._turns += np.array((same * variance, same * turn**2, turn * turns, turns**2)) / variance
            self._tell_offset(second.t)

    def _tell_offset(self, t: float) -> None:
        count, own, both, squares = self._turns
        if TIME_OFFSET not in self._open or count[0] < FEWEST:
            return
        left = own - both**2 / squares  # with the share that fits best of what the wheels turned
        best = int(np.argmin(left))
        evidence = (left[np.abs(OFFSETS) < LATE].min() / left[best] - 1.0) * count[0]
        if evidence > SIGNIFICANT**2:
            late = "later" if OFFSETS[best] > 0.0 else "earlier"
            what = f"images seem to be taken {abs(OFFSETS[best]):.2f} s {late} than they are stamped (time_offset)"
            self._tell(TIME_OFFSET, t, what)

    def _tell_focal(self, t: float) -> None:
        count, weight, first, second = self._focal.tolist()
        error = first / weight
        sigma = math.sqrt(max(1.0, (second - first * error) / count) / weight)
        if FOCAL in self._open and count >= FEWEST and abs(error) > WRONG + SIGNIFICANT * sigma:
            way = "longer" if error > 0.0 else "shorter"
            what = f"the focal length seems to be {100.0 * abs(error):.0f} % {way} than the rig says (fx, fy)"
            self._tell(FOCAL, t, what)

    def _tell(self, constant: int, t: float, what: str) -> None:
        self.told = True
        self._open.remove(constant)
        self._diagnostics.event(t, f"camera: {what}")
