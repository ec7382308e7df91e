"""Incremental solution of a graph by iSAM2 (Kaess et al., IJRR 31(2), 2012), with the full history or with a window.

A window is a fixed-lag smoother: poses that are older than the lag are marginalised. A solver of GTSAM is unusable
after an exception in an update. Factors and values are therefore also stored here. After a failure a new solver is
built from them once. If the new solver also fails, the run ends with an error.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence

import gtsam
import numpy as np

from factorgraph_loc.fusion.graph.batch import solve_whole, whole_problem
from factorgraph_loc.fusion.graph.graph import Addition, Graph, Guess, Keyframe, Node, jumps
from factorgraph_loc.fusion.graph.problem import IndeterminateError, covariances
from factorgraph_loc.fusion.graph.settings import SmootherSettings
from factorgraph_loc.fusion.graph.solver import MARGIN, WITH_POINTS, FullHistory, Window
from factorgraph_loc.fusion.graph.summary import MarginalSummary, is_missing
from factorgraph_loc.sensors.motion import MOTION
from factors import positive, se2
from factors.graph import GTSAM_ERRORS, Values, index_of, is_constant, is_landmark, is_of_keyframe, tilt_key
from factors.se2 import Array

ITERATIONS_AFTER_FAILURE = 10  # maximum number of batch iterations to initialise a new solver after a failure
LAG = 10.0  # s: default length of the window for causal estimates
# A variable is linearised again if it has changed by this much [m, rad, or the unit of a constant]: in general, and in
# windows with points, where linearisations soon become permanent. Last: the number of updates between two checks.
MOVED, NEAR_POINTS, CHECKED_EVERY = 0.05, 0.02, 10
ROUNDING = 1e-6  # s: rounding error of differences of times


class Incremental:
    """Solves the graph of the smoother incrementally during the run, by iSAM2. See the module docstring."""

    def __init__(self, graph: Graph, settings: SmootherSettings) -> None:
        self._graph, self._settings = graph, settings
        # True if factors wait until the next keyframe, because updates of the solver with landmarks are slow
        self._waits = settings.landmarks != "known"
        self._maps = graph.mapper.estimates
        self._margin = WITH_POINTS if self._maps else MARGIN
        # `_is_whole`: True if the final trajectory is the solution of the whole problem. `_lag` [s]: the length of the window, or
        # None for the full history.
        self._is_whole = settings.lag is None or settings.lag == math.inf
        self._lag = None if settings.lag == math.inf else settings.lag
        links = any(sensor.links for sensor in graph.sensors.values())
        if settings.lag is None and not (self._waits or self._maps or links):
            self._lag = LAG
        # `_solve_every` [s]: the time for which new factors may wait for the next update of the solver
        every = max((sensor.solve_every for sensor in graph.sensors.values()), default=0.0)
        defers = not self._waits and (self._lag is None or self._lag >= 2.0 * every)
        self._solve_every = every if defers else 0.0
        # the keys of the constants whose covariance is computed during the run, because their sensor needs it
        self._followed = {
            graph.keys[name]
            for name, sensor in graph.sensors.items()
            if sensor.follows_constants and name in graph.keys
        }
        self._failed: list[str] = []  # the reasons why factors could not be linearised
        self._solver = self._new_solver()
        self._waiting = Addition()  # the factors and variables that wait for the next update
        self._solved = -math.inf  # s; the time of the newest keyframe in the solver
        self._oldest = 0  # the number of the oldest keyframe that has not left the window

    def forget(self, until: float) -> None:
        """Delete the keyframes before the time ``until`` [s] that are no longer in the window. Nothing is deleted if
        all keyframes are optimised together at the end of the run."""
        graph = self._graph
        if self._is_whole or not graph.keyframes or until < next(iter(graph.keyframes.values())).t:
            return
        # the newest keyframes are needed, because they contain observations of points that are not yet variables
        last = min(graph.keyframe_before(until).index, self._oldest, graph.newest.index - graph.mapper.horizon)
        graph.forget(min(last, self._solver.oldest))  # a rebuilt solver needs the rest

    def final(self, graph: Graph) -> tuple[Array, Array]:
        """Return the final poses (M, 3) and body-frame covariances (M, 3, 3) of the keyframes of ``graph``, a copy of
        the graph.

        If the setting ``lag`` is "all" or not set, all poses are optimised together. Otherwise poses in the window have
        their current estimates, and older poses the estimates from when they left the window.
        """
        if self._settings.smooth and self._is_whole:
            return solve_whole(graph, self._newest_values(graph), is_guess=self._settings.final_only)
        estimates = [keyframe.causal for keyframe in graph.keyframes.values()]
        if self._settings.smooth:
            waiting = self._waiting.values
            try:
                for key in [key for key in graph.values if not is_of_keyframe(key) and key not in waiting]:
                    graph.values[key], graph.covariances[key] = self._marginal(key, graph=graph)
                estimates = [
                    k.final or (k.causal if k.key in waiting else self._marginal(k.key, graph=graph))
                    for k in graph.keyframes.values()
                ]
            except GTSAM_ERRORS as error:
                raise graph.unsolved(error) from error
        if self._waiting.nodes or len(graph.newest.nodes) > len(self._graph.newest.nodes):
            estimates[-1] = graph.pose, graph.covariance
        known = [estimate for estimate in estimates if estimate is not None]
        return np.array([p for p, _ in known]), np.array([c for _, c in known])

    def _newest_values(self, graph: Graph) -> Values:
        """Return the current estimates of all variables of ``graph``, a copy of the run's graph, by key."""
        known = self._waiting.values | {k.key: k.final[0] for k in graph.keyframes.values() if k.final is not None}
        keys = [*(k.key for k in graph.keyframes.values()), *graph.values]
        return known | {key: self._solver.value(key) for key in keys if key not in known}

    def begin(self, newest: Keyframe) -> None:
        """Replace the solver by a new one. Call this at the start, and whenever keyframes were removed before
        ``newest`` was added."""
        newest.causal = self._graph.pose, self._graph.covariance
        summary = self._solver.summary(failed=False)
        summary = None if summary is None else summary.before_pose(newest.index)
        self._graph.forget_landmarks(frozenset() if summary is None else summary.keys)
        self._start_again(newest, summary)

    def extend(self, keyframe: Keyframe, addition: Addition, guess: Guess) -> None:
        """Add the new ``keyframe`` to the solver, with the factors and variables of ``addition``. ``guess``: the
        predicted pose and covariance of the keyframe."""
        keyframe.causal = guess
        addition.nodes.insert(0, self._odometry_node(keyframe))
        addition.values[keyframe.key] = guess[0]
        if keyframe.t < self._solved + self._solve_every:
            self._wait(addition, guess)
        else:
            self._update(addition)

    def attach(self, keyframe: Keyframe, addition: Addition, guess: Guess | None) -> None:
        """Add the factors and variables of ``addition`` at an existing ``keyframe``. ``guess``: the keyframe's pose and
        covariance after a correction by the factors, or None if it is not the newest keyframe."""
        if guess is None or not (self._waits or keyframe.t < self._solved + self._solve_every):
            self._update(addition)
            return
        # the corrected covariance ignores correlations with estimated landmarks, so keep the solver's covariance
        if self._waits:
            guess = guess[0], self._graph.covariance
        self._wait(addition, guess)

    def _wait(self, addition: Addition, guess: Guess) -> None:
        """Store the factors and variables of ``addition`` for the next update of the solver. Until then the estimate of
        the newest pose is ``guess``, with its covariance."""
        self._waiting.nodes += addition.nodes
        self._waiting.values |= addition.values
        self._graph.pose, self._graph.covariance = guess

    def current(self, key: int) -> Array:
        """Return the solver's present estimate of the variable ``key``."""
        return self._solver.value(key)

    def is_open(self, keyframe: int) -> bool:
        """Return True if factors may still be added to the keyframe with the index ``keyframe``, because it is in the
        window."""
        return keyframe >= self._oldest and keyframe in self._graph.keyframes

    def is_kept(self, keyframe: int) -> bool:
        """Return True if the final optimisation includes the keyframe with the index ``keyframe``."""
        return self._is_whole or self.is_open(keyframe)

    def _update(self, addition: Addition) -> None:
        """Update the solver with the waiting factors and those of ``addition``. If this fails, build a new solver."""
        newest, nodes, values = self._graph.newest, addition.nodes, addition.values
        if self._waiting.nodes or self._waiting.values:
            nodes, values = self._waiting.nodes + nodes, self._waiting.values | values
            self._waiting = Addition()
        self._solved, guess = newest.t, newest.causal
        if isinstance(self._solver, Window):
            self._leave(self._solver, newest.t, values)
        try:
            self._solver.update(nodes, values, newest.t)
            if self._maps and guess is not None and jumps(guess, self._solver.value(newest.key)):
                raise RuntimeError("the estimate jumped")
            self._read(newest, {key for node in nodes for key in node.keys})
        except GTSAM_ERRORS as error:
            why = self._graph.reason(error)
            self._graph.diagnostics.event(newest.t, "solver_rebuilt", "the solver was rebuilt: {why}", why=why)
            newest.causal = guess
            self._start_again(newest, self._solver.summary(failed=True), failed=True)
        while self._failed:
            self._graph.diagnostics.reject(f"factor: {self._failed.pop()}")

    def _read(self, newest: Keyframe, touched: Iterable[int]) -> None:
        """Copy estimates from the solver after an update: the newest pose, and the other variables with keys in
        ``touched``. Covariances are costly. They are copied only for the pose, for landmarks, and for constants if a
        sensor needs them."""
        graph = self._graph
        newest.causal = graph.pose, graph.covariance = self._marginal(newest.key)
        for key in touched:
            if key not in graph.values or (is_of_keyframe(key) and not self.is_open(index_of(key))):
                continue
            if is_landmark(key) or key in self._followed:
                graph.values[key], graph.covariances[key] = self._marginal(key)
            else:
                graph.values[key] = self._value(key)

    def _value(self, key: int) -> Array:
        """Return the solver's estimate of the variable ``key``. Raises IndeterminateError if it is not finite."""
        value = self._solver.value(key)
        if not all(map(math.isfinite, value.tolist())):
            raise IndeterminateError(key)
        return value

    def _marginal(self, key: int, known: Array | None = None, graph: Graph | None = None) -> Guess:
        """Return the estimate and covariance of the variable ``key``. ``known``: the covariance if it is already
        computed. ``graph``: the diagnostics of this graph get an event if the covariance needed damping. None means the
        run's graph."""
        value = self._value(key)
        try:
            covariance = self._solver.covariance(key) if known is None else known
        except GTSAM_ERRORS:
            covariance = np.full((1, 1), np.nan)
        if _is_definite(covariance):
            return value, covariance
        if not (np.all(np.isfinite(covariance)) and np.all(np.diag(covariance) > 0.0)):
            marginals = covariances(*self._solver.linear(), (key,))
            (graph or self._graph).report_damping(marginals.damping)
            covariance = marginals.by_key[key]
        return value, positive.sound(covariance)

    def _leave(self, window: Window, now: float, new: Collection[int]) -> None:
        """Store the final estimates of keyframes that are older than the lag, because the next update marginalises
        them. Also store the estimates of all constants and landmarks in the solver. ``window``: the solver. ``now``
        [s]: the time of the newest keyframe. ``new``: keys of variables that are not yet in the solver."""
        assert self._lag is not None
        graph, oldest = self._graph, self._graph.keyframes[self._oldest]
        # keyframes leave one update after their estimates are stored, because both in one update would take longer
        if not self._maps:
            window.lag = now - oldest.t + ROUNDING
        if oldest.t >= now - self._lag - self._margin:
            return
        leaving = []
        while oldest.t < now - self._lag:
            leaving.append(oldest)
            oldest = graph.keyframes[oldest.index + 1]
        self._oldest = oldest.index
        constants = [key for key in graph.values if key not in new and is_constant(key)]
        points = graph.mapper.leave(now - self._lag)
        # if the whole problem is solved at the end, these estimates are only its initial values, and need no covariances
        asked = [] if self._is_whole else [*(k.key for k in leaving), *constants, *points]
        marginals = window.covariances(asked) if asked else {}
        for k in leaving:
            k.final = k.causal
        try:
            for k in leaving:
                assert k.causal is not None
                k.final = self._marginal(k.key, k.causal[1] if self._is_whole else marginals.get(k.key))
            for key in constants:
                graph.values[key], graph.covariances[key] = self._marginal(key, marginals.get(key))
        except GTSAM_ERRORS:
            pass  # the causal estimates remain
        first = window.oldest  # a rebuilt solver needs the variables from this keyframe on
        for key in [key for key in graph.values if is_of_keyframe(key) and index_of(key) < first]:
            del graph.values[key]
        self._forget(points, marginals)

    def _forget(self, points: Iterable[int], marginals: Mapping[int, Array]) -> None:
        """Remove the ``points`` (keys) that leave the window from the graph, and store their estimates and covariances.
        ``marginals``: covariances that are already computed, by key."""
        for key in points:
            try:
                estimate = self._marginal(key, marginals.get(key))
            except GTSAM_ERRORS:
                estimate = self._graph.values[key], self._graph.covariances[key]
            self._graph.departed[0][key], self._graph.departed[1][key] = estimate
            del self._graph.values[key], self._graph.covariances[key]

    def _start_again(self, newest: Keyframe, summary: MarginalSummary | None, *, failed: bool = False) -> None:
        """Build a new solver from the graph. ``newest``: the last keyframe.

        ``summary``: marginal factors that replace the variables no longer in the window. The new solver gets these, and
        all measurements that they do not contain. If it is None, the solver gets the priors and all measurements.
        ``failed``: True if the previous solver failed. Raises RunFailedError if the new solver fails.
        """
        graph, first = self._graph, 0 if summary is None else summary.oldest
        self._solver, self._waiting, self._solved = self._new_solver(failed=failed), Addition(), newest.t
        keyframes = [k for k in graph.keyframes.values() if k.index >= first]
        guesses = {k.key: k.causal[0] for k in keyframes if k.causal is not None} | graph.values
        known: Collection[int] = () if summary is None else summary.keys
        guesses |= {key: value for key, value in graph.departed[0].items() if key in known}
        graph.drop_astray(keyframes[1:], guesses)
        try:
            if summary is not None:  # marginal factors are valid only at their own linearisation points
                guesses |= {key: value for key, value in summary.at.items() if key in guesses}
            elif failed:
                guesses = whole_problem(graph).solve(guesses, ITERATIONS_AFTER_FAILURE).values
            factors = self._priors() if summary is None else summary.on(guesses)
            nodes = [n for k in keyframes for n in k.nodes if is_missing(n, guesses, known)]
            nodes = [*(self._odometry_node(k) for k in keyframes[1:]), *nodes]
            self._solver.begin(factors, nodes, guesses, self._stamps(keyframes, guesses))
            self._read(newest, [key for key in graph.values if not is_of_keyframe(key)])
        except GTSAM_ERRORS as error:
            raise graph.unsolved(error) from error

    def _priors(self) -> list[gtsam.NonlinearFactor]:
        """Return the prior factors of the first pose and of the constants."""
        prior, gaussian = self._graph.prior, gtsam.noiseModel.Gaussian.Covariance
        assert prior is not None
        noise = gaussian(se2.world_to_body(prior.pose, prior.covariance))
        start = gtsam.PriorFactorPose2(self._graph.keyframes[0].key, gtsam.Pose2(*prior.pose), noise)
        means, covariances = self._graph.constant_priors()
        return [start, *(gtsam.PriorFactorVector(key, mean, gaussian(covariances[key])) for key, mean in means.items())]

    def _stamps(self, keyframes: Sequence[Keyframe], values: Values) -> dict[int, float]:
        """Return {key: time [s]} of the variables ``values`` of a new window. A variable leaves the window when its
        time is older than the lag. Points get the time of the last of ``keyframes``."""
        now = keyframes[-1].t
        oldest = -math.inf if self._lag is None else now - self._lag - self._margin
        stamps = {key: now if key in self._graph.values else oldest for key in values}
        return stamps | {key: k.t for k in keyframes for key in (k.key, tilt_key(k.index)) if key in values}

    def _odometry_node(self, keyframe: Keyframe) -> Node:
        """Return the odometry factor from the previous keyframe to ``keyframe``."""
        step = keyframe.from_previous
        assert step is not None
        if self._maps or (MOTION in self._graph.keys and not keyframe.is_elsewhere):
            factor, keys = self._graph.odometry_factor(keyframe)
            return Node(keys, factor, 3)
        # without points and constants, GTSAM's own factor is faster
        previous, noise = keyframe.key - 1, gtsam.noiseModel.Gaussian.Covariance(step.covariance)
        native = gtsam.BetweenFactorPose2(previous, keyframe.key, gtsam.Pose2(*step.delta), noise)
        return Node((previous, keyframe.key), native=native)

    def _new_solver(self, *, failed: bool = False) -> FullHistory | Window:
        """Return a new solver without factors. ``failed``: True if the previous solver failed. The new one then uses a
        slower but more robust factorisation."""
        parameters = gtsam.ISAM2Params()
        # Cholesky fails in long dead reckoning, but is twice as fast as QR if there are points
        parameters.setFactorization("CHOLESKY" if self._maps and not failed else "QR")
        # points move far from their initial positions, so every update checks which factors to linearise again
        parameters.relinearizeSkip = 1 if self._maps else CHECKED_EVERY
        if self._lag is None:
            return FullHistory(parameters, MOVED, self._failed.append)
        parameters.findUnusedFactorSlots = True
        threshold = NEAR_POINTS if self._maps else MOVED
        # with points, a pose leaves at almost every update; without points, `_leave` sets the lag when poses must leave
        return Window(parameters, threshold, self._failed.append, self._lag + self._margin if self._maps else math.inf)


def _is_definite(covariance: Array) -> bool:
    """Return True if a covariance (D, D) is finite and has a Cholesky root."""
    if positive.is_clear(np.ascontiguousarray(covariance)):
        return True
    try:
        return math.isfinite(np.linalg.cholesky(covariance).sum())
    except np.linalg.LinAlgError:
        return False
