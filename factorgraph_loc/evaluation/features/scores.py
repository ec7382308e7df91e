"""Scores of features on several sequences of images as tables, files and plots (among them figure 3 of the paper)."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from collections.abc import Sequence as Several
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
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
OURS = "colour"

# columns of the table: key of the rows, digits
COLUMNS = {
    "features": ("features", 0),
    "repeatability": ("repeatability", 3),
    "strict": ("strict", 3),
    "matching score": ("matching_score", 3),
    f"precision at {RATIO:g}": ("precision", 3),
    "time [ms]": ("milliseconds", 1),
}
_MARKERS = ("o", "s", "^", "v", "D", "P", "X")

Row = dict[str, Any]


@dataclass(frozen=True)
class FeatureScores:
    """``rows``: one per feature and pair of images, with the fields of
    :class:`~factorgraph_loc.evaluation.features.feature_evaluation.PairScores`."""

    rows: list[Row]

    def names(self) -> list[str]:
        """The features, in the order of the rows."""
        return list(dict.fromkeys(row["feature"] for row in self.rows))

    def sequences(self) -> list[str]:
        """The names of the sequences, in the order of the rows."""
        return list(dict.fromkeys(row["sequence"] for row in self.rows))

    def of(self, name: str, sequences: Several[str]) -> list[Row]:
        """The rows of one feature on some sequences."""
        return [row for row in self.rows if row["feature"] == name and row["sequence"] in sequences]


def evaluate_all(
    sequences: Several[Sequence], features: Several[Feature], progress: Callable[[float, float], None]
) -> FeatureScores:
    """The scores of each feature on each sequence; ``progress`` is called with the number of images done, and of all."""
    total = len(features) * sum(1 + len(sequence.others) for sequence in sequences)
    done = itertools.count(1)
    return FeatureScores(
        [
            pair.row()
            for sequence in sequences
            for feature in features
            for pair in evaluate(sequence, feature, lambda: progress(next(done), total))
        ]
    )


def write_scores(scores: FeatureScores, out: Path) -> None:
    """Write :data:`FILES` into ``out``: tables, the scores of all pairs, and the plot of repeatability."""
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        write_text(out / "table.md", tables(scores))
        frame = pl.DataFrame(scores.rows).with_columns(pl.col(pl.Float64).fill_nan(None))
        write_parquet(frame, out / "pairs.parquet")
        write_picture(figure3(scores), out / "figure3.png")


def summary(scores: FeatureScores, sequences: Several[str] | None = None) -> tuple[list[str], list[list[str]]]:
    """Header and rows of a table of features: means over the pairs of ``sequences`` (None: of all), but medians of times.

    A dash stands for a score that the feature does not have.
    """
    chosen = scores.sequences() if sequences is None else sequences
    lines = []
    for name in scores.names():
        rows = scores.of(name, chosen)
        lines.append([name, *(_cell([row[key] for row in rows], key, digits) for key, digits in COLUMNS.values())])
    return ["feature", *COLUMNS], lines


def tables(scores: FeatureScores) -> str:
    """The summary over all, and for each sequence the repeatability of each pair, in Markdown."""
    parts = [
        f"Mean over {len(scores.of(scores.names()[0], scores.sequences()))} pairs of images\n",
        markdown(*summary(scores)),
    ]
    for sequence in scores.sequences():
        rows = [row for row in scores.rows if row["sequence"] == sequence]
        amounts = list(dict.fromkeys((row["image"], row["amount"]) for row in rows))
        header = ["repeatability", *(f"{amount:.3g}" for _, amount in amounts)]
        lines = [
            [name, *(f"{row['repeatability']:.3f}" for row in rows if row["feature"] == name)]
            for name in scores.names()
        ]
        parts += [f"\n{sequence}, {rows[0]['change']}\n", markdown(header, lines)]
    return "\n".join(parts)


def figure3(scores: FeatureScores) -> Any:
    """Plot repeatability over the change between the images, with a row of panels for each sequence.

    Left the competitors, right the colour features, if evaluated, with the range of the competitors. Photographs with the same
    warp are averaged.
    """
    groups = _groups(scores)
    competitors = [name for name in scores.names() if name != OURS]
    both = OURS in scores.names() and bool(competitors)
    figure, axes = grid(len(groups), 1 + both, 4.2 * len(groups) + 1.2, "Repeatability (overlap error below 40 %)")
    for row, (title, members) in zip(axes, groups.items(), strict=True):
        left = {name: _means(scores, name, members) for name in (competitors or scores.names())}
        for name, (x, y) in left.items():
            row[0].plot(x, y, label=_label(name), **_style(name, scores.names()))
        if both:
            x = next(iter(left.values()))[0]
            values = np.array([y for _, y in left.values()])
            row[1].fill_between(x, values.min(axis=0), values.max(axis=0), color="0.88", label="range of the others")
            row[1].plot(*_means(scores, OURS, members), label=OURS, **_style(OURS, scores.names()))
        for axis in row:
            axis.set(title=title, ylim=(0.0, 1.0), xlabel=scores.of(scores.names()[0], members)[0]["change"])
        row[0].set_ylabel("repeatability")
    legend(figure, axes.flat)
    return figure


def _groups(scores: FeatureScores) -> dict[str, list[str]]:
    """Sequences to be plotted together, by title: photographs with the same warps; others alone."""
    groups: dict[tuple[Any, ...], list[str]] = {}
    first = scores.names()[0]
    for sequence in scores.sequences():
        rows = scores.of(first, [sequence])
        change = rows[0]["change"]
        amounts = tuple(row["amount"] for row in rows)
        groups.setdefault((change, amounts, sequence if change == OTHER else ""), []).append(sequence)
    titles = [
        names[0] if len(names) == 1 else f"{len(names)} photographs, {names[0].split()[-1]}"
        for names in groups.values()
    ]
    return dict(zip(titles, groups.values(), strict=True))


def _means(scores: FeatureScores, name: str, sequences: Several[str]) -> tuple[list[float], list[float]]:
    """Amounts of change in ascending order, and the mean repeatability at each."""
    rows = scores.of(name, sequences)
    amounts = sorted({row["amount"] for row in rows})
    return amounts, [float(np.mean([r["repeatability"] for r in rows if r["amount"] == x])) for x in amounts]


def _style(name: str, names: Several[str]) -> dict[str, Any]:
    """The style of a feature, the same in all panels."""
    i = names.index(name)
    marks = {"marker": _MARKERS[i % len(_MARKERS)], "markersize": 7}
    return {"color": COLOURS[i % len(COLOURS)], "linewidth": 2.0, **marks}


def _label(name: str) -> str:
    return "DoG (sift)" if name == "sift" else name


def _cell(values: Several[float], key: str, digits: int) -> str:
    if np.isnan(values).all():
        return "-"
    # first calls of a process and a busy machine cause outliers
    middle = np.median(values) if key == "milliseconds" else np.mean(values)
    return f"{middle:.{digits}f}"
