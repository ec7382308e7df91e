"""Detection of misplaced tags, whose reads are much more likely from another position.

A likelihood-ratio test for each tag. Without displacement the ratio is chi-squared with two degrees of freedom, times a factor for
correlated reads and errors of the detection model. The factor is estimated from the median over tags (Devlin and Roeder, "Genomic
control for association studies", Biometrics 55, 1999).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from factorgraph_loc.sensors.rfid.calibration.fit import Floor
from factorgraph_loc.sensors.rfid.calibration.pairs import REACH, terms
from factorgraph_loc.sensors.rfid.calibration.rounds import Integers, Rounds
from factorgraph_loc.sensors.rfid.settings import RfidSettings, SurveySettings
from factors import chi_squared, se2
from factors.rfid.model import DetectionModel, logits
from factors.se2 import Array

FAMILY = 0.01  # probability of any false alarm in a correct map
FARTHEST = 2.5  # m
COARSE = 0.5  # m
COARSE_LOOKS = 600  # per tag in the coarse search
LEAST_SHIFT = 0.3  # m; smaller shifts may be errors of the detection model
MIN_TAGS = 5  # minimum for a median


@dataclass(frozen=True)
class TagDoubt:
    """A misplaced tag with ``shift`` (2,) [m, in the world] from its surveyed position; ``p``: probability of so large a ratio for
    any tag in a correct map. ``name``: includes the log if positions differ between logs."""

    name: str
    shift: tuple[float, float]
    p: float

    @property
    def distance(self) -> float:
        return float(np.hypot(*self.shift))


def misplaced(
    logs: Sequence[Rounds],
    settings: RfidSettings,
    survey: SurveySettings,
    models: Sequence[DetectionModel],
    which: Sequence[int],
    floor: Floor,
) -> tuple[TagDoubt, ...]:
    """The misplaced tags of all logs, most certain first."""
    tags = _tags(logs)
    if len(tags) < MIN_TAGS:
        return ()
    found = [_moved(_reads(*tag, settings, survey), models, which, floor) for tag in tags.values()]
    ratios = np.array([ratio for ratio, _ in found])
    scale = max(1.0, float(np.median(ratios)) / float(chi_squared.quantile(0.5, 2)))
    p = np.minimum(1.0, len(tags) * chi_squared.survival(ratios / scale, 2))
    doubts = [
        TagDoubt(name, (float(shift[0]), float(shift[1])), float(one))
        for name, (_, shift), one in zip(tags, found, p, strict=True)
        if one < FAMILY and np.hypot(*shift) > LEAST_SHIFT
    ]
    return tuple(sorted(doubts, key=lambda d: d.p))


def _tags(logs: Sequence[Rounds]) -> dict[str, tuple[list[Rounds], str]]:
    """The logs and the name of each tag, by a unique key: tags in two buildings may have the same name."""
    found: dict[tuple[str, tuple[float, ...]], list[Rounds]] = {}
    for log in logs:
        for name, point in zip(log.names, log.tags.points.tolist(), strict=True):
            found.setdefault((name, tuple(point)), []).append(log)
    places = Counter(name for name, _ in found)
    return {
        name if places[name] == 1 else f"{name} ({its_logs[0].log})": (its_logs, name)
        for (name, _), its_logs in found.items()
    }


@dataclass(frozen=True, eq=False)
class _TagReads:
    """The data of one tag: ``hits`` of ``count`` rounds (K,) of antennas at (K, 3) poses in the world; ``antenna`` (K,), ``height``
    (K,) of the tag above it and ``pitch`` (K,); ``place`` (2,) of the tag and direction (2,) that it faces, zero if unknown."""

    hits: Array
    count: Array
    poses: Array
    antenna: Integers
    height: Array
    pitch: Array
    place: Array
    normal: Array

    def thinned(self, most: int) -> _TagReads:
        step = 1 + len(self.hits) // most
        return replace(self, **{name: getattr(self, name)[::step] for name in _COLUMNS})

    def nll(self, shift: Array, models: Sequence[DetectionModel], which: Sequence[int], floor: Floor) -> float:
        away = self.place + shift - self.poses[:, :2]
        c, s = np.cos(self.poses[:, 2]), np.sin(self.poses[:, 2])
        along, across = c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]
        facing = -(away @ self.normal) / np.sqrt(np.sum(away**2, axis=1) + 1e-9)
        cp, sp = np.cos(self.pitch), np.sin(self.pitch)
        points = np.column_stack((cp * along + sp * self.height, across, cp * self.height - sp * along))
        mine = np.asarray(which)[self.antenna]
        z = np.empty(len(facing))
        for i, model in enumerate(models):
            z[mine == i] = logits(model, points[mine == i], facing[mine == i])[0]
        return float(np.sum(terms(z, self.hits, self.count, floor.false_read, floor.miss).nll))


def _reads(logs: Sequence[Rounds], name: str, settings: RfidSettings, survey: SurveySettings) -> _TagReads:
    antennas = np.array([(a.x, a.y, a.yaw, a.z, a.pitch) for a in settings.all_antennas().values()])
    transform = survey.transform()
    parts = []
    for log in logs:
        column = log.names.index(name)
        place = se2.transform_from(transform, log.tags.points[column, :2])
        mounted = antennas[log.antenna]
        poses = se2.compose(log.poses, mounted[:, :3])
        near = np.hypot(*(poses[:, :2] - place).T) < REACH
        angle = log.tags.facing[column] + transform[2]
        normal = np.array((np.cos(angle), np.sin(angle))) if np.isfinite(angle) else np.zeros(2)
        height = log.tags.points[column, 2] - mounted[:, 3]
        hits, pitch = log.hits[near, column], mounted[near, 4]
        parts.append(
            _TagReads(hits, log.count[near], poses[near], log.antenna[near], height[near], pitch, place, normal)
        )
    return replace(parts[0], **{name: np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS})


_COLUMNS = ("hits", "count", "poses", "antenna", "height", "pitch")


def _moved(
    reads: _TagReads, models: Sequence[DetectionModel], which: Sequence[int], floor: Floor
) -> tuple[float, Array]:
    """Twice the log-likelihood ratio of the best position, and the shift (2,) to it."""
    few = reads.thinned(COARSE_LOOKS)
    steps = COARSE * np.arange(-round(FARTHEST / COARSE), round(FARTHEST / COARSE) + 1)
    shifts = [np.array((x, y)) for x in steps for y in steps if np.hypot(x, y) <= FARTHEST]
    start = min(shifts, key=lambda shift: few.nll(shift, models, which, floor))
    here = reads.nll(np.zeros(2), models, which, floor)
    simplex = start + np.array(((0.0, 0.0), (0.2, 0.0), (0.0, 0.2)))
    found = scipy.optimize.minimize(
        reads.nll,
        start,
        (models, which, floor),
        "Nelder-Mead",
        options={"xatol": 0.02, "fatol": 0.05, "maxfev": 50, "initial_simplex": simplex},
    )
    return 2.0 * max(here - float(found.fun), 0.0), np.asarray(found.x)
