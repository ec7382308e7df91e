"""The keyframe rule: the times of the graph's pose variables (keyframes), and the keyframe of each measurement.

A measurement becomes a keyframe if the last keyframe is at least an interval older. The interval is the sensor's
``keyframe_every``, or longer if landmarks are estimated. A mapper of points may need a keyframe earlier (``is_due``). A
keyframe is also added :data:`LONGEST_INTERVAL` after the last one. All other measurements, including late ones, become
factors on the previous keyframe, with the odometry since that keyframe as an offset.

Some sensors, such as RFID readers, measure many times a second, each time with little information. Such a sensor
gathers: the observations on one keyframe are combined into a few factors, which enter the graph together with the next
keyframe. Until then these observations update only the newest pose, as in a filter.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import gtsam
import numpy as np

from factorgraph_loc.fusion.graph.batch import AtTheEnd
from factorgraph_loc.fusion.graph.graph import Addition, Graph, Guess, Keyframe, Node, TickAt
from factorgraph_loc.fusion.graph.isam import Incremental
from factorgraph_loc.fusion.graph.settings import GraphSettings
from factorgraph_loc.fusion.layout import on_pose
from factorgraph_loc.fusion.tracking import Tracking, laplace_evidence
from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.sensors.base import EarlierPose, Link, NewVariable, Observation, Sensor
from factorgraph_loc.sensors.motion import MOTION
from factors import se2
from factors.graph import VectorPriorFactor
from factors.motion import ChainState, Increment
from factors.se2 import Array

ITERATIONS_OF_GUESS = 1  # iterations of a correction of the newest pose before the graph is solved
MAPPING_KEYFRAME_INTERVAL = 0.5  # s; interval between keyframes if landmarks are estimated
LONGEST_INTERVAL = 1.0  # s; time after which a keyframe is added even without a measurement

Backend = AtTheEnd | Incremental  # solves the graph


class _KeyframeView:
    """Gives a sensor read access to the estimates while its measurement at one keyframe is processed.

    ``guess``: pose and covariance of the keyframe. ``offset``: the motion from the keyframe to the measurement, None
    for zero. ``newest``: True if the keyframe is the newest one.
    """

    localized = True

    def __init__(
        self,
        graph: Graph,
        backend: Backend,
        keyframe: Keyframe,
        guess: Guess,
        offset: Increment | None,
        *,
        newest: bool,
    ) -> None:
        self.graph, self.keyframe, self.offset, self.newest = graph, keyframe, offset, newest
        self.t, self.is_kept = keyframe.t, backend.is_kept
        self.pose, self.covariance = guess

    def value(self, name: str) -> Array | None:
        return self.graph.values[self.graph.keys[name]] if name in self.graph.keys else None

    def block_covariance(self, name: str) -> Array:
        return self.graph.covariances[self.graph.keys[name]]

    def joint(self) -> tuple[Array, Mapping[str, slice]]:
        return self.covariance, {}

    def poses_at(self, times: Array) -> Array:
        constants = self.graph.value(MOTION, np.zeros(0))
        return self.graph.motion.poses_at(self.keyframe.odometry, times, constants)

    def earlier(self, t: float) -> EarlierPose | None:
        graph = self.graph
        if not next(iter(graph.keyframes.values())).t <= t < self.t:
            return None
        keyframe = graph.keyframe_before(t)
        if keyframe is self.keyframe or not self.is_kept(keyframe.index):
            return None
        return EarlierPose(keyframe.t, graph.part_of_step(keyframe, t) if t > keyframe.t else None)


class Builder:
    """Builds a factor graph from measurements during a run. See the module docstring."""

    def __init__(self, graph: Graph, backend: Backend, search: Tracking, settings: GraphSettings) -> None:
        self._graph, self._backend, self._search, self._settings = graph, backend, search, settings
        graph.current, graph.is_open = backend.current, backend.is_open
        # observations on the newest keyframe that are collected, to be added to the graph as one factor
        self._waiting: list[Observation] = []
        self._gatherer: Sensor | None = None  # the sensor of the collected observations

    def is_due(self, t: float) -> bool:
        """Return True if the last keyframe is so old at ``t`` [s] that a new one is needed."""
        return t - self._graph.newest.t >= LONGEST_INTERVAL

    def pass_time(self, odometry: ChainState) -> None:
        """Process a time at which the run records the pose. ``odometry``: the integrated odometry at this time; its
        field ``t`` is the time."""
        graph, t = self._graph, odometry.t
        graph.t = max(graph.t, t)
        if self.is_due(t):
            self._add_keyframe(odometry, None)
        graph.ticks.append(TickAt(t, graph.keyframe_before(t).index, odometry))

    def take(self, m: Measurement, odometry: ChainState) -> bool:
        """Convert the measurement ``m`` to factors of the graph. ``odometry``: the integrated odometry at its time.
        Returns False if the measurement is ignored, because its keyframe is no longer in the solver."""
        graph, sensor = self._graph, self._graph.sensors[m.source]
        graph.t = max(graph.t, m.t)
        if self._needs_keyframe(m, sensor):
            self._add_keyframe(odometry, None if sensor.gathers else m)
            if not sensor.gathers:
                return True
        newest = graph.newest
        keyframe = newest if m.t >= newest.t else graph.keyframe_before(m.t)
        if keyframe is not newest and not graph.is_open(keyframe.index):
            return False
        offset = graph.since(keyframe, m.t) if m.t > keyframe.t else None
        guess = (graph.pose, graph.covariance) if keyframe is newest else None
        if sensor.gathers and guess is not None:
            self._gather_from(sensor, m, odometry, offset, guess)
            return True
        addition = Addition(self.gather())
        guess = self._see(keyframe, m, odometry, offset, guess, addition)
        if addition.nodes:
            self._backend.attach(keyframe, addition, guess)
        return True

    def _needs_keyframe(self, m: Measurement, sensor: Sensor) -> bool:
        """Return True if a new keyframe is needed at the time of the measurement ``m`` of ``sensor``."""
        since, interval = m.t - self._graph.newest.t, sensor.keyframe_every
        if not sensor.gathers and self._settings.landmarks != "known":
            interval = MAPPING_KEYFRAME_INTERVAL
        mapper = self._graph.mapper
        return since >= interval or (since > 0.0 and m.source == mapper.sensor and mapper.is_due(m))

    def gather(self) -> list[Node]:
        """Convert the collected observations to factors, add these to the newest keyframe, and return them."""
        nodes = self.waiting() if self._waiting else []
        self._graph.newest.nodes += nodes
        self._waiting = []
        return nodes

    def waiting(self) -> list[Node]:
        """Return the collected observations as factors of the newest keyframe, without adding these to the graph."""
        if self._gatherer is None:
            return []
        terms = self._gatherer.gathered(self._waiting)
        return [self._graph.node(self._graph.newest, term, self._gatherer.name) for term in terms]

    def clear(self) -> None:
        """Discard the collected observations. Call this when the estimator restarts at another pose."""
        self._waiting = []

    def _gather_from(
        self, sensor: Sensor, m: Measurement, odometry: ChainState, offset: Increment | None, guess: Guess
    ) -> None:
        """Correct the newest pose by the measurement ``m``. Its observations are collected until :meth:`gather`.
        ``odometry``: the integrated odometry at its time. ``offset``: the motion from the newest keyframe to this time,
        or None. ``guess``: the newest pose and its covariance."""
        graph = self._graph
        if self._gatherer is not sensor:
            nodes = self.gather()
            if nodes:
                self._backend.attach(graph.newest, Addition(nodes), guess)
                guess = graph.pose, graph.covariance
            self._gatherer = sensor
        view = _KeyframeView(graph, self._backend, graph.newest, guess, offset, newest=True)
        if self._observe(sensor, m, view, odometry, None):
            graph.newest.causal = graph.pose, graph.covariance = view.pose, view.covariance

    def _observe(
        self, sensor: Sensor, m: Measurement, view: _KeyframeView, odometry: ChainState, addition: Addition | None
    ) -> bool:
        """Convert the measurement ``m`` to observations, and add these to ``addition``, or collect them if it is None.
        ``odometry``: the integrated odometry at its time. On the newest keyframe, each observation also corrects the
        pose in ``view``. Returns True if any observation was accepted."""
        applied = False
        for observation in sensor.observe(m, view):
            if isinstance(observation, Link):
                if addition is not None:
                    self._add_link(observation, sensor, view.keyframe, addition)
                continue
            if isinstance(observation, NewVariable):
                if addition is not None:
                    self._add_block(observation, sensor, view, addition)
                continue
            alone = on_pose(observation, view)
            correction = alone.correct(view.pose, view.covariance, {}, {}, alone.iterations or ITERATIONS_OF_GUESS)
            if observation.is_judged and not sensor.judge(alone, correction, view):
                continue
            applied = True
            if addition is None:
                self._waiting.append(observation)
            else:
                for term in observation.terms:
                    addition.hang(view.keyframe, self._graph.node(view.keyframe, term, sensor.name))
            if view.newest:
                if observation.is_judged:
                    self._search.slips.add(alone.at_its_time, odometry, view, correction)
                self._search.expect(sensor, alone, odometry, view)
                evidence = partial(laplace_evidence, alone, view.pose, view.covariance, correction)
                self._search.keep(sensor, alone, odometry, evidence)
                view.pose = se2.moved(view.pose, correction.delta)
                view.covariance = correction.covariance[:3, :3]
        return applied

    def _add_keyframe(self, odometry: ChainState, m: Measurement | None) -> None:
        """Add a keyframe at the time of ``odometry``. ``m``: a measurement of this time, which becomes factors of the
        keyframe, or None."""
        graph, newest, t = self._graph, self._graph.newest, odometry.t
        keyframe = Keyframe(newest.index + 1, t, *graph.motion.travelled(newest.odometry, t))
        pose, covariance, _ = graph.moved(t)
        addition = Addition(self.gather())
        graph.append(keyframe)
        guess: Guess | None = (pose, covariance)
        if m is not None:
            guess = self._see(keyframe, m, odometry, None, guess, addition)
        assert guess is not None
        self._backend.extend(keyframe, addition, guess)

    def _see(
        self,
        keyframe: Keyframe,
        m: Measurement,
        odometry: ChainState,
        offset: Increment | None,
        guess: Guess | None,
        addition: Addition,
    ) -> Guess | None:
        """Convert a measurement to factors of ``keyframe``, and add these to ``addition``.

        ``odometry``: the integrated odometry at the time of the measurement. ``offset``: the motion from the keyframe
        to this time, or None. ``guess``: the predicted pose and covariance of the newest keyframe, None for an older
        one. Returns the corrected pose and covariance of the newest keyframe, None for an older one.
        """
        graph, sensor = self._graph, self._graph.sensors[m.source]
        expected = keyframe.causal if guess is None else guess
        assert expected is not None
        view = _KeyframeView(graph, self._backend, keyframe, expected, offset, newest=guess is not None)
        self._observe(sensor, m, view, odometry, addition)
        if guess is None:
            return None
        guess = view.pose, view.covariance
        if m.source == graph.mapper.sensor and keyframe is graph.newest and m.t == keyframe.t:
            guess = graph.mapper.take(m, keyframe, guess, graph, addition)
        return guess

    def _add_link(self, link: Link, sensor: Sensor, keyframe: Keyframe, addition: Addition) -> None:
        """Add to ``addition`` a factor between the pose of ``keyframe`` and an earlier pose (such as a loop closure).
        ``link``: the factor and the time of the earlier pose. If that pose is no longer in the solver, only the final
        optimisation uses the factor."""
        earlier = self._graph.keyframe_before(link.earlier)
        node = Node((keyframe.key, earlier.key), link.factor, link.rows, sensor=sensor.name)
        keyframe.nodes.append(node)
        if self._graph.is_open(earlier.index):
            addition.nodes.append(node)

    def _add_block(self, new: NewVariable, sensor: Sensor, view: _KeyframeView, addition: Addition) -> None:
        """Add to ``addition`` the landmark ``new``, and factors of its earlier observations by ``sensor``. If most of
        the observing poses are no longer in the solver, the landmark gets a prior instead. ``view``: the observing
        keyframe."""
        graph = self._graph
        key = graph.new_block(new, view.covariance)
        addition.values[key] = new.mean
        poses = [(graph.keyframe_before(t), t, observation) for t, observation in new.sightings]
        sighted = [(k, observation) for k, t, observation in poses if k.t <= t and graph.is_open(k.index)]
        if 2 * len(sighted) < len(poses) or not poses:
            noise = new.noise if not poses else graph.covariances[key]
            native = gtsam.PriorFactorVector(key, new.mean, gtsam.noiseModel.Gaussian.Covariance(noise))
            addition.hang(view.keyframe, Node((key,), VectorPriorFactor(new.mean, noise), len(new.mean), native))
            return
        for keyframe, observation in sighted:
            addition.hang(keyframe, *(graph.node(keyframe, term, sensor.name) for term in observation.terms))
