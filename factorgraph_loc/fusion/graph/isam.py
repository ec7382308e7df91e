"""A graph kept solved by iSAM2 (Kaess et al., IJRR 31(2), 2012), with its full history or with a window.

GTSAM's solvers are lost after any exception in an update, so everything that is in the graph is also kept beside them, and a solver
is rebuilt from that.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Collection, Iterable, Mapping, Sequence

import gtsam
import numpy as np

from factorgraph_loc.fusion.graph.graduation import best_optimum, settled
from factorgraph_loc.fusion.graph.graph import Graph
from factorgraph_loc.fusion.graph.graph_parts import Addition, Guess, Keyframe, SmootherSettings, jumps
from factorgraph_loc.fusion.graph.kept import Kept
from factorgraph_loc.fusion.graph.marginals import IndeterminateError, covariances
from factorgraph_loc.fusion.graph.solver import MARGIN, WITH_POINTS, FullHistory, Solver, Window, read_all
from factorgraph_loc.fusion.graph.stalled import Stalled
from factorgraph_loc.fusion.graph.summary import MarginalSummary, is_missing
from factorgraph_loc.fusion.graph.variables import (
    Node,
    Values,
    gtsam_errors,
    index_of,
    is_constant,
    is_landmark,
    is_of_keyframe,
    is_pose,
    tilt_key,
)
from factors import positive, se2
from factors.se2 import Array

NOWHERE: Mapping[int, Array] = {}
ITERATIONS_AFTER_FAILURE = 10
LAG = 10.0  # s of the window that causal estimates come from, where none is set
# m, rad: a window, whose oldest points are soon linearised for good, linearises anew what moves that far from where it saw points
NEAR_POINTS = 0.02
ROUNDING = 1e-6  # s; differences of times are as exact as that


class Incremental:
    """The backend of the smoother; see the module."""

    def __init__(self, graph: Graph, settings: SmootherSettings) -> None:
        self._graph, self._settings = graph, settings
        self._waits = settings.landmarks != "known"  # what is seen between keyframes: an update takes long then
        self._maps = any(mapper.estimates for mapper in graph.mappers)
        self._margin = WITH_POINTS if self._maps else MARGIN
        # whether the final trajectory is that of the whole problem; and the length of the window, None where all is in the solver
        self._is_whole = settings.lag is None or settings.lag == math.inf
        self._lag = None if settings.lag == math.inf else settings.lag
        links = any(sensor.links for sensor in graph.sensors.values())
        if settings.lag is None and not (self._waits or self._maps or links):
            self._lag = LAG
        # how long observations may wait for the solver
        every = max((sensor.solve_every for sensor in graph.sensors.values()), default=0.0)
        defers = not self._waits and (self._lag is None or self._lag >= 2.0 * every)
        self._solve_every = every if defers else 0.0
        self._failed: list[str] = []
        # Cholesky loses long stretches of dead reckoning as indeterminate; with points it takes half the time
        self._factorization = "CHOLESKY" if self._maps else "QR"
        self._solver = self._new_solver()
        self._stalled: Stalled | None = None  # the last one
        self._last = gtsam.Values()  # all estimates after the last update, where landmarks are estimated
        self._waiting = Addition()
        self._solved = -math.inf  # the time of the newest keyframe in the solver
        # of each keyframe: its causal estimate, and the final one where it has left the window
        self._filtered: Kept[Guess] = Kept()
        self._left: Kept[Guess] = Kept()

    def forget(self, before: float) -> None:
        """Forget keyframes before then, as far as they have left the window; where the whole problem is solved at the end, all are
        kept."""
        if self._is_whole:
            return
        graph = self._graph
        count = bisect.bisect_right(graph.times, before, graph.times.first) - 1
        # points that wait are looked for in the newest ones
        looked_back = 1 + max((mapper.horizon for mapper in graph.mappers), default=0)
        count = min(count, len(self._left), len(graph.keyframes) - looked_back)
        if count > graph.keyframes.first:
            count = min(count, self._solver.oldest)  # it may have to be built anew
        for kept in (graph.keyframes, graph.times, self._filtered, self._left):
            kept.forget(count)
        graph.ticks = [tick for tick in graph.ticks if tick.keyframe >= graph.keyframes.first]

    def final(self, graph: Graph) -> tuple[Array, Array]:
        """The whole graph, solved to the end. With a set lag: each pose as it left the window, the others as they are now; those
        that wait for the solver as they were expected."""
        waiting = self._waiting.values
        if not self._settings.smooth:
            estimates = list(self._filtered)
        elif self._is_whole:
            start = self.solved(graph)
            graph.drop_astray(graph.keyframes, start)
            return settled(graph, *best_optimum(graph, start, 1.0))
        else:
            stalled, open_ones = isinstance(self._solver, Stalled), graph.keyframes[len(self._left) :]
            try:
                known = [key for key in graph.values if not is_of_keyframe(key) and key not in waiting]
                for key in () if stalled else known:
                    graph.values[key], graph.spreads[key] = self._marginal(key, graph=graph)
                now = [
                    self._filtered[k.index] if stalled or k.key in waiting else self._marginal(k.key, graph=graph)
                    for k in open_ones
                ]
            except RuntimeError as error:
                raise graph.unsolved(error) from error
            estimates = [*self._left, *now]
        if self._waiting.nodes or len(graph.newest.nodes) > len(self._graph.newest.nodes):
            estimates[-1] = graph.pose, graph.covariance
        return np.array([p for p, _ in estimates]), np.array([c for _, c in estimates])

    def solved(self, graph: Graph) -> Values:
        """The newest estimates of all variables of a copy of the graph."""
        left = {k.key: guess[0] for k, guess in zip(graph.keyframes, self._left, strict=False)}
        known = self._waiting.values | left
        keys = [*(k.key for k in graph.keyframes), *graph.values]
        return known | {key: self._solver.value(key) for key in keys if key not in known}

    def begin(self, newest: Keyframe) -> None:
        """Solve the graph anew: it begins, or keyframes were taken back and ``newest`` was added."""
        del self._filtered[newest.index :]
        guess = self._graph.pose, self._graph.covariance
        self._filtered.append(guess)
        summary = self._solver.summary(failed=False)
        try:
            with gtsam_errors():
                summary = None if summary is None else summary.before(newest.index)
                self._graph.forget_landmarks(frozenset() if summary is None else summary.keys)
                self._start_again(newest, summary)
        except RuntimeError as error:
            if newest.index == 0:
                raise self._graph.unsolved(error) from error
            self._stall(newest, guess, summary, error)

    def guess_of(self, keyframe: int) -> Guess:
        """The causal estimate of a keyframe."""
        return self._filtered[keyframe]

    def extend(self, keyframe: Keyframe, addition: Addition, spread: Array) -> None:
        """Take a new keyframe and what came with it."""
        guess = addition.values[keyframe.key], spread
        self._filtered.append(guess)
        if keyframe.t < self._solved + self._solve_every:
            self._wait([self._odometry_node(keyframe), *addition.nodes], addition.values, guess)
            return
        self._update([self._odometry_node(keyframe), *addition.nodes], addition.values)

    def attach(self, keyframe: Keyframe, addition: Addition, guess: Guess | None) -> None:
        """Take what was added to a keyframe that is in the graph."""
        if guess is not None and (self._waits or keyframe.t < self._solved + self._solve_every):
            if self._waits:  # what its error has in common with that of landmarks only the graph knows
                guess = guess[0], self._graph.covariance
            self._wait(addition.nodes, addition.values, guess)
            return
        self._update(addition.nodes, addition.values)

    def _wait(self, nodes: Sequence[Node], values: Values, guess: Guess) -> None:
        """Keep what is to enter the solver with its next update; until then the newest pose is ``guess``."""
        self._waiting.nodes += nodes
        self._waiting.values |= values
        self._graph.pose, self._graph.covariance = guess

    def current(self, key: int) -> Array:
        """The newest estimate of a variable that is in the graph."""
        return self._solver.value(key)

    def refine(self, newest: Keyframe, guess: Guess) -> None:
        """Take pose and covariance of the newest keyframe from observations that are not yet in the graph."""
        self._filtered[newest.index] = guess

    def is_open(self, keyframe: int) -> bool:
        """Whether factors may still be added to a keyframe."""
        return max(0, len(self._left)) <= keyframe < len(self._graph.keyframes)

    def is_kept(self, keyframe: int) -> bool:
        """Whether a keyframe is part of the final problem."""
        return self._is_whole or self.is_open(keyframe)

    def _update(self, nodes: Sequence[Node], values: Values) -> None:
        newest = self._graph.keyframes[-1]
        nodes, values, self._waiting = [*self._waiting.nodes, *nodes], self._waiting.values | values, Addition()
        self._solved, guess = newest.t, self._filtered[newest.index]
        if isinstance(self._solver, Stalled) and newest.t < self._solver.until:
            self._graph.pose, self._graph.covariance = guess  # the next try takes in what keyframes and constants hold
            return
        self._leave(newest.t, values)
        try:
            with gtsam_errors():
                self._solver.update(nodes, values, newest.t)
                self._check_jump(newest, guess)
                touched = {key for node in nodes for key in node.keys if key in self._graph.values}
                self._read(newest, {key for key in touched if not is_of_keyframe(key) or self.is_open(index_of(key))})
        except RuntimeError as error:
            self._graph.diagnostics.events.append((newest.t, f"solver rebuilt: {self._graph.reason(error)}"))
            self._rebuild(newest, guess)
        while self._failed:
            self._graph.diagnostics.reject(f"factor: {self._failed.pop()}")

    def _check_jump(self, newest: Keyframe, guess: Guess) -> None:
        """RuntimeError if points that are estimated took the newest pose where it cannot be."""
        if not self._maps:
            return
        estimates = self._solver.estimates()
        if jumps(guess, self._solver.value(newest.key)):
            raise RuntimeError("the estimate jumped")
        self._last = estimates

    def _read(self, newest: Keyframe, touched: Iterable[int]) -> None:
        """Bring the newest pose with its covariance up to date, and those constants and landmarks that an update touched.

        Of constants and points the covariance is not needed before the end, and it takes time: only those of landmarks are read.
        """
        keys = self._graph.keys
        followed = {keys[name] for name, s in self._graph.sensors.items() if s.follows_constants and name in keys}
        self._graph.pose, self._graph.covariance = self._marginal(newest.key)
        self._filtered[newest.index] = (self._graph.pose, self._graph.covariance)
        for key in touched:
            if not is_landmark(key) and key not in followed:
                self._graph.values[key] = self._value(key)
            else:
                self._graph.values[key], self._graph.spreads[key] = self._marginal(key)

    def _value(self, key: int) -> Array:
        value = self._solver.value(key)
        if not all(map(math.isfinite, value.tolist())):
            raise IndeterminateError(key)
        return value

    def _marginal(self, key: int, spread: Array | None = None, graph: Graph | None = None) -> tuple[Array, Array]:
        """Estimate and covariance of a variable; ``spread``: that covariance, if known; ``graph``: where to report, of a copy."""
        value = self._value(key)
        try:
            covariance = self._solver.covariance(key) if spread is None else spread
        except RuntimeError:
            covariance = np.full((1, 1), np.nan)
        if positive.is_clear(covariance):
            return value, covariance
        if not (np.all(np.isfinite(covariance)) and np.all(np.diag(covariance) > 0.0)):
            found = covariances(*self._solver.linear(), (key,))
            (graph or self._graph).report_damping(found.damping)
            covariance = found.by_key[key]
        return value, positive.sound(covariance)

    def _leave(self, now: float, new: Collection[int]) -> None:
        """Keep the estimates of the keyframes older than the lag, before updates marginalise them out, and of the constants that
        are in the solver by now, which are all but the ``new`` ones."""
        if not isinstance(self._solver, Window) or self._lag is None:
            return
        lag, count = self._lag, len(self._left)
        first = self._graph.keyframes[count].t
        if not self._maps:  # those read before leave by now: both takes time
            self._solver.lag = now - first + ROUNDING
        if first >= now - lag - self._margin:
            return
        leaving = self._graph.keyframes[count : bisect.bisect_left(self._graph.times, now - lag, count)]
        constants = [key for key in self._graph.values if key not in new and is_constant(key)]
        points = [key for mapper in self._graph.mappers for key in mapper.leave(now - lag)]
        # of a start of the whole problem the covariance is not asked
        asked = [] if self._is_whole else [*(k.key for k in leaving), *constants, *points]
        spreads = self._solver.covariances(asked) if asked else {}
        try:
            for k in leaving:
                spread = self._filtered[k.index][1] if self._is_whole else spreads.get(k.key)
                self._left.append(self._marginal(k.key, spread))
            for key in constants:
                self._graph.values[key], self._graph.spreads[key] = self._marginal(key, spreads.get(key))
        except RuntimeError:
            self._left += [self._filtered[k.index] for k in leaving[len(self._left) - count :]]
        oldest = self._solver.oldest  # what is still in the solver is needed where that is rebuilt
        for key in [key for key in self._graph.values if is_of_keyframe(key) and index_of(key) < oldest]:
            del self._graph.values[key]
        self._forget(points, spreads)

    def _forget(self, points: Iterable[int], spreads: Mapping[int, Array]) -> None:
        """Keep the estimates of points that leave the window, and their covariances, of which some are known."""
        for key in points:
            try:
                found = self._marginal(key, spreads.get(key))
            except RuntimeError:
                found = self._graph.values[key], self._graph.spreads[key]
            self._graph.departed[0][key], self._graph.departed[1][key] = found
            del self._graph.values[key], self._graph.spreads[key]

    def _rebuild(self, newest: Keyframe, guess: Guess) -> None:
        """A new solver after the old one failed, from what that told before; then with QR, which keeps more digits, then without
        what the newest keyframe tells. Where nothing helps there is none for a while."""
        failure = RuntimeError()
        summary = self._solver.summary(failed=True)
        near = read_all(self._last, [*(k.key for k in self._graph.keyframes), *self._graph.values])
        tries = ("CHOLESKY", "QR", "QR") if self._factorization == "CHOLESKY" else ("QR", "QR")
        for i, factorization in enumerate(tries):
            if i == len(tries) - 1:
                self._drop_newest(newest)
            self._filtered[newest.index] = guess
            try:
                with gtsam_errors():
                    self._start_again(newest, summary, near, factorization)
                    if summary is not None and any(node.has_pose for node in newest.nodes):
                        self._check_jump(newest, guess)
            except RuntimeError as error:
                failure = error
            else:
                return
        self._stall(newest, guess, summary, failure)

    def _drop_newest(self, newest: Keyframe) -> None:
        """Drop what the newest keyframe tells of poses; the prior of its tilt stays."""
        if count := sum(node.has_pose for node in newest.nodes):
            self._graph.diagnostics.reject("newest keyframe: the graph cannot be solved with it", count)
            newest.nodes[:] = [node for node in newest.nodes if not node.has_pose]

    def _stall(self, newest: Keyframe, guess: Guess, summary: MarginalSummary | None, error: RuntimeError) -> None:
        """Go on as a filter where the graph cannot be solved."""
        self._filtered[newest.index] = self._graph.pose, self._graph.covariance = guess
        self._waiting = Addition()
        self._solver = self._stalled = Stalled(newest.t, self._known, summary, self._stalled)
        self._graph.diagnostics.events.append(
            (newest.t, f"goes on without a solver until {self._solver.until:.1f} s: {self._graph.reason(error)}")
        )

    def _known(self, key: int) -> Array:
        """What is known of a variable without the solver."""
        if is_pose(key):
            return self._filtered[index_of(key)][0]
        return self._graph.values[key] if key in self._graph.values else self._graph.departed[0][key]

    def _start_again(
        self,
        newest: Keyframe,
        summary: MarginalSummary | None,
        near: Mapping[int, Array] = NOWHERE,
        factorization: str | None = None,
    ) -> None:
        """A new solver with what is in the graph, which begins ``near`` there where that is known.

        A window begins with the ``summary`` of what has left it, and with all measurements that this does not hold; else the graph
        begins with the priors.
        """
        self._solver, self._waiting, self._solved = self._new_solver(factorization), Addition(), newest.t
        keyframes = self._graph.keyframes[0 if summary is None else summary.oldest :]
        guesses = {k.key: self._filtered[k.index][0] for k in keyframes} | self._graph.values
        known: Collection[int] = () if summary is None else summary.keys
        guesses |= {key: value for key, value in self._graph.departed[0].items() if key in known}
        guesses |= {key: value for key, value in near.items() if key in guesses}
        self._graph.drop_astray(keyframes[1:], guesses)
        if summary is not None:  # what is marginalised is linearised there, and fits to nothing else
            guesses |= {key: value for key, value in summary.at.items() if key in guesses}
        factors = self._priors() if summary is None else summary.on(guesses)
        nodes = [n for k in keyframes for n in k.nodes if is_missing(n, guesses, known)]
        if near and isinstance(self._solver, FullHistory):
            guesses = self._graph.problem().solve(guesses, ITERATIONS_AFTER_FAILURE).values
        nodes = [*(self._odometry_node(k) for k in keyframes[1:]), *nodes]
        self._solver.begin(factors, nodes, guesses, self._stamps(keyframes, guesses))
        self._read(newest, [key for key in self._graph.values if not is_of_keyframe(key)])

    def _priors(self) -> list[gtsam.NonlinearFactor]:
        """What is known before any measurement."""
        assert self._graph.prior is not None
        noise = gtsam.noiseModel.Gaussian.Covariance(
            se2.world_to_body(self._graph.prior.pose, self._graph.prior.covariance)
        )
        start = gtsam.PriorFactorPose2(self._graph.keyframes[0].key, gtsam.Pose2(*self._graph.prior.pose), noise)
        means, spreads = self._graph.constant_priors()
        spread_as = gtsam.noiseModel.Gaussian.Covariance
        return [start, *(gtsam.PriorFactorVector(key, mean, spread_as(spreads[key])) for key, mean in means.items())]

    def _stamps(self, keyframes: Sequence[Keyframe], values: Values) -> dict[int, float]:
        """The time of each variable of a window that begins; points are as if they were seen now."""
        now = keyframes[-1].t
        oldest = -math.inf if self._lag is None else now - self._lag - self._margin
        stamps = {key: now if key in self._graph.values else oldest for key in values}
        return stamps | {key: k.t for k in keyframes for key in (k.key, tilt_key(k.index)) if key in values}

    def _odometry_node(self, keyframe: Keyframe) -> Node:
        factor, keys = self._graph.odometry_factor(keyframe)
        if len(keys) > 2 or self._maps:  # GTSAM's own do not follow where points have gone
            return Node(keys, factor, 3)
        assert keyframe.from_previous is not None
        return Node(keys, native=self._graph.motion.native((keys[0], keys[1]), keyframe.from_previous))

    def _new_solver(self, factorization: str | None = None) -> Solver:
        parameters = gtsam.ISAM2Params()
        parameters.setFactorization(factorization or self._factorization)
        # far from where a point was first taken to be its factors mean nothing
        parameters.relinearizeSkip = 1 if self._maps else self._settings.relinearize_skip
        threshold = self._settings.relinearize_threshold
        if self._lag is None:
            return FullHistory(parameters, threshold)
        parameters.findUnusedFactorSlots = True
        threshold = min(threshold, NEAR_POINTS) if self._maps else threshold
        # with points each pose leaves by itself: a window that is built anew soon linearises what it knew where it knew it
        return Window(parameters, threshold, self._lag + self._margin if self._maps else math.inf, self._failed.append)
