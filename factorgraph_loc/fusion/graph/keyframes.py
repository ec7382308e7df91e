"""The keyframe rule: where poses of the graph are, and which of them each measurement belongs to.

A keyframe is added at a measurement that comes at least an interval after the last keyframe. The interval is the sensor's
``keyframe_every``, or longer where landmarks are estimated. A sensor that gathers always has its own. A mapper of points may need
a keyframe earlier (``is_due``), and at a tick one is added after :data:`LONGEST_INTERVAL`. Other measurements, late ones included,
become factors on the keyframe before them, displaced by the odometry since.

Sensors that gather, as RFID readers do, come many times a second, each time with little information. Their observations on one
keyframe become few factors, which enter the graph with the next keyframe. Until then the newest pose is updated by them alone, as
in a filter.
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

ITERATIONS_OF_GUESS = 1
MAPPING_KEYFRAME_INTERVAL = 0.5  # s, where landmarks are estimated too
LONGEST_INTERVAL = 1.0  # s between poses of the graph while measurements come

Backend = AtTheEnd | Incremental  # keeps the graph solved, or its guess


class _KeyframeView:
    """The graph as sensors read it: the estimate ``pose`` and ``covariance`` of one keyframe."""

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
    """Builds a graph as measurements come; see the module."""

    def __init__(self, graph: Graph, backend: Backend, search: Tracking, settings: GraphSettings) -> None:
        self._graph, self._backend, self._search, self._settings = graph, backend, search, settings
        graph.current, graph.is_open = backend.current, backend.is_open
        self._waiting: list[Observation] = []  # of a sensor that gathers, on the newest keyframe
        self._gatherer: Sensor | None = None  # that sensor

    def pass_time(self, odometry: ChainState) -> None:
        """A tick, with the ``odometry`` there."""
        graph, t = self._graph, odometry.t
        graph.t = max(graph.t, t)
        if t - graph.newest.t >= LONGEST_INTERVAL:
            self._add_keyframe(odometry, None)
        graph.ticks.append(TickAt(t, graph.keyframe_before(t).index, odometry))

    def take(self, m: Measurement, odometry: ChainState) -> bool:
        """Take a measurement, with the ``odometry`` at its time; False where it is too late."""
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
        """Whether a measurement is to have a keyframe at its time."""
        since, interval = m.t - self._graph.newest.t, sensor.keyframe_every
        if not sensor.gathers and self._settings.landmarks != "known":
            interval = MAPPING_KEYFRAME_INTERVAL
        mapper = self._graph.mapper
        return since >= interval or (since > 0.0 and m.source == mapper.sensor and mapper.is_due(m))

    def gather(self) -> list[Node]:
        """Turn the observations that wait on the newest keyframe into its factors."""
        nodes = self.waiting() if self._waiting else []
        self._graph.newest.nodes += nodes
        self._waiting = []
        return nodes

    def waiting(self) -> list[Node]:
        """Factors of the observations that wait on the newest keyframe and are in no graph yet."""
        if self._gatherer is None:
            return []
        terms = self._gatherer.gathered(self._waiting)
        return [self._graph.node(self._graph.newest, term, self._gatherer.name) for term in terms]

    def clear(self) -> None:
        """Discard the observations that wait, as a new track begins."""
        self._waiting = []

    def _gather_from(
        self, sensor: Sensor, m: Measurement, odometry: ChainState, offset: Increment | None, guess: Guess
    ) -> None:
        """Correct the ``guess`` of the newest pose by the observations of a sensor, and keep these until :meth:`gather`."""
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
        """Add the observations of a measurement to an ``addition``, or where that is None to those that wait; the estimate of the
        newest keyframe in the ``view`` is corrected by each. Returns whether any was applied."""
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
        """Turn a measurement into factors of ``keyframe``; returned is the guess of its pose, updated by them.

        The guess is where the graph linearises first, and what the robust weights are computed at. Without one the keyframe is an
        older one: what is not yet in the graph stays out, and the innovation is that of its causal estimate.
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
        """A factor on a keyframe and an earlier one, which waits for the final problem if that has left the solver."""
        earlier = self._graph.keyframe_before(link.earlier)
        node = Node((keyframe.key, earlier.key), link.factor, link.rows, sensor=sensor.name)
        keyframe.nodes.append(node)
        if self._graph.is_open(earlier.index):
            addition.nodes.append(node)

    def _add_block(self, new: NewVariable, sensor: Sensor, view: _KeyframeView, addition: Addition) -> None:
        """Add a landmark to the graph, with the sightings that determine it or with its prior. If the poses of most sightings have
        left the graph, its current estimate is the prior."""
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
