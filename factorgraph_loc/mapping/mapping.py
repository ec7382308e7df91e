"""Maps of identified landmarks that a run estimated, and their comparison with a given map.

A run without a map has a frame of its own. Its landmarks are aligned with those of a given map by one rotation and translation.
The alignment is robust, because some given landmarks may be wrong. It starts with sample consensus over pairs of landmarks
(Fischler and Bolles, "Random sample consensus", 1981). The cost is truncated (Torr and Zisserman, "MLESAC", 2000) and scaled by
the least median of squares (Rousseeuw and Leroy, "Robust Regression and Outlier Detection", 1987, chapter 5). Weighted least
squares on the inliers follow. The inliers are selected again in each iteration.

The covariances of the run include the drift between its start and the landmarks. This part is common to all landmarks,
and the alignment removes it. The covariances are therefore scaled by the variance of unit weight of the inliers (Koch,
"Parameter Estimation and Hypothesis Testing in Linear Models", 1999).
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from factorgraph_loc.errors import RunFailedError
from factorgraph_loc.model.belief import LearntPoint
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings, Landmark
from factorgraph_loc.sensors.landmarks.summary import not_located
from factorgraph_loc.text import Notice, notice
from factors import positive, se2
from factors.se2 import Array

GATE = 13.816  # 99.9 % of chi-square with two degrees of freedom
MEDIAN = 1.386  # 50 % of chi-square with two degrees of freedom
TOLERANCE = 0.15  # m; a smaller deviation of a landmark is never significant
UNSEEN = "not seen"  # the verdict on a given landmark without measurements in the log
# verdicts on landmarks that are not wrong, and their text in a summary
VERDICTS = {
    "agrees": "agreeing with the given one",
    "given": "as given",
    "new": "new",
    UNSEEN: "not seen",
    "not judged": "not judged",
}
MIN_COMMON = 3  # least number of landmarks in both maps: with two, a wrong landmark could not be detected
UNJUDGED = ": the maps are not compared, and the new map is in the frame of the run's start"  # end of a note
FACTORS = (0.01, 4.0)  # bounds of the scale of covariances
MAX_PAIRS = 5000  # if there are more pairs of landmarks, this many are drawn at random
MAX_ITERATIONS = 20
CONVERGED = 1e-9  # m and rad


@dataclass(frozen=True)
class Entry:
    """One landmark in the comparison of a new map with the map of the log (the given map).

    ``landmark``: its name. ``given``: its position (2,) in the given map, or None. ``learnt``: its estimated position
    with covariance, in the frame of the new map, or None. ``verdict``: the result of the comparison, such as "agrees".
    ``flagged``: True if the given position is wrong.
    """

    landmark: str
    given: Array | None
    learnt: LearntPoint | None
    verdict: str
    flagged: bool = False

    @property
    def distance(self) -> float | None:
        """The distance [m] between the position in the given map (of the log) and the estimated one. None if either is
        missing."""
        if self.given is None or self.learnt is None:
            return None
        return float(np.hypot(*(self.learnt.position - self.given)))

    @property
    def sigma(self) -> float | None:
        """Standard deviation [m] of the estimated position in its least certain direction, None without an estimate."""
        return None if self.learnt is None else float(positive.worst_sigma(self.learnt.covariance))


@dataclass(frozen=True)
class LandmarkMap:
    """A new map of landmarks, and its comparison with the map of the log (the given map).

    ``world``: the new map. ``entries``: one per landmark that is in either map. ``frame`` (3,): the pose of the run's
    frame in the frame of the new map. ``judged``: True if the two maps were compared. They then have the same frame.
    ``notes``: messages for the user.
    """

    world: World
    entries: tuple[Entry, ...]
    frame: Array
    judged: bool
    notes: tuple[Notice, ...]

    @property
    def unseen(self) -> tuple[str, ...]:
        """The names of the landmarks of the log's map that have no measurements in the log. They keep their positions
        in the new map."""
        return tuple(entry.landmark for entry in self.entries if entry.verdict == UNSEEN)

    @property
    def flagged(self) -> tuple[str, ...]:
        """The names of the landmarks with a wrong position in the log's map."""
        return tuple(entry.landmark for entry in self.entries if entry.flagged)

    def summary(self, what: str = "landmarks") -> str:
        """Return a sentence that summarises the map. ``what``: the plural noun for the mapped objects."""
        counts = Counter("flagged" if entry.flagged else entry.verdict for entry in self.entries)
        text = f"{len(self.world.landmarks)} {what} are in the new map"
        parts = [f"{counts[verdict]} {VERDICTS[verdict]}" for verdict in VERDICTS if counts[verdict]]
        if self.flagged:
            parts.append(f"{len(self.flagged)} wrong in the given map ({', '.join(self.flagged)})")
        return f"{text}: {', '.join(parts)}"


