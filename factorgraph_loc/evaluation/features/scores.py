"""Scores of point features on several sequences of images, as tables, files and plots, such as figure 3 of the paper.

The table of scores has a row for each feature and pair of images, and the columns of
:func:`~factorgraph_loc.evaluation.features.feature_evaluation.evaluate`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from collections.abc import Sequence as Several
from pathlib import Path
from typing import Any

import polars as pl

from factorgraph_loc.drawing.figures import COLOURS, grid, legend
from factorgraph_loc.evaluation.features.feature_evaluation import Feature, evaluate
from factorgraph_loc.evaluation.features.sequences import OTHER, Sequence
from factorgraph_loc.evaluation.figures import write_picture
from factorgraph_loc.evaluation.tables import markdown
from factorgraph_loc.files.models import write_text
from factorgraph_loc.files.tables import write_parquet
from factorgraph_loc.files.temporary import writing
from factorgraph_loc.vision.matching import RATIO

FILES = ("table.md", "pairs.parquet", "figure3.png")

# columns of the printed table: header and digits of each score
COLUMNS = {
    "features": ("features", 0),
    "repeatability": ("repeatability", 3),
    "strict": ("strict", 3),
    "matching_score": ("matching score", 3),
    "precision": (f"precision at {RATIO:g}", 3),
    "milliseconds": ("time [ms]", 1),
}
_MARKERS = ("o", "s", "^", "v", "D", "P", "X")


def evaluate_all(
    sequences: Several[Sequence], features: Several[Feature], progress: Callable[[float, float], None]
) -> pl.DataFrame:
    """Return a table with the scores of each feature on each pair of images of each sequence. Missing scores are null.

    The columns are the keys of :func:`~factorgraph_loc.evaluation.features.feature_evaluation.evaluate`. ``progress``
    is called with the number of processed images and the number of all images.
    """
    total = len(features) * sum(1 + len(sequence.others) for sequence in sequences)
    done = itertools.count(1)
    rows = [
        row
        for sequence in sequences
        for feature in features
        for row in evaluate(sequence, feature, lambda: progress(next(done), total))
    ]
    return pl.DataFrame(rows).with_columns(pl.col(pl.Float64).fill_nan(None))


def write_scores(scores: pl.DataFrame, out: Path) -> None:
    """Write tables in Markdown, the table ``scores`` of all pairs of images, and a plot into the folder ``out``."""
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        write_text(out / "table.md", tables(scores))
        write_parquet(scores, out / "pairs.parquet")
        write_picture(figure3(scores), out / "figure3.png")


def summary(scores: pl.DataFrame) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows of a table of the mean scores of each feature over all pairs of images.

    Times are medians, because other processes cause outliers. A dash means that the feature does not have the score.
    ``scores``: a row for each pair of images and feature, from :func:`evaluate_all`.
    """
    lines = []
    for name in scores["feature"].unique(maintain_order=True):
        rows = scores.filter(pl.col("feature") == name)
        means: dict[str, Any] = {
            key: rows[key].median() if key == "milliseconds" else rows[key].mean() for key in COLUMNS
        }
        cells = ["-" if means[key] is None else f"{means[key]:.{digits}f}" for key, (_, digits) in COLUMNS.items()]
        lines.append([name, *cells])
    return ["feature", *(header for header, _ in COLUMNS.values())], lines


def tables(scores: pl.DataFrame) -> str:
    """Return tables in Markdown: a summary over all pairs of images, and the repeatability of each pair by sequence."""
    pairs = scores.select("sequence", "image").n_unique()
    parts = [f"Mean over {pairs} pairs of images\n", markdown(*summary(scores))]
    for sequence in scores["sequence"].unique(maintain_order=True):
        rows = scores.filter(pl.col("sequence") == sequence)
        lines, amounts = [], []
        for (name,), of_feature in rows.group_by("feature", maintain_order=True):
            amounts = [f"{amount:.3g}" for amount in of_feature["amount"]]
            lines.append([str(name), *(f"{value:.3f}" for value in of_feature["repeatability"])])
        parts += [f"\n{sequence}, {rows['change'][0]}\n", markdown(["repeatability", *amounts], lines)]
    return "\n".join(parts)


def figure3(scores: pl.DataFrame) -> Any:
    """Return a figure of repeatability over the amount of change, with a panel for each sequence of images. Sequences
    that were made from different photographs by the same changes share a panel, and their scores are averaged."""
    panels = _panels(scores)
    names = scores["feature"].unique(maintain_order=True).to_list()
    figure, axes = grid(len(panels), 1, 3.6 * len(panels) + 1.2)
    for axis, (title, rows) in zip(axes.flat, panels.items(), strict=True):
        for i, name in enumerate(names):
            of_feature = rows.filter(pl.col("feature") == name)
            means = of_feature.group_by("amount").agg(pl.col("repeatability").mean()).sort("amount")
            style = {"color": COLOURS[i % len(COLOURS)], "marker": _MARKERS[i % len(_MARKERS)], "markersize": 7}
            axis.plot(means["amount"], means["repeatability"], linewidth=2.0, label=name, **style)
        axis.set(title=title, ylim=(0.0, 1.0), xlabel=rows["change"][0], ylabel="repeatability")
    legend(figure, axes.flat)
    return figure


def _panels(scores: pl.DataFrame) -> dict[str, pl.DataFrame]:
    """Return {title of a panel: its rows of ``scores``}. Sequences made by the same changes share a panel."""
    members: dict[tuple[Any, ...], list[str]] = {}
    for sequence in scores["sequence"].unique(maintain_order=True):
        rows = scores.filter(pl.col("sequence") == sequence)
        change, amounts = rows["change"][0], tuple(rows["amount"].unique(maintain_order=True))
        members.setdefault((change, amounts, sequence if change == OTHER else ""), []).append(sequence)
    panels = {}
    for names in members.values():
        title = names[0] if len(names) == 1 else f"{len(names)} photographs, {names[0].split()[-1]}"
        panels[title] = scores.filter(pl.col("sequence").is_in(names))
    return panels
