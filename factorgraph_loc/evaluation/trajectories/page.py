"""A score as tables, in words, and as a page."""

from __future__ import annotations

from scipy.spatial.transform import Rotation

from factorgraph_loc.drawing.figures import png
from factorgraph_loc.drawing.markup import Html, Rows, image, number, table, tag
from factorgraph_loc.evaluation.report import remark, whole_page
from factorgraph_loc.evaluation.trajectories.figures import plots
from factorgraph_loc.evaluation.trajectories.score import HOW, TrajectoryScore
from factors.se2 import Array

TITLES = {"rmse": "RMSE", "p95": "95 %"}
ERRORS = {
    "absolute position [m]": "ape.position",
    "absolute rotation [rad]": "ape.rotation",
    "position per metre [m]": "rpe_per_m.position",
    "rotation per metre [rad]": "rpe_per_m.rotation",
    "position per second [m]": "rpe_per_s.position",
    "rotation per second [rad]": "rpe_per_s.rotation",
}
EXPLAINED = (
    "Absolute: between poses of the two, after the alignment. Per metre and per second: between the motions of the two over pieces "
    "of that length, not divided by it. Rotations are the angle between two orientations. 95 %: this share of the errors is "
    "smaller; std: their standard deviation."
)
CAPTIONS = {
    "trajectories": "Both trajectories at the compared poses, the estimate after its alignment.",
    "errors": "Absolute errors, and the share of poses whose error is below a value.",
    "relative-errors": "Relative errors over a metre of path and over a second, each at the end of its piece.",
}


def errors_table(score: TrajectoryScore) -> Rows:
    """The statistics of the errors that are defined, a row for each kind."""
    figures = score.figures
    rows = [
        (title, *(number(figures[f"{key}_{how}"]) for how in HOW))
        for title, key in ERRORS.items()
        if figures[f"{key}_rmse"] is not None
    ]
    return ("error", *(TITLES.get(how, how) for how in HOW)), rows


def extents(score: TrajectoryScore) -> dict[str, str]:
    """What was compared with what, how, and by which alignment, in words."""
    told = {}
    for name, path, poses, length in zip(
        ("estimate", "reference"), (score.estimate, score.reference), score.poses, score.lengths, strict=True
    ):
        told[name] = f"{path.name}: {poses} poses, {length:.2f} m"
    t = score.seconds()
    told["pairs"] = f"{len(score.estimate)}, {_association(score)}" + ("" if t is None else f"; {t[-1]:.1f} s")
    pieces = {"metre": score.rpe_per_m, "second": score.rpe_per_s}
    counts = [f"{len(errors.position)} of a {unit}" for unit, errors in pieces.items() if errors is not None]
    if counts:
        overlap = "that may overlap" if score.settings["all_pairs"] else "one after the other"
        told["pieces"] = f"{', '.join(counts)}, {overlap}"
    told["alignment"] = _alignment(score)
    return told


def page(score: TrajectoryScore) -> str:
    """The report as one HTML page."""
    rmse, count = score.figures["ape.position_rmse"], len(score.estimate)
    sections: list[tuple[str, str, list[Html]]] = [
        ("errors", "Errors", [remark(EXPLAINED), table(*errors_table(score), class_="figures")]),
        *(
            (name, name.replace("-", " ").capitalize(), [remark(CAPTIONS[name]), image(png(figure))])
            for name, figure in plots(score).items()
        ),
        ("comparison", "How they were compared", [table(("", ""), extents(score).items())]),
    ]
    if score.warnings:
        sections.append(("warnings", "Warnings", [tag("p", warning) for warning in score.warnings]))
    lead = tag(
        "p",
        f"The position error (RMSE) of {score.estimate.name} is {number(rmse)} m, over {count} poses of {score.reference.name}.",
    )
    body = [
        tag("section", lead, class_="lead", id="summary"),
        *(tag("section", tag("h2", title), *content, id=f"{name}-section") for name, title, content in sections),
    ]
    links = [(f"{name}-section", title) for name, title, _ in sections]
    return whole_page(f"{score.estimate.name} against {score.reference.name}", links, body)


def _association(score: TrajectoryScore) -> str:
    settings = score.settings
    if "max_diff" in settings:
        return f"nearest stamps, at most {settings['max_diff']:g} s apart"
    if "max_gap" in settings:
        return f"estimates interpolated at the stamps of the reference, across at most {settings['max_gap']:g} s"
    return "by the number of the row"


def _alignment(score: TrajectoryScore) -> str:
    how, transform = score.settings["align"], score.transform
    if how == "none":
        return "none"
    turn = Rotation.from_matrix(transform.rotation).as_rotvec()
    told = f"{how}: translation {_vector(transform.translation)} m, rotation vector {_vector(turn)} rad"
    return f"{told}, scale {transform.scale:.5f}" if how == "sim3" else told


def _vector(values: Array) -> str:
    return f"({', '.join(f'{round(value, 4) + 0.0:.4f}' for value in values)})"
