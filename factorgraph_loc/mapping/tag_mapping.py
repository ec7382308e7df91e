"""Maps of RFID tags from a log, and their comparison with a given map.

The robot poses are those of the log's reference, or they are estimated together with the tags from odometry and reads.
The map is written in the survey frame, which the section ``[survey]`` of the log's rig transforms to the world frame.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from factorgraph_loc.errors import InputError, RunFailedError
from factorgraph_loc.mapping import mapping
from factorgraph_loc.mapping.mapping import LandmarkMap
from factorgraph_loc.mapping.tag_focusing import focused
from factorgraph_loc.mapping.tag_search import TagMode, TagPosterior, search
from factorgraph_loc.mapping.tag_slam import TagObservations, tag_observations, tag_slam
from factorgraph_loc.model.belief import EXACT_SIGMA, LearntPoint, PosePrior
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.landmarks.measurement import Landmark
from factorgraph_loc.sensors.rfid.map import Tag
from factorgraph_loc.sensors.rfid.settings import SurveySettings
from factorgraph_loc.text import Notice, notice
from factors import se2
from factors.se2 import Array

MAX_GAP = 0.5  # s: the reference is not interpolated between poses that are farther apart

Poses = Literal["reference", "odometry"]


@dataclass(frozen=True)
class MadeTags:
    """A new map of tags, and its comparison with the map of the log.

    ``world``: the map as written to a file, in the survey frame (rig section ``[survey]``). ``made``: the same tags as
    landmarks in the world frame, with the comparison. ``poses`` (N, 3): the trajectory in the world frame. ``open``:
    the reason why a tag was not located, by EPC. ``modes``: candidate positions of ambiguous tags in the world frame,
    by EPC.
    """

    world: World
    made: LandmarkMap
    poses: Array
    open: Mapping[str, Notice]
    modes: Mapping[str, tuple[TagMode, ...]]

    @property
    def rms(self) -> float | None:
        """The root mean square distance [m] between estimated tags and their positions in the log's map. None if there
        are none."""
        distances = [e.distance for e in self.made.entries if e.distance is not None and e.verdict != "given"]
        return float(np.sqrt(np.mean(np.square(distances)))) if distances and self.made.judged else None


def map_tags(
    log: Log,
    poses: Poses,
    prior: PosePrior | None,
    *,
    extend: bool = False,
    height: float | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> MadeTags:
    """Return a map of the tags that a log read.

    ``poses``: "reference" uses the poses of the log's reference, "odometry" estimates poses and tags together.
    ``prior``: the start pose for "odometry". If it is None, the first pose is the origin, and the directions of tags in
    the log's map are not used. ``extend``: True keeps the tags of the log's map and uses them to estimate the poses.
    False estimates all tags, and compares them with the log's map. ``height`` [m]: of tags that the map lacks; None
    uses the mean height of the antennas. ``progress``: a function that is called with the completed fraction, 0 to 1.

    Raises InputError if the log has no reads, no antennas in its rig or no suitable reference. Raises RunFailedError if
    no tag could be located.
    """
    observations = tag_observations(log, height)
    given = np.isfinite(observations.positions[:, 0])
    known = given if extend else np.zeros_like(given)
    if poses == "reference":
        learnt, facing, posteriors, path = _along_reference(log, observations)
        learnt = {tag: point for tag, point in learnt.items() if not known[tag]}
    else:
        if prior is None:
            if extend:
                raise InputError(
                    f"{log.name}: prior is None, expected the start pose in the map, to extend it with poses from odometry"
                )
            prior = PosePrior(log.span()[0], np.zeros(3), EXACT_SIGMA**2 * np.eye(3))
            observations = replace(observations, facing=np.full(len(given), np.nan))
        slam = tag_slam(log, observations, prior, known, progress)
        learnt = focused(log, observations, slam.tags, Trajectory(slam.t, slam.poses))
        facing, posteriors, path = slam.facing, slam.posteriors, slam.poses
    if not learnt and not extend:
        raise RunFailedError(f"{log.name}: no tag was read often enough, from different enough places, to be located")
    names = observations.names
    landmarks = {n: _as_landmark(log, n, p) for n, p, g in zip(names, observations.positions, given, strict=True) if g}
    stand_in = replace(log, world=World(landmarks=landmarks))
    by_name = {names[tag]: point for tag, point in learnt.items()}
    made = mapping.make_map(stand_in, by_name, extend=extend, in_frame=poses == "reference")
    turned = facing + made.frame[2]
    same = poses == "reference" or made.judged or extend
    world = _world(log, observations, made, {names[tag]: float(turned[tag]) for tag in learnt}, in_given_frame=same)
    why = {
        name: _why(posterior, int(observations.hits[:, i].sum()))
        for i, (name, posterior) in enumerate(zip(names, posteriors, strict=True))
        if i not in learnt and not known[i]
    }
    doubtful = {
        n: tuple(replace(m, position=se2.transform_from(made.frame, m.position)) for m in posterior.modes)
        for n, posterior in zip(names, posteriors, strict=True)
        if n in why and posterior.is_explained and posterior.is_ambiguous
    }
    return MadeTags(world, made, se2.compose(made.frame, path), why, doubtful)


def _along_reference(
    log: Log, observations: TagObservations
) -> tuple[dict[int, LearntPoint], Array, list[TagPosterior], Array]:
    """Return (positions, directions, posteriors, poses) of T tags. ``positions``: of the located tags, by index.
    ``directions`` (T,) [rad]: of the tags' fronts, NaN if unknown. ``posteriors``: the search results of all tags.
    ``poses`` (K, 3): the robot poses, by the log's reference, at the antenna observations."""
    if log.reference is None:
        raise InputError(f"{log.name}: has no reference: map its tags with --poses odometry")
    if not log.reference.has_heading:
        raise InputError(f"{log.name}: its reference has no headings: map its tags with --poses odometry")
    at = log.reference.at(observations.t, max_gap=MAX_GAP)
    which = np.asarray(np.isfinite(at).all(axis=1))
    if not which.any():
        raise InputError(
            f"{log.name}: its reference has no pose at the time of any read: map its tags with --poses odometry"
        )
    posteriors = search(
        observations.model, observations.along(at[which], which), observations.heights, observations.facing
    )
    learnt = {
        tag: LearntPoint(posterior.modes[0].position, posterior.modes[0].covariance)
        for tag, posterior in enumerate(posteriors)
        if posterior.is_located
    }
    learnt = focused(log, observations, learnt)
    facing = observations.facing.copy()
    for tag in learnt:
        if np.isnan(facing[tag]):
            facing[tag] = posteriors[tag].modes[0].facing
    return learnt, facing, posteriors, at[which]