@dataclass(frozen=True)
class Alignment:
    """The alignment of a new map with the map of the log (the given map).

    ``pose`` (3,): x, y and angle of the transform from the new map's frame to the given map's frame. ``covariance``
    (3, 3): of this transform. ``inliers``: the number of landmarks that agree. ``factor``: multiplies the
    covariances of the new landmarks, so that they fit the differences.
    """

    pose: Array
    covariance: Array
    inliers: int
    factor: float


IN_FRAME = Alignment(np.zeros(3), np.zeros((3, 3)), 0, 1.0)


def make_map(
    log: Log, learnt: Mapping[str, LearntPoint], *, extend: bool = False, in_frame: bool = False
) -> LandmarkMap:
    """Return a map of the ``learnt`` landmarks, which a run on ``log`` estimated, and compare it with the log's map.

    ``extend``: True if the run used the log's map and estimated only landmarks that the map lacks. The landmarks of the
    log's map then stay unchanged. False if the run used no map. The estimated landmarks are then aligned and compared
    with the log's map, if there is one. ``in_frame``: True if the estimates are in the frame of the log's map already.

    The position of a landmark in the log's map is wrong if two conditions are met. Its distance from the estimate
    exceeds ``TOLERANCE``. The squared Mahalanobis distance exceeds ``GATE``, with the covariances of both positions and
    of the alignment. Raises RunFailedError if nothing was estimated.
    """
    if not learnt and not extend:
        raise RunFailedError(
            f"{log.name}: odometry and observations determine the position of no landmark, so none was mapped"
        )
    given = log.world.landmarks
    common = [name for name in given if name in learnt]
    if extend:
        notes = not_located(log, {*learnt, *given})
        return _assemble(log, learnt, np.zeros(3), dict.fromkeys(given, "given"), keep=tuple(given), notes=notes)
    if not given:
        return _assemble(log, learnt, np.zeros(3), {}, notes=not_located(log, learnt))
    if len(common) < MIN_COMMON and not in_frame:
        few = "only {mapped} of the given map's landmarks were mapped, expected {least} or more"
        return _unjudged(log, learnt, notice("few_mapped", few + UNJUDGED, len(common), MIN_COMMON))
    points = [learnt[name] for name in common]
    targets = np.array([log.world.position(name) for name in common])
    surveys = np.array([given[name].spread() for name in common])
    alignment = IN_FRAME if in_frame else align_robustly(points, targets, surveys)
    if not in_frame and alignment.inliers < max(MIN_COMMON, len(common) / 2):
        few = "only {inliers} of {mapped} landmarks agree with the given map after the best alignment"
        return _unjudged(log, learnt, notice("few_inliers", few + UNJUDGED, alignment.inliers, len(common)))
    moved = {name: _moved(point, alignment) for name, point in learnt.items()}
    wrong = [n for n in common if _differ(moved[n], given[n])]
    verdicts = {name: _verdict(name, moved, given, wrong) for name in common}
    unseen = tuple(name for name in given if name not in learnt)
    verdicts |= dict.fromkeys(unseen, UNSEEN)
    notes = not_located(log, learnt)
    return _assemble(log, moved, alignment.pose, verdicts, keep=unseen, flagged=wrong, judged=True, notes=notes)


