"""A whole run as one row of poses with constants: what a problem is unless it has loops or points, and is then solved by compiled
code (:mod:`factors.chain`), with one call for each kind of observation."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Sequence
from functools import cache
from typing import cast

import numpy as np

from factorgraph_loc.fusion.graph.marginals import Covariances
from factors import chain, se2
from factors.graph import Factor, Stack, Stackable, Values, index_of, is_pose
from factors.se2 import Array

MOST_PARAMETERS = 40  # the solver is dense in the parameters: above this number GTSAM's sparse elimination is faster
Placed = tuple[Factor, tuple[int, ...]]  # a factor with the keys of its variables
State = tuple[Array, Array]  # poses (N, 3), and parameters (P,)


class Chained:
    """``factors`` on poses, each on one or on two that follow one another, and on the vectors that all have in common."""

    def __init__(self, factors: Sequence[Placed]) -> None:
        keys = {key for _, of in factors for key in of}
        self._poses = sorted((key for key in keys if is_pose(key)), key=index_of)
        self._vectors = sorted(keys - set(self._poses))
        self._factors = factors
        self._stacks: list[Stack] = []
        self._columns: dict[int, slice] = {}

    @property
    def fits(self) -> bool:
        """Whether the factors are such."""
        place = {key: i for i, key in enumerate(self._poses)}
        for _, keys in self._factors:
            numbers = [place[key] for key in keys if key in place]
            if len(numbers) > 2 or (len(numbers) == 2 and numbers[1] != numbers[0] + 1):
                return False
        return bool(self._poses)

    def begin(self, values: Values) -> State | None:
        """The state at ``values``; None if it has too many parameters."""
        ends = np.cumsum([0, *(len(values[key]) for key in self._vectors)]).tolist()
        if ends[-1] > MOST_PARAMETERS:
            return None
        if not self._stacks:
            self._columns = {key: slice(a, b) for key, a, b in zip(self._vectors, ends[:-1], ends[1:], strict=True)}
            self._stacks = self._stacked(values)
            self._first = np.concatenate([stack.first for stack in self._stacks])
        parameters = np.concatenate([np.zeros(0), *(values[key] for key in self._vectors)])
        return np.array([values[key] for key in self._poses]), parameters

    def values(self, state: State) -> Values:
        """A state as values by key."""
        poses, parameters = state
        vectors = {key: parameters[columns] for key, columns in self._columns.items()}
        return dict(zip(self._poses, poses, strict=True)) | vectors

    def cost(self, state: State) -> float:
        return sum(stack.cost(*state) for stack in self._stacks)

    def system(self, state: State) -> chain.System:
        """The normal equations at a state."""
        poses, parameters = state
        jacobian, residual = np.zeros((len(self._first), 6 + len(parameters))), np.zeros(len(self._first))
        begin = 0
        for stack in self._stacks:
            rows = slice(begin, begin + stack.rows)
            stack.linearize(poses, parameters, jacobian[rows], residual[rows])
            begin += stack.rows
        return chain.normal(len(poses), self._first, jacobian, residual)

    def moved(self, state: State, damping: float) -> tuple[State, float] | None:
        """The state after a step of Levenberg and Marquardt, and the largest component of the step; None where the problem is
        nearly singular."""
        try:
            is_solved, poses, parameters = chain.solved(self.system(state), damping)
        except np.linalg.LinAlgError:
            return None
        if not is_solved:
            return None
        largest = max(np.abs(poses).max(initial=0.0), np.abs(parameters).max(initial=0.0))
        return (se2.compose(state[0], se2.exp(poses)), state[1] + parameters), float(largest)

    def covariances(self, values: Values) -> Covariances | None:
        """Marginal covariances of all variables; None if they need higher precision."""
        state = self.begin(values)
        if state is None:
            return None
        try:
            is_solved, of_poses, of_parameters = chain.covariances(self.system(state))
        except np.linalg.LinAlgError:
            return None
        variances = np.concatenate((np.diagonal(of_poses, axis1=1, axis2=2).ravel(), np.diag(of_parameters)))
        if not (is_solved and np.all(np.isfinite(variances)) and np.all(variances > 0.0)):
            return None
        shared = {key: of_parameters[columns, columns] for key, columns in self._columns.items()}
        return Covariances(dict(zip(self._poses, of_poses, strict=True)) | shared, 0.0)

    def _stacked(self, values: Values) -> list[Stack]:
        """The factors by kind."""
        place = {key: i for i, key in enumerate(self._poses)}
        kinds: defaultdict[Hashable, list[Placed]] = defaultdict(list)
        for factor, keys in self._factors:
            kinds[_kind(factor, keys)].append((factor, keys))
        stacks: list[Stack] = []
        for placed in kinds.values():
            first, keys = placed[0]
            if _kind(first, keys) is None:
                stacks.append(_Others(placed, place, self._columns))
                continue
            assert isinstance(first, Stackable)
            numbers = [place[keys[0]] for _, keys in placed]
            column = next((self._columns[key].start for key in keys if key in self._columns), 0)
            stacks.append(first.stack([factor for factor, _ in placed], numbers, column))
        return stacks


def _kind(factor: Factor, keys: tuple[int, ...]) -> Hashable:
    """A key that is equal for factors linearised by one call; None for a factor linearised separately."""
    kind = cast(Stackable, factor).kind if _is_stackable(type(factor)) else None
    return None if kind is None else (type(factor), kind, *[key for key in keys if not is_pose(key)])


@cache
def _is_stackable(kind: type[Factor]) -> bool:
    """Whether factors of a class become stacks. It is cached, because the check takes longer than a linearisation."""
    return hasattr(kind, "kind") and hasattr(kind, "stack")


class _Others:
    """Factors of any kind, each linearised separately."""

    def __init__(self, placed: Sequence[Placed], place: dict[int, int], columns: dict[int, slice]) -> None:
        self._placed, self._place, self._columns = placed, place, columns
        poses, parameters = np.zeros((len(place), 3)), np.zeros(max((c.stop for c in columns.values()), default=0))
        sizes = [len(factor.linearize(self._at(keys, poses, parameters))[0]) for factor, keys in placed]
        numbers = [next((place[key] for key in keys if key in place), 0) for _, keys in placed]
        self.first = np.repeat(np.array(numbers, dtype=np.int64), sizes)
        self.rows = sum(sizes)

    def linearize(self, poses: Array, parameters: Array, jacobian: Array, residual: Array) -> None:
        begin = 0
        for factor, keys in self._placed:
            error, blocks = factor.linearize(self._at(keys, poses, parameters))
            rows, first = slice(begin, begin + len(error)), True
            residual[rows] = error
            for key, block in zip(keys, blocks, strict=True):
                if key in self._place:
                    jacobian[rows, slice(0, 3) if first else slice(3, 6)] = block
                    first = False
                else:
                    columns = self._columns[key]
                    jacobian[rows, 6 + columns.start : 6 + columns.stop] = block
            begin = rows.stop

    def cost(self, poses: Array, parameters: Array) -> float:
        return sum(factor.cost(self._at(keys, poses, parameters)) for factor, keys in self._placed)

    def _at(self, keys: tuple[int, ...], poses: Array, parameters: Array) -> list[Array]:
        return [poses[self._place[key]] if key in self._place else parameters[self._columns[key]] for key in keys]
