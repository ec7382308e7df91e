"""The monoSLAM filter: an EKF of a robot with wheels and one camera, and of the points that the camera observes.

The filter is described by Raoui, Bouyakhf and Devy (ICINCO 2011, section 5 and Algorithm 3), "the paper" below. It
derives from monoSLAM (Davison et al., 2007). The state of the robot has 13 values: position r^W and orientation q^WR of
the robot's frame R, its velocity v^W in the world frame, and its turn rate w^R. The error state of the robot has 12
values, because an orientation has three degrees of freedom. The points that are not in the map follow. The camera is
mounted on R by the rig's extrinsics, so R replaces the paper's camera frame.

Odometry replaces the paper's constant-velocity prediction of x, y and heading. Height, roll and pitch stay near those
of a robot on the floor. Map points are searched at their predicted pixels (:mod:`.monoslam_sighting`). Other points are
added to the state with an inverse depth (:mod:`.monoslam_map`). RFID measurements are ignored.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import Field

from factorgraph_loc.files.models import InUnit
from factorgraph_loc.fusion.filter import Filter, FilterSettings
from factorgraph_loc.model.belief import Learnt, LearntPoint, PoseEstimate, PosePrior
from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.model.setup import MapUse, Setup
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.camera.measurement import CAMERAS, Pixels
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.slam.monoslam_invariance import carried
from factorgraph_loc.slam.monoslam_map import counted, pruned, settled, with_point
from factorgraph_loc.slam.monoslam_motion import (
    ROBOT,
    UPRIGHT,
    Origin,
    RobotState,
    Step,
    about_z,
    measured,
    on_the_floor,
    seen_from_above,
    standstill,
)
from factorgraph_loc.slam.monoslam_sighting import FeatureMatcher, Match
from factorgraph_loc.slam.monoslam_state import (
    POSE,
    Eye,
    Innovation,
    MapPoint,
    SlamState,
    of_mounting,
    squared,
    starting,
    widened,
    with_floor,
)
from factorgraph_loc.vision.consensus import CameraPose
from factorgraph_loc.vision.relocalization import LARGEST_HEIGHT, LARGEST_TILT
from factors import positive, se2
from factors.camera.model import PLANAR, TiltScale, carrier
from factors.robust import huber_weight
from factors.se2 import Array

SETTLED = 1e-3  # m, rad: step of the iterated update below which it has converged
RECENT = 5.0  # s: a point in the state that was not observed for this time may be occluded
LOST_AFTER = 5  # consecutive images without a match, after which the filter is lost
SCALE = "scale_distance"  # the name of the odometry's constant that scales distances
LARGEST_SIGMA = 0.5  # m, rad: standard deviations beyond which the pose is unknown


@dataclass(frozen=True)
class UpdateRecord:
    """The state of the robot after an update of the filter. The final trajectory is made from these records.

    ``t`` [s]: the time of the update. ``step``: the prediction from the previous record to this one. ``robot``: the
    state of the robot. ``constants`` (P,): the estimated corrections of the odometry's constants. ``covariance`` (12 +
    P, 12 + P): the covariance of the errors of ``robot`` and ``constants``. ``relocalized``: True if the pose comes
    from the image alone and is independent of the previous record.
    """

    t: float
    step: Step
    robot: RobotState
    constants: Array
    covariance: Array
    relocalized: bool = False


def smoothed(records: Sequence[UpdateRecord]) -> list[UpdateRecord]:
    """Return each record smoothed with all later records (Rauch, Tung, Striebel, 1965). Velocity and turn rate are not
    smoothed."""
    results = list(records[-1:])
    for next_record, record in zip(records[:0:-1], records[-2::-1], strict=True):
        results.append(record if next_record.relocalized else _smoothed(record, next_record, results[-1]))
    return results[::-1]


def _smoothed(record: UpdateRecord, next_record: UpdateRecord, later: UpdateRecord) -> UpdateRecord:
    """Return ``record``, smoothed with the next record. ``later``: the smoothed ``next_record``."""
    total, known = len(record.covariance), next_record.step.transition.shape[1]
    transition = np.zeros((POSE, total))
    transition[:, :known] = next_record.step.transition[:POSE]
    kept = np.r_[0:POSE, ROBOT:total]
    block = np.ix_(kept, kept)
    error = np.concatenate((later.robot.minus(next_record.step.robot), later.constants - record.constants))
    motion = transition[:, kept], next_record.step.noise[:POSE, :POSE]
    change, covariance = np.zeros(total), record.covariance.copy()
    change[kept], covariance[block] = positive.smoothed(
        record.covariance[block], *motion, error[kept], later.covariance[block]
    )
    robot, constants = record.robot.plus(change[:ROBOT]), record.constants + change[ROBOT:]
    return replace(record, robot=robot, constants=constants, covariance=covariance, relocalized=False)


class MonoslamSettings(FilterSettings):
    """Settings of the monoSLAM filter.

    If the filter estimates points, its update is never iterated, because iterations would make the filter inconsistent.
    Its final trajectory is then the causal one, without smoothing.
    """

    height_sigma: Annotated[float, Field(ge=1e-5, le=1.0), InUnit("m")] = 0.005
    """standard deviation of the height of a robot on a floor"""
    tilt_sigma: Annotated[float, Field(ge=1e-5, le=0.5), InUnit("rad")] = 0.005
    """standard deviation of roll and pitch of a robot on a floor"""
    landmarks: MapUse = "known"
    """known: use only points of the map; extended: estimate other points too; unknown: estimate all points, the default
    without a map"""
    self_calibration: bool = True
    """whether constants of the odometry with an uncertainty in the rig are estimated"""
    max_points: Annotated[int, Field(ge=1, le=1000)] = 100
    """largest number of points in the state"""
    per_image: Annotated[int, Field(ge=1, le=1000)] = 20
    """new points are added if an image should show fewer estimated points than this"""
    iterations: Annotated[int, Field(ge=1, le=20)] = 3
    """largest number of linearizations of an update in a known map"""


class Monoslam(Filter):
    """The monoSLAM filter: it localizes a robot with wheels and one camera, and can map points during the run."""

    modalities = frozenset({"camera"})
    estimates_points = True
    _state: SlamState

    def __init__(self, setup: Setup, settings: MonoslamSettings) -> None:
        super().__init__(setup, settings)
        self._settings = settings
        self.supports_unknown_start = settings.landmarks == "known"
        self._matcher = FeatureMatcher(setup, self.diagnostics, settings.landmarks)
        self._constants = self._motion.constants
        camera = setup.rig.find(CameraSettings) if any(name in setup.sensors for name in CAMERAS) else None
        self._scale = self._constants.names.index(SCALE) if SCALE in self._constants.names else None
        self._mounting = np.zeros((6, 6)) if camera is None else of_mounting(camera)
        self._step: Step | None = None
        self._relocalized = False
        # Without a map the start is unobservable. In the state, changes of the linearization point would reduce its
        # covariance (Huang, Mourikis, Roumeliotis, International Journal of Robotics Research 29(5), 2010).
        self._origin: Origin | None = None

    def initialize(self, prior: PosePrior) -> None:
        """Start from the Gaussian ``prior``, or at the first image that determines the pose if it has no heading."""
        if prior.has_heading:
            super().initialize(prior)
        else:
            self._wait(prior.t)

    def learnt(self) -> Learnt:
        """Return the estimated constants of the odometry, and x and y of the points that the filter estimates. Points
        of unknown depth are left out."""
        state: SlamState | None = self._state
        if state is None:
            return Learnt()
        sigmas = np.sqrt(np.diag(state.covariance)[ROBOT : state.base])
        constants = zip(state.constants.tolist(), sigmas.tolist(), strict=True)
        values = dict(zip(self._constants.names, constants, strict=True))
        points = {}
        for point, start in zip(state.points, state.starts().tolist(), strict=True):
            if not point.ray:
                part = slice(state.base + start, state.base + start + 3)
                position, covariance = state.values[start : start + 3], state.covariance[part, part]
                if self._origin is not None:
                    covariance = covariance + self._origin.of_point(position)
                points[point.name] = LearntPoint(position[:2], covariance[:2, :2])
        return Learnt(values, points)

    def trajectory(self) -> Trajectory:
        """Return the planar poses at the times at which the run recorded the pose. In a known map they are smoothed
        with later images, unless ``smooth`` is off. If points are estimated, they are not smoothed."""
        is_known = self._settings.landmarks == "known"
        records = smoothed(self._records) if self._smooth and is_known else self._records
        ticks = np.unique(np.array(self._ticks))
        chosen = [records[i] for i in np.searchsorted([r.t for r in records], ticks, side="right") - 1]
        planar_poses = [seen_from_above(r.robot, self._pose_covariance(r.robot, r.covariance)) for r in chosen]
        poses, covariances = np.array([p for p, _ in planar_poses]), np.array([c for _, c in planar_poses])
        return Trajectory(ticks, poses.reshape(-1, 3), covariances.reshape(-1, 3, 3))

    def _start(self, prior: PosePrior) -> SlamState:
        s = self._settings
        covariance = starting(self._constants.sigmas)
        position, rotation = np.array((*prior.pose[:2], 0.0)), about_z(float(prior.pose[2]))
        covariance[np.ix_(PLANAR, PLANAR)] = se2.world_to_body(prior.pose, prior.covariance)
        covariance[UPRIGHT, UPRIGHT] = np.square((s.tilt_sigma, s.tilt_sigma, s.height_sigma))
        robot = RobotState(position, rotation, np.zeros(3), np.zeros(3))
        if s.landmarks == "unknown":
            pose = covariance[:6, :6].copy()
            covariance[PLANAR], covariance[:, PLANAR] = 0.0, 0.0
            pose[UPRIGHT], pose[:, UPRIGHT] = 0.0, 0.0
            self._origin = Origin(robot, pose)
        floor = TiltScale.guessed(s.tilt_sigma) if s.landmarks != "known" else None
        return SlamState(robot, np.zeros(len(self._constants.names)), covariance, floor=floor)

    def _seek(self, m: Pixels) -> SlamState | None:
        eye = self._matcher.eye
        camera = None if eye is None else self._matcher.relocated(m, eye)
        if eye is None or camera is None:
            return None
        sigmas = self._constants.sigmas
        nowhere = RobotState(np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
        return self._standing(camera, eye, SlamState(nowhere, np.zeros(len(sigmas)), starting(sigmas)))

    def _predict(self, t: float) -> None:
        self._odometry, increment = self._motion.travelled(self._odometry, t)
        s, robot, dt = self._settings, self._state.robot, increment.duration
        delta, by_constants = self._motion.changed(increment, self._state.constants)
        step = measured(robot, delta, increment.covariance, by_constants, dt)
        self._step = on_the_floor(step, dt, s.height_sigma, *self._state.sway(s.tilt_sigma))
        self._state = self._state.moved(self._step)

    def _uses(self, m: Measurement) -> bool:
        return m.modality in self.modalities

    def _see(self, m: Pixels) -> None:
        eye = self._matcher.eye
        if eye is None:
            self.diagnostics.ignore("camera", len(m.pixels))
            return
        state, match = self._match(m, self._state, eye)
        state, self._relocalized = self._relocated(m, state, eye, match)
        if len(match.pixels) and not self._relocalized and not self._is_vague(state):
            state = self._corrected(m, state, eye, match)
        if not self._relocalized and self._settings.landmarks != "known":
            state = self._managed(m, state, eye, match)
        self._state = replace(state, image_odometry=self._odometry)

    def _match(self, m: Pixels, state: SlamState, eye: Eye) -> tuple[SlamState, Match]:
        """Return the predicted state, and the matches of the pixels of ``m`` with points. If points are estimated, and
        the image shows that the wheels slipped, the returned state has a larger covariance than ``state``. ``eye``: the
        camera."""
        if self._settings.landmarks == "known" or state.image_odometry is None:
            return state, self._matcher.match(m, state, eye)
        slip = self._motion.slip(self._motion.relative(state.image_odometry, self._odometry))
        return self._matcher.unless_slipped(m, state, eye, *slip)

    def _corrected(self, m: Pixels, prior: SlamState, eye: Eye, match: Match) -> SlamState:
        """Return the state after a Kalman update of ``prior`` with the matched pixels ``match``. ``eye``: the camera.
        In a known map, the update is iterated with Huber weights. The noise of pixels far from their prediction is
        increased."""
        known = match.mapped, match.points, match.covariances
        zero = np.zeros(len(prior.covariance))
        sights = eye.all(prior, *known)
        innovation = Innovation.of(sights, prior.covariance)
        residual = match.pixels - sights.pixels
        noise = widened(sights.noise, residual, innovation)
        self._report(m, match, residual, innovation, sights.noise)
        tempering = np.ones(len(residual))
        tempering[len(match.mapped) :] = match.tempering
        delta, root, gain = zero, np.empty(0), np.empty(0)
        for i in range(self._settings.iterations if self._settings.landmarks == "known" else 1):
            if i:
                moved = prior.plus(delta, prior.covariance)
                sights = eye.all(moved, *known)
                innovation = Innovation.of(sights, prior.covariance)
                residual = match.pixels - sights.pixels
                weight = huber_weight(squared(residual, sights.noise), eye.model.robust)
                noise = sights.noise * (1.0 / weight)[:, None, None]
            root, gain = innovation.gain(noise / tempering[:, None, None])
            whitened = np.linalg.solve(root, residual.ravel() + innovation.jacobian @ delta[innovation.columns])
            last_delta, delta = delta, gain.T @ whitened
            if np.abs((delta - last_delta)[:6]).max() < SETTLED:
                break
        posterior = prior.plus(delta, prior.covariance - gain.T @ gain)
        if self._settings.landmarks == "known":
            return posterior
        return replace(with_floor(prior, posterior, self._t), covariance=carried(prior, posterior, self._scale))

    def _report(self, m: Pixels, match: Match, residual: Array, innovation: Innovation, noise: Array) -> None:
        whitened = np.linalg.solve(innovation.root(noise), residual.ravel())
        self.diagnostics.innovation("camera", m.t, float(whitened @ whitened), len(whitened))
        for i, name in enumerate("uv"):
            self.diagnostics.add_residuals(f"camera.{name}", residual[:, i].tolist())

    def _relocated(self, m: Pixels, state: SlamState, eye: Eye, match: Match) -> tuple[SlamState, bool]:
        """Return a state, and True if it was relocalized in the whole map. Otherwise return ``state`` and False.
        Relocalization is tried if several images had no matches, or if the pose is very uncertain. A relocalized state
        has no estimated points, because these belong to the old pose. ``eye``: the camera. ``match``: the matches of
        the image."""
        lost = state.lost + 1 if match.wanted and not len(match.pixels) else 0
        camera = self._matcher.relocated(m, eye) if lost >= LOST_AFTER or self._is_vague(state) else None
        relocated = None if camera is None else self._standing(camera, eye, state)
        if relocated is None:
            return replace(state, lost=lost), False
        self.diagnostics.event(m.t, "relocalized", "camera: found its place in the map")
        return relocated, True

    def _is_vague(self, state: SlamState) -> bool:
        """Return True if the map is known, and the pose is too uncertain for a Kalman update, which linearises."""
        return self._settings.landmarks == "known" and bool(np.diag(state.covariance)[:6].max() > LARGEST_SIGMA**2)

    def _standing(self, camera: CameraPose, eye: Eye, lost_state: SlamState) -> SlamState | None:
        """Return the state of a robot with a relocalized ``camera`` pose. Returns None if this robot would not stand
        level on the floor. ``lost_state``: the state before, which supplies the odometry's constants. ``eye``: the
        camera."""
        s = self._settings
        position, rotation = carrier(eye.model, camera.position, camera.rotation)
        robot = RobotState(position, rotation, np.zeros(3), np.zeros(3))
        covariance = starting(np.zeros(len(lost_state.constants)))
        covariance[ROBOT:, ROBOT:] = lost_state.covariance[ROBOT : lost_state.base, ROBOT : lost_state.base]
        back = np.linalg.inv(eye.lift)
        covariance[:6, :6] = back @ camera.covariance @ back.T
        if abs(position[2]) > LARGEST_HEIGHT or rotation[2, 2] < math.cos(LARGEST_TILT):
            return None
        covariance[UPRIGHT, UPRIGHT] += np.square((s.tilt_sigma, s.tilt_sigma, s.height_sigma))
        return SlamState(robot, lost_state.constants, covariance, floor=lost_state.floor)

    def _managed(self, m: Pixels, state: SlamState, eye: Eye, match: Match) -> SlamState:
        """Return ``state`` with updated points after the image ``m`` with the matches ``match``. Matches are counted,
        bad points are deleted, and new points are added. Points of known depth are converted to x, y, z. ``eye``: the
        camera."""
        state = counted(state, match.expected, frozenset(match.mapped), m.t)
        frame = m.frame
        wanted = min(self._settings.per_image, self._settings.max_points)
        room = max(0, wanted - self._matcher.in_view(state, eye, since=m.t - RECENT))
        for row in self._matcher.new(m, state, eye, match, state.tracks)[:room]:
            name = f"met{state.met}" if m.names is None else m.names[row]
            descriptor = None if frame is None else frame.descriptors[row]
            grown = with_point(state, MapPoint(name, True, descriptor, m.t), eye, m.pixels[row])
            state = replace(grown, met=state.met + 1)
        state, failed = pruned(state, self._settings.max_points)
        if failed:
            self.diagnostics.reject("camera: points that were not found again", failed)
        state = settled(state, eye)
        tracks = frozenset() if frame is None else frozenset(frame.tracks.tolist())
        return replace(state, tracks=tracks)

    def _estimate(self) -> PoseEstimate:
        robot = self._state.robot
        pose, covariance = seen_from_above(robot, self._pose_covariance(robot, self._state.covariance))
        return PoseEstimate(self._t, pose, covariance, "localized")

    def _pose_covariance(self, robot: RobotState, covariance: Array) -> Array:
        """Return the covariance (6, 6) of the pose in ``robot``. It includes the uncertainty of the camera's mounting
        or, if the map is unknown, of the start pose. ``covariance``: of the error state."""
        return covariance[:6, :6] + (self._mounting if self._origin is None else self._origin.of_pose(robot))

    def _record(self) -> UpdateRecord:
        s = self._state
        # there is no prediction since the last record if both measurements have the same time
        step = self._step or standstill(self._records[-1].robot if self._records else s.robot)
        self._step, relocalized, self._relocalized = None, self._relocalized, False
        return UpdateRecord(self._t, step, s.robot, s.constants, s.covariance[: s.base, : s.base].copy(), relocalized)
