"""Turns measurements into a graph: where keyframes stand, and what becomes a factor on them.

A keyframe stands at each stamp of a sensor, unless the one before is nearer than its interval, and at least every
``keyframe_max_interval``. What is seen between two keyframes, or arrives late, becomes a factor on the earlier one, displaced by
the odometry since.

Sensors that gather, as RFID readers do, come many times a second and each time tell little. Their observations from one keyframe to
the next make few factors, which enter the graph with the next keyframe; until then the newest pose is updated by them alone, as a
filter would.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Protocol

import gtsam
import numpy as np

from factorgraph_loc.fusion.graph.graph import Graph
from factorgraph_loc.fusion.graph.settings import GraphSettings
from factorgraph_loc.fusion.graph.variables import Addition, Guess, Keyframe, Node, TickAt
from factorgraph_loc.fusion.layout import MOTION
from factorgraph_loc.fusion.mapping import GraphView
from factorgraph_loc.fusion.search import Search, laplace_evidence
from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.sensors.base import EarlierPose, Link, NewVariable, Observation, Sensor
from factors import se2_kernels
from factors.graph import VectorPriorFactor
from factors.motion import ChainState, Increment
from factors.se2 import Array

ITERATIONS_OF_GUESS = 1
MAPPING_KEYFRAME_INTERVAL = 0.5  # s, where landmarks are estimated too


class Backend(Protocol):
    """What keeps a graph solved, or its guess; it brings pose and covariance of the newest keyframe up to date."""

    def extend(self, keyframe: Keyframe, addition: Addition, guess: Guess) -> None:
        """Take a new keyframe with the ``guess`` of its pose, and what came with it."""

    def attach(self, keyframe: Keyframe, addition: Addition, guess: Guess | None) -> None:
        """Take what was added to a keyframe that is in the graph. ``guess``: pose and covariance of the newest keyframe after the
        update, where it is that."""

    def current(self, key: int) -> Array:
        """The newest estimate of a variable that is in the graph."""

    def is_open(self, keyframe: int) -> bool:
        """Whether factors may still be added to a keyframe."""

    def is_kept(self, keyframe: int) -> bool:
        """Whether a keyframe is part of the final problem."""


class _KeyframeView:
    """What sensors see of the graph: the estimate ``pose`` and ``covariance`` of one keyframe."""

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

    def spread(self, name: str) -> Array:
        return self.graph.spreads[self.graph.keys[name]]

    def joint(self) -> tuple[Array, Mapping[str, slice]]:
        return self.covariance, {}

    def poses_at(self, times: Array) -> Array:
        constants = self.graph.value(MOTION, np.zeros(0))
        return self.graph.motion.poses_at(self.keyframe.odometry, times, constants)

    def earlier(self, t: float) -> EarlierPose | None:
        graph = self.graph
        if not next(iter(graph.keyframes.values())).t <= t < self.t:
            return None
        before = graph.before(t)
        if before is self.keyframe or not self.is_kept(before.index):
            return None
        return EarlierPose(before.t, graph.part_of_step(before, t) if t > before.t else None)

    def on_pose(self, observation: Observation) -> Observation:
        """An observation of the pose alone, with its blocks where they are estimated to be."""
        values, spreads = {}, {}
        for name in observation.blocks:
            key = self.graph.keys[name]
            values[name], spreads[name] = self.graph.values[key], self.graph.spreads[key]
        return observation.on_pose(values, spreads)


class Builder:
    """Builds a graph as measurements come; see the module."""

    def __init__(self, graph: Graph, backend: Backend, search: Search, settings: GraphSettings) -> None:
        self._graph, self._backend, self._search, self._settings = graph, backend, search, settings
        self._waiting: list[Observation] = []  # on the newest keyframe
        self._gatherer: Sensor | None = None  # whose they are

    def pass_time(self, odometry: ChainState) -> None:
        """A tick, with the ``odometry`` there."""
        graph, t = self._graph, odometry.t
        graph.t = max(graph.t, t)
        if t - graph.newest.t >= self._settings.keyframe_max_interval:
            self._add_keyframe(odometry, None)
        graph.ticks.append(TickAt(t, graph.before(t).index, odometry))

    def take(self, m: Measurement, odometry: ChainState) -> bool:
        """Take a measurement, with the ``odometry`` at its time; False where it is too late."""
        graph, sensor = self._graph, self._graph.sensors[m.modality]
        graph.t, newest = max(graph.t, m.t), graph.newest
        if m.t - newest.t >= self._interval(sensor) or (m.t > newest.t and self._is_due(m)):
            self._add_keyframe(odometry, None if sensor.gathers else m)
            if not sensor.gathers:
                return True
            newest = graph.newest
        before = newest if m.t >= newest.t else graph.before(m.t)
        if before is not newest and not self._backend.is_open(before.index):
            return False
        offset = graph.since(before, m.t) if m.t > before.t else None
        if sensor.gathers and before is newest:
            self._gather_from(sensor, m, odometry, offset)
            return True
        addition = Addition(self.gather())
        guess = (graph.pose, graph.covariance) if before is newest else None
        guess = self._see(before, m, odometry, offset, guess, addition)
        if addition.nodes:
            self._backend.attach(before, addition, guess)
        return True

    def _is_due(self, m: Measurement) -> bool:
        """Whether a mapper needs a keyframe at a measurement."""
        return any(mapper.is_due(m) for mapper in self._graph.mappers) if self._graph.mappers else False

    def gather(self) -> list[Node]:
        """What waits on the newest keyframe becomes factors of it."""
        nodes = self.waiting() if self._waiting else []
        self._graph.newest.nodes += nodes
        self._waiting = []
        return nodes

    def waiting(self) -> list[Node]:
        """What waits on the newest keyframe and is in no graph yet, as factors."""
        if self._gatherer is None:
            return []
        terms = self._gatherer.gathered(self._waiting)
        return [self._graph.node(self._graph.newest, term, self._gatherer.modality) for term in terms]

    def clear(self) -> None:
        """A new track begins: nothing waits."""
        self._waiting = []

    def _interval(self, sensor: Sensor) -> float:
        """How far [s] keyframes for a sensor are apart."""
        if sensor.gathers:
            return sensor.keyframe_every
        if self._settings.keyframe_interval is not None:
            return self._settings.keyframe_interval
        return sensor.keyframe_every if self._settings.landmarks == "known" else MAPPING_KEYFRAME_INTERVAL

    def _gather_from(self, sensor: Sensor, m: Measurement, odometry: ChainState, offset: Increment | None) -> None:
        """Update the newest pose by the observations of a sensor, which wait from now on."""
        graph = self._graph
        if self._gatherer is not sensor:
            nodes = self.gather()
            if nodes:
                self._backend.attach(graph.newest, Addition(nodes), (graph.pose, graph.covariance))
            self._gatherer = sensor
        guess = graph.pose, graph.covariance
        view = _KeyframeView(graph, self._backend, graph.newest, guess, offset, newest=True)
        for seen in sensor.observe(m, view):
            if isinstance(seen, NewVariable | Link):
                continue
            here = view.on_pose(seen)
            correction = here.correct(view.pose, view.covariance, {}, {}, here.iterations or ITERATIONS_OF_GUESS)
            if seen.is_judged and not sensor.judge(here, correction, view):
                continue
            evidence = partial(laplace_evidence, here, view.pose, view.covariance, correction)
            self._waiting.append(seen)
            view.pose, view.covariance = se2_kernels.moved(view.pose, correction.delta), correction.covariance
            graph.newest.causal = graph.pose, graph.covariance = view.pose, view.covariance
            self._search.keep(sensor, here, odometry, evidence)

    def _add_keyframe(self, odometry: ChainState, m: Measurement | None) -> None:
        graph, newest, t = self._graph, self._graph.newest, odometry.t
        keyframe = Keyframe(newest.index + 1, t, odometry, graph.motion.relative(newest.odometry, odometry))
        pose, covariance, _ = graph.moved(t)
        addition = Addition(self.gather())
        graph.append(keyframe)
        guess: Guess | None = (pose, covariance)
        if m is not None:
            guess = self._see(keyframe, m, odometry, None, guess, addition, is_new=True)
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
        *,
        is_new: bool = False,
    ) -> Guess | None:
        """Turn a measurement into factors of ``keyframe``; returned is the guess of its pose, updated by them.

        The guess is where the graph linearises first, and what the robust weights are computed at. Without one the keyframe is an
        older one: what is not yet in the graph stays out, and the innovation is that of its causal estimate.
        """
        graph, sensor = self._graph, self._graph.sensors[m.modality]
        expected = keyframe.causal if guess is None else guess
        assert expected is not None
        view = _KeyframeView(graph, self._backend, keyframe, expected, offset, newest=guess is not None)
        for seen in sensor.observe(m, view):
            if isinstance(seen, Link):
                self._add_link(seen, sensor, keyframe, addition)
                continue
            if isinstance(seen, NewVariable):
                self._add_block(seen, sensor, view, addition)
                continue
            here = view.on_pose(seen)
            correction = here.correct(view.pose, view.covariance, {}, {}, here.iterations or ITERATIONS_OF_GUESS)
            if seen.is_judged and not sensor.judge(here, correction, view):
                continue
            for term in seen.terms:
                addition.hang(keyframe, graph.node(keyframe, term, sensor.modality))
            if guess is not None:
                self._search.expect(sensor, here, odometry, view)
                evidence = partial(laplace_evidence, here, view.pose, view.covariance, correction)
                self._search.keep(sensor, here, odometry, evidence)
                view.pose = se2_kernels.moved(view.pose, correction.delta)
                view.covariance = correction.covariance[:3, :3]
        if guess is None:
            return None
        guess = view.pose, view.covariance
        for mapper in graph.mappers:
            if keyframe is graph.newest and m.t == keyframe.t:
                guess = mapper.take(m, keyframe, guess, self._graph_view(sensor), addition, is_new=is_new)
        return guess

    def _add_link(self, link: Link, sensor: Sensor, keyframe: Keyframe, addition: Addition) -> None:
        """A factor on a keyframe and an earlier one, which waits for the final problem if that has left the solver."""
        earlier = self._graph.before(link.earlier)
        node = Node((keyframe.key, earlier.key), link.factor, link.rows, sensor=sensor.modality)
        keyframe.nodes.append(node)
        if self._backend.is_open(earlier.index):
            addition.nodes.append(node)

    def _graph_view(self, sensor: Sensor) -> GraphView:
        graph, backend = self._graph, self._backend

        def between(first: Keyframe, last: Keyframe) -> Increment:
            return graph.recalibrated(graph.motion.relative(first.odometry, last.odometry))

        estimates = graph.values, graph.spreads, backend.current, backend.is_open
        key = graph.keys.get(sensor.modality)
        shared = () if key is None else (key,)
        constants = None if key is None else graph.values[key]
        motion = between, graph.motion.slip, graph.motion.twist
        return GraphView(graph.keyframes, *estimates, *motion, shared, constants)

    def _add_block(self, new: NewVariable, sensor: Sensor, view: _KeyframeView, addition: Addition) -> None:
        """A landmark comes into the graph, with the sightings that told it, or with its prior."""
        key = self._graph.new_block(new, view.covariance)
        addition.values[key] = new.mean
        if not new.sightings:
            native = gtsam.PriorFactorVector(key, new.mean, gtsam.noiseModel.Gaussian.Covariance(new.noise))
            addition.hang(view.keyframe, Node((key,), VectorPriorFactor(new.mean, new.noise), len(new.mean), native))
        for t, seen in new.sightings:
            keyframe = self._graph.before(t)
            if self._backend.is_open(keyframe.index):
                addition.hang(keyframe, *(self._graph.node(keyframe, term, sensor.modality) for term in seen.terms))
