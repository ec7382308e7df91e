"""Scores of trajectories against those of the package evo, and on cases whose answer is known."""

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
from evo import main_ape, main_rpe
from evo.core import sync
from evo.core.metrics import PoseRelation, Unit
from evo.core.trajectory import Plane
from evo.tools import file_interface
from pose_files import T0, wander, write
from refusal import refusal
from scipy.spatial.transform import Rotation
from tum_files import read_tum

from factorgraph_loc import InputError, PosePath, Trajectory, score
from factorgraph_loc.evaluation import metrics
from factorgraph_loc.files.checks import absolute

OPTIONS = {
    "none": {},
    "origin": {"align_origin": True},
    "se2": {"align": True, "project_to_plane": Plane.XY},
    "se3": {"align": True},
    "sim3": {"align": True, "correct_scale": True},
}
READ = {
    ".tum": file_interface.read_tum_trajectory_file,
    ".kitti": file_interface.read_kitti_poses_file,
    ".csv": file_interface.read_euroc_csv_trajectory,
}
T0_NS = round(T0 * 1e9)
HOW = ("rmse", "mean", "median", "max", "min", "std")


def of_evo(estimate, reference, align, **options):
    """Statistics of evo by the names of our figures."""
    true, found = READ[reference.suffix](reference), READ[estimate.suffix](estimate)
    if reference.suffix != ".kitti":
        true, found = sync.associate_trajectories(true, found)
    relations = {"position": PoseRelation.translation_part, "rotation": PoseRelation.rotation_angle_rad}
    expected = {}
    for what, relation in relations.items():
        results = {
            "ape": main_ape.ape(copy.deepcopy(true), copy.deepcopy(found), relation, **OPTIONS[align]),
            "rpe_per_m": main_rpe.rpe(
                copy.deepcopy(true),
                copy.deepcopy(found),
                relation,
                delta=1.0,
                delta_unit=Unit.meters,
                **OPTIONS[align],
                **options,
            ),
        }
        for name, result in results.items():
            expected |= {f"{name}.{what}_{how}": result.stats[how] for how in HOW}
    return expected


def check(found, expected):
    ours = {key: found.figures[key] for key in expected}
    exact = {key: value for key, value in expected.items() if "position" in key}
    assert {key: ours[key] for key in exact} == pytest.approx(exact, abs=1e-9)
    assert ours == pytest.approx(expected, abs=1e-6)  # the cosine of a small angle has half the digits


@pytest.mark.parametrize("suffix", READ)
@pytest.mark.parametrize("align", OPTIONS)
def test_the_figures_are_those_of_evo(tmp_path, align, suffix):
    reference, estimate = wander(3, flat=align == "se2")
    paths = write(tmp_path / f"estimate{suffix}", estimate), write(tmp_path / f"reference{suffix}", reference)
    check(score(*paths, align=align), of_evo(*paths, align))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("all_pairs", [False, True])
def test_unequal_rates_are_paired_as_in_evo(tmp_path, seed, all_pairs):
    (t, *true), (late, *found) = wander(seed, 400)
    rng = np.random.default_rng(seed)
    some, others = (np.sort(rng.choice(400, n, replace=False)) for n in ((150, 300) if seed % 2 else (300, 150)))
    estimate = write(tmp_path / "estimate.tum", (late[some], *(values[some] for values in found)))
    reference = write(tmp_path / "reference.tum", (t[others], *(values[others] for values in true)))
    result = score(estimate, reference, align="se3", all_pairs=all_pairs)
    assert 90 < result.figures["pairs"] < 150
    check(result, of_evo(estimate, reference, "se3", all_pairs=all_pairs))


def test_interpolated_estimates_are_scored_as_runs_are(tmp_path):
    reference, (t, *found) = wander(5, 300, flat=True)
    gap = np.r_[0:120, 140:300]
    write(tmp_path / "reference.tum", reference)
    write(tmp_path / "estimate.tum", (t[gap] + 0.03, *(values[gap] for values in found)))
    expected = metrics.accuracy(*(read_tum(tmp_path / f"{name}.tum", T0_NS) for name in ("estimate", "reference")))
    figures = score(tmp_path / "estimate.tum", tmp_path / "reference.tum", associate="interpolate").figures
    assert figures["pairs"] == expected["scored"]
    assert figures["rpe_per_m.pieces"] == expected["rpe_pieces"]
    for ours, theirs in (("ape.position", "position"), ("ape.rotation", "heading")):
        for how in ("rmse", "median", "p95", "max"):
            assert figures[f"{ours}_{how}"] == pytest.approx(expected[f"{theirs}_{how}"], abs=1e-8)
    assert figures["rpe_per_m.position_rmse"] == pytest.approx(expected["rpe_position_per_m"], abs=1e-8)
    assert figures["rpe_per_m.rotation_rmse"] == pytest.approx(expected["rpe_heading_per_m"], abs=1e-7)


def along_x(speed=1.0, seconds=10.0, **others):
    t = np.arange(round(seconds * 10) + 1) / 10
    return Trajectory(t, np.column_stack((speed * t, 0.0 * t, 0.0 * t)), **others)


def test_errors_per_second_are_those_of_speed():
    figures = score(along_x(1.1), along_x(1.0)).figures
    assert figures["rpe_per_s.position_rmse"] == pytest.approx(0.1)
    assert figures["rpe_per_s.pieces"] == 10
    assert figures["rpe_per_m.position_max"] == pytest.approx(0.1, abs=1e-6)
    assert figures["ape.position_max"] == pytest.approx(1.0)
    assert figures["ape.rotation_max"] == 0.0


