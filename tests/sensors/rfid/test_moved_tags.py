"""Tags that are not where the map has them, as a robot can know of them on its way."""

from dataclasses import replace
from functools import cache

import pytest
from short_logs import mounted_exactly

from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.result import RunResult
from factorgraph_loc.simulation import preset, simulate


@cache
def office(seed: int, misplaced: float) -> Log:
    """Two minutes, with some tags 1 m off in the map."""
    changes = {"drive": {"duration": 120.0}, "faults": {"misplaced": misplaced}}
    return mounted_exactly(simulate(preset("office", changes), seed))


def truth(seed: int, misplaced: float) -> Log:
    """The same log with the right map."""
    return replace(office(seed, misplaced), world=office(seed, 0.0).world)


@cache
def with_the_right_map(estimator: str, seed: int) -> RunResult:
    return run(truth(seed, 0.25), RunConfig(estimator))


@pytest.mark.parametrize("estimator", ["ekf", "smoother"])
def test_hardly_worse_than_with_the_right_map(estimator: str) -> None:
    """A quarter of the tags moved: each named tag did move, and most of them are named."""
    log = office(12, 0.25)
    result, right = run(log, RunConfig(estimator)), with_the_right_map(estimator, 12)
    scores, right_scores = score(result, log), score(right, log)
    moved, named = set(log.metadata["misplaced"].split(", ")), set(result.diagnostics.doubted["moved_tags"])
    assert scores["moved_tags.total"] == len(named) > 0
    assert any(warning.kind == "moved_tags" for warning in result.warnings)
    assert scores["causal.position_rmse"] < 1.3 * right_scores["causal.position_rmse"]
    # the EKF is overconfident on this drive with the right map, too: 5.1
    assert scores["causal.anees"] < max(4.5, right_scores["causal.anees"])
    assert named <= moved
    assert len(named) >= 0.6 * len(moved)  # some of them the robot hardly passes in two minutes


def test_a_final_trajectory_leaves_out_tags_that_have_clearly_moved() -> None:
    """Without that the final error with seed 1 is 1.7 times that of the right map."""
    log = office(1, 0.25)
    errors = [
        score(result, log)["final.position_rmse"]
        for result in (run(log, RunConfig("smoother")), with_the_right_map("smoother", 1))
    ]
    assert errors[0] < 1.3 * errors[1]


def test_in_a_right_map_no_tag_has_moved() -> None:
    result = with_the_right_map("smoother", 12)
    assert not result.diagnostics.doubted["moved_tags"]
    assert not any(warning.kind == "moved_tags" for warning in result.warnings)


def test_an_error_of_the_pose_is_no_evidence_that_tags_have_moved() -> None:
    """With a third of the tags dead the robot is off by 0.3 m, for long, before it knows which. Without the wider average three
    tags were believed moved at the end."""
    log = simulate(preset("office", {"drive": {"duration": 90.0}, "faults": {"dead": 0.3}}), 1)
    assert len(run(log, RunConfig("smoother")).diagnostics.doubted["moved_tags"]) <= 1