def align_robustly(points: list[LearntPoint], targets: Array, surveys: Array) -> Alignment:
    """Return the robust alignment of K estimated landmarks with the log's map. A minority of positions may be
    wrong. ``points``: the estimates. ``targets`` (K, 2), ``surveys`` (K, 2, 2): the positions in the log's map and
    their covariances. K must be at least ``MIN_COMMON``."""
    positions = np.array([p.position for p in points])
    covariances = np.array([p.covariance for p in points])
    count = len(points)

    def errors(pose: Array) -> tuple[Array, Array, Array]:
        """Return the errors (K, 2) of the landmarks at the alignment ``pose`` (3,). Also return the inverses (K, 2, 2)
        of their covariances, and their squared Mahalanobis distances (K,)."""
        turn = _rotation(pose)
        information = np.linalg.inv(turn @ covariances @ turn.T + surveys)
        error = se2.transform_from(pose, positions) - targets
        return error, information, np.einsum("ki,kij,kj->k", error, information, error)

    candidates = [se2.align_points(positions[pair], targets[pair]) for pair in _pairs(count)]
    half = max(MIN_COMMON, count // 2 + 1)
    median = min(np.partition(errors(pose)[2], half - 1)[half - 1] for pose in candidates)
    factor = float(np.clip(median / MEDIAN * (1.0 + 5.0 / (count - 2)) ** 2, *FACTORS))

    def cost(pose: Array) -> float:
        """Return the sum of squared errors of the alignment ``pose`` (3,). Each squared error counts as at most
        ``GATE``."""
        error, _, squared = errors(pose)
        tolerated = GATE * np.sum(error**2, axis=1) / TOLERANCE**2
        return float(np.minimum(np.minimum(squared / factor, tolerated), GATE).sum())

    pose = min(candidates, key=cost)
    for _ in range(MAX_ITERATIONS):
        error, information, squared = errors(pose)
        inliers = (squared < GATE * factor) | (np.hypot(error[:, 0], error[:, 1]) < TOLERANCE)
        jacobian = _by_alignment(pose, positions[inliers])
        weighted = np.einsum("kij,kil->kjl", jacobian, information[inliers])
        covariance = np.linalg.pinv(np.einsum("kjl,klm->jm", weighted, jacobian))
        step = -covariance @ np.einsum("kjl,kl->j", weighted, error[inliers])
        pose = pose + step
        if np.abs(step).max(initial=0.0) < CONVERGED:
            break
    agreeing = int(inliers.sum())
    factor = float(np.clip(squared[inliers].sum() / max(2 * agreeing - 3, 1), *FACTORS))
    return Alignment(pose, factor * covariance, agreeing, factor)


def _pairs(count: int) -> list[list[int]]:
    """Return all pairs of different indices below ``count``, or ``MAX_PAIRS`` random pairs if there are more."""
    if count * (count - 1) // 2 <= MAX_PAIRS:
        return [list(pair) for pair in combinations(range(count), 2)]
    rng = np.random.default_rng(0)
    return [rng.choice(count, 2, replace=False).tolist() for _ in range(MAX_PAIRS)]


def _moved(point: LearntPoint, alignment: Alignment) -> LearntPoint:
    """Return an estimated point, transformed to the frame of the log's map by ``alignment``. Its covariance includes
    that of the alignment."""
    turn = _rotation(alignment.pose)
    (jacobian,) = _by_alignment(alignment.pose, point.position[None])
    covariance = alignment.factor * turn @ point.covariance @ turn.T + jacobian @ alignment.covariance @ jacobian.T
    return LearntPoint(se2.transform_from(alignment.pose, point.position), (covariance + covariance.T) / 2.0)


def _rotation(pose: Array) -> Array:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array(((c, -s), (s, c)))


def _by_alignment(pose: Array, positions: Array) -> Array:
    """Return the Jacobians (K, 2, 3) of the transformed ``positions`` (K, 2) with respect to x, y and angle of the
    alignment ``pose``."""
    x, y = (se2.transform_from(pose, positions) - pose[:2]).T
    jacobian = np.zeros((len(positions), 2, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -y, x
    return jacobian


def _differ(point: LearntPoint, landmark: Landmark) -> bool:
    """Return True if the estimated position ``point`` and the position of ``landmark`` in the log's map differ
    significantly."""
    error = point.position - np.array((landmark.x, landmark.y))
    covariance = point.covariance + landmark.spread()
    return bool(np.hypot(*error) > TOLERANCE and error @ np.linalg.solve(covariance, error) > GATE)


def _verdict(name: str, learnt: Mapping[str, LearntPoint], given: Mapping[str, Landmark], wrong: list[str]) -> str:
    if name not in wrong:
        return "agrees"
    for candidate in wrong:
        if candidate != name and not (
            _differ(learnt[name], given[candidate]) or _differ(learnt[candidate], given[name])
        ):
            return f"swapped with {candidate}"
    offset = learnt[name].position - np.array((given[name].x, given[name].y))
    return f"moved by {np.hypot(*offset):.2f} m"


def _unjudged(log: Log, learnt: Mapping[str, LearntPoint], note: Notice) -> LandmarkMap:
    """Return a map of ``learnt`` landmarks in the frame of the run's start, without a comparison. ``note``: the reason
    why there is no comparison."""
    notes = [note, *not_located(log, learnt)]
    return _assemble(log, learnt, np.zeros(3), dict.fromkeys(log.world.landmarks, "not judged"), notes=notes)


def _assemble(
    log: Log,
    learnt: Mapping[str, LearntPoint],
    frame: Array,
    verdicts: Mapping[str, str],
    *,
    keep: tuple[str, ...] = (),
    flagged: Sequence[str] = (),
    judged: bool = False,
    notes: Sequence[Notice] = (),
) -> LandmarkMap:
    """Return the new map: first the landmarks of the log's map in their order, then the new ones by name.

    ``learnt``: estimates by name, in the frame of the new map. ``frame`` (3,): the pose of the run's frame in the new
    map's frame. ``verdicts``: the result of each landmark's comparison by name, "new" if missing. ``keep``: names of
    the landmarks that keep their position in the log's map. ``flagged``: names of the landmarks with a wrong position
    in it. ``judged``: True if the maps were compared. ``notes``: messages for the user.
    """
    entries, landmarks = [], {}
    sensors = [log.rig.of(BearingRangeSettings, name) for name in log.rig.names("bearing_range")]
    level = sensors[0].z if sensors else 0.0  # a landmark of unknown height gets the height of the sensor
    for name in (*log.world.landmarks, *sorted(set(learnt) - set(log.world.landmarks), key=_natural)):
        point = learnt.get(name)
        entries.append(Entry(name, log.world.position(name), point, verdicts.get(name, "new"), name in flagged))
        if name in keep:
            landmarks[name] = log.world.landmarks[name]
        elif point is not None:
            (xx, xy), (_, yy) = point.covariance.tolist()
            x, y = point.position.tolist()
            z = log.world.landmarks[name].z if name in log.world.landmarks else level
            landmarks[name] = Landmark.bounded(x=x, y=y, z=z, covariance=(xx, xy, yy))
    return LandmarkMap(World(name=f"{log.name}-map", landmarks=landmarks), tuple(entries), frame, judged, tuple(notes))


def _natural(name: str) -> tuple[int, str]:
    """Return a key to sort names: numbers first by value (10 after 9), then all other names."""
    return (int(name), "") if name.isdecimal() else (10**9, name)