def test_no_piece_of_a_second_spans_a_gap():
    whole = along_x(1.1, 20.0)
    kept = (whole.t < 5.05) | (whole.t > 14.95)
    figures = score(Trajectory(whole.t[kept], whole.poses[kept]), along_x(1.0, 20.0)).figures
    assert figures["rpe_per_s.pieces"] == 10
    assert figures["rpe_per_s.position_max"] == pytest.approx(0.1)


def test_the_alignment_is_that_of_the_frames():
    space = in_space(*curve())
    turn = Rotation.from_rotvec((0.3, -0.2, 1.0)).as_matrix()
    moved = replace(space, positions=2.0 * space.positions @ turn.T + (1.0, 2.0, 3.0), rotations=turn @ space.rotations)
    found = score(space, moved, align="sim3")
    assert found.transform.scale == pytest.approx(2.0)
    assert found.transform.rotation == pytest.approx(turn)
    assert found.transform.translation == pytest.approx((1.0, 2.0, 3.0))
    assert found.figures["ape.position_max"] == pytest.approx(0.0, abs=1e-12)


def test_an_alignment_by_yaw_turns_about_the_vertical_alone():
    """Of a path that is turned, moved and raised nothing is left; of one that is tilted the tilt is left."""
    space = in_space(*curve())
    turn, tilt = (Rotation.from_rotvec(v).as_matrix() for v in ((0.0, 0.0, 1.0), (0.1, 0.0, 0.0)))
    moved = replace(space, positions=space.positions @ turn.T + (1.0, 2.0, 3.0), rotations=turn @ space.rotations)
    assert score(space, moved, align="yaw").figures["ape.position_max"] == pytest.approx(0.0, abs=1e-12)
    tilted = replace(space, positions=space.positions @ tilt.T, rotations=tilt @ space.rotations)
    figures = score(space, tilted, align="yaw").figures
    assert figures["ape.rotation_max"] == pytest.approx(0.1, abs=0.02)
    assert figures["ape.position_rmse"] > score(space, tilted, align="se3").figures["ape.position_rmse"] + 1e-3


def test_an_alignment_by_the_first_poses():
    """A path that is half as long again after its fifth second is right until then."""
    truth, drifting = along_x(1.0, 10.0), along_x(1.0, 10.0)
    late = np.maximum(drifting.t - 5.0, 0.0)
    poses = drifting.poses + np.column_stack((0.5 * late + 3.0, 0.0 * late, 0.0 * late))
    found = score(replace(drifting, poses=poses), truth, align="se2", align_poses=50)
    assert found.transform.translation[0] == pytest.approx(-3.0)
    assert found.figures["ape.position_max"] == pytest.approx(2.5)
    refusal(lambda: score(drifting, truth, align_poses=50), "align_poses is 50")


def test_relative_errors_over_other_pieces():
    figures = score(along_x(1.1), along_x(1.0), delta=["5m", "2s"]).figures
    assert figures["rpe_5m.position_rmse"] == pytest.approx(0.5, abs=0.05)
    assert figures["rpe_2s.position_rmse"] == pytest.approx(0.2)
    assert figures["rpe_2s.pieces"] == 5
    refusal(lambda: score(along_x(), along_x(), delta=["2 h"]), "delta is '2 h'")


def in_space(t, positions, rotations):
    return PosePath("path", positions, rotations, absolute(t, 0))


def curve(count=40):
    t = np.arange(count) / 10
    positions = np.column_stack((np.cos(t), np.sin(2.0 * t), 0.5 * np.sin(t)))
    return t, positions, Rotation.from_rotvec(np.outer(t, (0.1, 0.0, 1.0))).as_matrix()


def test_a_plane_is_seen_from_above():
    t, positions, rotations = curve()
    heading = np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])
    planar = Trajectory(t, np.column_stack((positions[:, :2], heading)))
    figures = score(planar, in_space(t, positions + np.array((5.0, 1.0, 0.7)), rotations), align="se2").figures
    assert figures["ape.position_max"] == pytest.approx(0.0, abs=1e-9)
    assert figures["ape.rotation_max"] == pytest.approx(0.0, abs=1e-7)
    found = score(planar, in_space(t, positions + np.array((0.0, 0.0, 5.0)), rotations))
    assert tuple(map(str, found.warnings)) == (
        "estimate is planar, and reference is up to 5.5 m above or below it. Errors include the difference in height: "
        "set align se2 or associate interpolate to exclude it",
    )


def test_positions_without_headings_have_absolute_errors_only():
    bare = along_x(has_heading=False)
    figures = score(along_x(1.1), bare, align="se2").figures
    assert figures["ape.position_rmse"] > 0.0
    assert figures["ape.rotation_rmse"] is figures["rpe_per_m.position_rmse"] is figures["rpe_per_s.pieces"] is None
    with pytest.raises(InputError, match="has no headings, which --align origin needs"):
        score(along_x(), bare, align="origin")


@pytest.mark.parametrize(
    ("estimate", "options", "message"),
    [
        (along_x(), {"align": "se3"}, "its positions lie on a line, so --align se3 has no unique rotation"),
        (along_x(1.0, 0.1), {"align": "se2"}, "2 poses are paired with reference, expected at least 3"),
        (along_x(math.nan), {}, "pose 1 is not finite"),
        (
            Trajectory(along_x().t + 20.0, along_x().poses),
            {},
            "do not overlap in time: estimate 20.000 to 30.000 s and refer",
        ),
        (Trajectory(along_x().t + 0.05, along_x().poses), {}, "no stamp is within 0.01 s of reference"),
    ],
)
def test_what_cannot_be_scored_is_refused(estimate, options, message):
    with pytest.raises(InputError, match=message.replace("(", "\\(")):
        score(estimate, along_x(), **options)