def _why(posterior: TagPosterior, reads: int) -> Notice:
    """Return the reason why a tag is not in the map. The kinds of reasons are "unread", "chance" (false reads),
    "ambiguous" and "uncertain". ``reads``: the number of reads of the tag."""
    if not reads:
        return notice("unread", "never read")
    count = f"read {reads} times" if reads > 1 else "read once"
    if not posterior.is_explained:
        return notice("chance", "{reads}: no position explains the reads significantly better than chance", count)
    if posterior.is_ambiguous:
        places = [f"({m.position[0]:.2f}, {m.position[1]:.2f}) m with {m.weight:.0%}" for m in posterior.modes[:3]]
        return notice("ambiguous", "{reads}: ambiguous, {places}", count, " or ".join(places))
    return notice("uncertain", "{reads}: too uncertain, sigma {sigma:.1f} m", count, posterior.modes[0].sigma)


def _as_landmark(log: Log, name: str, position: Array) -> Landmark:
    """Return the tag ``name`` of the log's map as a landmark in the world frame. ``position`` (2,): its position in
    this frame."""
    tag = log.world.tags[name]
    x, y = position.tolist()
    if tag.covariance is None:
        return Landmark.bounded(x=x, y=y, sigma=tag.sigma)
    xx, xy, yy = tag.covariance
    return Landmark.bounded(
        x=x, y=y, covariance=_turned(np.array(((xx, xy), (xy, yy))), float(log.rig.of(SurveySettings).heading))
    )


def _turned(covariance: Array, angle: float) -> tuple[float, float, float]:
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array(((c, -s), (s, c)))
    (xx, xy), (_, yy) = (turn @ covariance @ turn.T).tolist()
    return xx, xy, yy


def _world(
    log: Log, observations: TagObservations, made: LandmarkMap, facing: Mapping[str, float], *, in_given_frame: bool
) -> World:
    """Return the map as written to a file. Estimated tags are in the survey frame (rig section ``[survey]``), other
    tags of the log's map are unchanged.

    ``made``: the map in the world frame. ``facing``: by EPC, the direction [rad] of an estimated tag's front in the
    world frame. ``in_given_frame``: True if the new map has the frame of the log's map.
    """
    survey: SurveySettings = log.rig.of(SurveySettings)
    transform = survey.transform()
    tags: dict[str, Tag] = {}
    for i, name in enumerate(observations.names):
        landmark = made.world.landmarks.get(name)
        if landmark is None:
            continue
        if name not in facing:
            tags[name] = log.world.tags[name]
            continue
        x, y = se2.transform_to(transform, np.array((landmark.x, landmark.y))).tolist()
        covariance = _turned(landmark.spread(), -float(transform[2]))
        direction = facing[name] - float(transform[2])
        given = log.world.tags.get(name)
        if np.isnan(direction) and given is not None and given.facing is not None and in_given_frame:
            direction = given.facing
        tags[name] = Tag.bounded(
            x=x,
            y=y,
            z=float(observations.heights[i]),
            facing=None if np.isnan(direction) else se2.wrap_scalar(direction),
            covariance=covariance,
        )
    # other parts of the log's map are valid in its frame only
    rest = log.world if in_given_frame else World()
    return rest.model_copy(update={"name": f"{log.name}-map", "tags": tags, "points": None})
