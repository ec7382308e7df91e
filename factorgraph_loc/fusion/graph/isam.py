"""A graph kept solved by iSAM2 (Kaess et al., IJRR 31(2), 2012), with its full history or with a window.

A solver of GTSAM is unusable after an exception in an update. Its factors and values are therefore also kept here. After a failure
a new solver is built from these copies, once. If the new solver fails as well, the run ends with an error.
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

ITERATIONS_AFTER_FAILURE = 10
LAG = 10.0  # s: default length of the window for causal estimates
# m, rad, or the unit of a constant: a variable is linearised again after this change; in a window with points after a smaller one,
# as its oldest points are soon linearised permanently. Updates between checks of that.
MOVED, NEAR_POINTS, CHECKED_EVERY = 0.05, 0.02, 10
ROUNDING = 1e-6  # s: rounding error of differences of times


class Incremental:
    """The backend of the smoother; see the module."""

    def __init__(self, graph: Graph, settings: SmootherSettings) -> None:
        self._graph, self._settings = graph, settings
        self._waits = settings.landmarks != "known"  # what is seen between keyframes: an update takes long then
        self._maps = graph.mapper.estimates
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
        # keys of constants whose covariance is needed during the run
        self._followed = {
            graph.keys[name]
            for name, sensor in graph.sensors.items()
            if sensor.follows_constants and name in graph.keys
        }
        self._failed: list[str] = []  # reasons of factors that could not be linearised
        self._solver = self._new_solver()
        self._waiting = Addition()
        self._solved = -math.inf  # the time of the newest keyframe in the solver
        self._oldest = 0  # the number of the oldest keyframe that has not left the window

    def forget(self, until: float) -> None:
        """Forget keyframes until this time that have left the window. All are kept if the whole problem is solved at the end."""
        graph = self._graph
        if self._is_whole or not graph.keyframes or until < next(iter(graph.keyframes.values())).t:
            return
        # sightings of points that wait are in the newest keyframes
        last = min(graph.keyframe_before(until).index, self._oldest, graph.newest.index - graph.mapper.horizon)
        graph.forget(min(last, self._solver.oldest))  # a rebuilt solver needs the rest

    def final(self, graph: Graph) -> tuple[Array, Array]:
        """The whole graph, solved to the end: poses (M, 3) and body-frame covariances (M, 3, 3) of the keyframes.

        With a set lag a pose has its estimate at the time when it left the window. Poses in the window have the current estimate,
        poses that wait for the solver the predicted one."""
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
        """The newest estimates of all variables of a copy of the graph."""
        known = self._waiting.values | {k.key: k.final[0] for k in graph.keyframes.values() if k.final is not None}
        keys = [*(k.key for k in graph.keyframes.values()), *graph.values]
        return known | {key: self._solver.value(key) for key in keys if key not in known}

    def begin(self, newest: Keyframe) -> None:
        """Build a new solver: at the start, or after keyframes were removed and ``newest`` was added."""
        newest.causal = self._graph.pose, self._graph.covariance
        summary = self._solver.summary(failed=False)
        summary = None if summary is None else summary.before_pose(newest.index)
        self._graph.forget_landmarks(frozenset() if summary is None else summary.keys)
        self._start_again(newest, summary)

    def extend(self, keyframe: Keyframe, addition: Addition, guess: Guess) -> None:
        """Take a new keyframe with the ``guess`` of its pose, and what came with it."""
        keyframe.causal = guess
        addition.nodes.insert(0, self._odometry_node(keyframe))
        addition.values[keyframe.key] = guess[0]
        if keyframe.t < self._solved + self._solve_every:
            self._wait(addition, guess)
        else:
            self._update(addition)

    def attach(self, keyframe: Keyframe, addition: Addition, guess: Guess | None) -> None:
        """Take what was added to a keyframe that is in the graph. ``guess``: pose and covariance of the newest keyframe after the
        update, where it is that."""
        if guess is None or not (self._waits or keyframe.t < self._solved + self._solve_every):
            self._update(addition)
            return
        if self._waits:  # what its error has in common with that of landmarks only the graph knows
            guess = guess[0], self._graph.covariance
        self._wait(addition, guess)

    def _wait(self, addition: Addition, guess: Guess) -> None:
        """Keep what is to enter the solver with its next update; until then the newest pose is ``guess``."""
        self._waiting.nodes += addition.nodes
        self._waiting.values |= addition.values
        self._graph.pose, self._graph.covariance = guess

    def current(self, key: int) -> Array:
        """The newest estimate of a variable that is in the graph."""
        return self._solver.value(key)

    def is_open(self, keyframe: int) -> bool:
        """Whether factors may still be added to a keyframe."""
        return keyframe >= self._oldest and keyframe in self._graph.keyframes

    def is_kept(self, keyframe: int) -> bool:
        """Whether a keyframe is part of the final problem."""
        return self._is_whole or self.is_open(keyframe)

    def _update(self, addition: Addition) -> None:
        """Solve with an addition and the waiting factors. After a failure a new solver tries again."""
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
            self._graph.diagnostics.event(newest.t, "solver_rebuilt", "solver rebuilt: {why}", why=why)
            newest.causal = guess
            self._start_again(newest, self._solver.summary(failed=True), failed=True)
        while self._failed:
            self._graph.diagnostics.reject(f"factor: {self._failed.pop()}")

    def _read(self, newest: Keyframe, touched: Iterable[int]) -> None:
        """Bring the newest pose with its covariance up to date, and those constants and landmarks that an update touched.

        Of constants and points the covariance is not needed before the end, and it takes time: only those of landmarks are read.
        """
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
        value = self._solver.value(key)
        if not all(map(math.isfinite, value.tolist())):
            raise IndeterminateError(key)
        return value

    def _marginal(self, key: int, known: Array | None = None, graph: Graph | None = None) -> Guess:
        """Estimate and covariance of a variable; ``known``: that covariance, if known; ``graph``: where to report, of a copy."""
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
        """Keep the estimates of the keyframes older than the lag, before updates marginalise them out, and of the constants that
        are in the solver by now, which are all but the ``new`` ones."""
        assert self._lag is not None
        graph, oldest = self._graph, self._graph.keyframes[self._oldest]
        if not self._maps:  # those read before leave by now: both takes time
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
        # of a start of the whole problem the covariance is not asked
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
            pass  # the causal estimates stay
        first = window.oldest  # what is still in the solver is needed where that is rebuilt
        for key in [key for key in graph.values if is_of_keyframe(key) and index_of(key) < first]:
            del graph.values[key]
        self._forget(points, marginals)

    def _forget(self, points: Iterable[int], marginals: Mapping[int, Array]) -> None:
        """Keep estimates and covariances of points that leave the window. ``marginals``: the covariances that are known."""
        for key in points:
            try:
                estimate = self._marginal(key, marginals.get(key))
            except GTSAM_ERRORS:
                estimate = self._graph.values[key], self._graph.covariances[key]
            self._graph.departed[0][key], self._graph.departed[1][key] = estimate
            del self._graph.values[key], self._graph.covariances[key]

    def _start_again(self, newest: Keyframe, summary: MarginalSummary | None, *, failed: bool = False) -> None:
        """A new solver with what is in the graph; ``failed``: whether the one before did. RunFailedError where it fails.

        A window begins with the ``summary`` of what has left it, and with all measurements that this does not hold; else the graph
        begins with the priors.
        """
        graph, first = self._graph, 0 if summary is None else summary.oldest
        self._solver, self._waiting, self._solved = self._new_solver(failed=failed), Addition(), newest.t
        keyframes = [k for k in graph.keyframes.values() if k.index >= first]
        guesses = {k.key: k.causal[0] for k in keyframes if k.causal is not None} | graph.values
        known: Collection[int] = () if summary is None else summary.keys
        guesses |= {key: value for key, value in graph.departed[0].items() if key in known}
        graph.drop_astray(keyframes[1:], guesses)
        try:
            if summary is not None:  # what is marginalised is linearised there, and fits to nothing else
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
        """The prior factors of the first pose and of the constants."""
        prior, gaussian = self._graph.prior, gtsam.noiseModel.Gaussian.Covariance
        assert prior is not None
        noise = gaussian(se2.world_to_body(prior.pose, prior.covariance))
        start = gtsam.PriorFactorPose2(self._graph.keyframes[0].key, gtsam.Pose2(*prior.pose), noise)
        means, covariances = self._graph.constant_priors()
        return [start, *(gtsam.PriorFactorVector(key, mean, gaussian(covariances[key])) for key, mean in means.items())]

    def _stamps(self, keyframes: Sequence[Keyframe], values: Values) -> dict[int, float]:
        """The time of each variable of a window that begins; points are as if they were seen now."""
        now = keyframes[-1].t
        oldest = -math.inf if self._lag is None else now - self._lag - self._margin
        stamps = {key: now if key in self._graph.values else oldest for key in values}
        return stamps | {key: k.t for k in keyframes for key in (k.key, tilt_key(k.index)) if key in values}

    def _odometry_node(self, keyframe: Keyframe) -> Node:
        step = keyframe.from_previous
        assert step is not None
        if self._maps or (MOTION in self._graph.keys and not keyframe.is_elsewhere):
            factor, keys = self._graph.odometry_factor(keyframe)
            return Node(keys, factor, 3)
        # GTSAM's own factors are not linearised again when points move
        previous, noise = keyframe.key - 1, gtsam.noiseModel.Gaussian.Covariance(step.covariance)
        native = gtsam.BetweenFactorPose2(previous, keyframe.key, gtsam.Pose2(*step.delta), noise)
        return Node((previous, keyframe.key), native=native)

    def _new_solver(self, *, failed: bool = False) -> FullHistory | Window:
        parameters = gtsam.ISAM2Params()
        # Cholesky loses long stretches of dead reckoning as indeterminate; with points it takes half the time
        parameters.setFactorization("CHOLESKY" if self._maps and not failed else "QR")
        # far from where a point was first taken to be its factors mean nothing
        parameters.relinearizeSkip = 1 if self._maps else CHECKED_EVERY
        if self._lag is None:
            return FullHistory(parameters, MOVED, self._failed.append)
        parameters.findUnusedFactorSlots = True
        threshold = NEAR_POINTS if self._maps else MOVED
        # with points poses leave one at a time, so that a rebuilt window soon linearises at its former points
        return Window(parameters, threshold, self._failed.append, self._lag + self._margin if self._maps else math.inf)


def _is_definite(covariance: Array) -> bool:
    """Whether a covariance (D, D) is finite and has a Cholesky root."""
    try:
        return math.isfinite(np.linalg.cholesky(covariance).sum())
    except np.linalg.LinAlgError:
        return False
