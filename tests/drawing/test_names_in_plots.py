"""Names that others gave stand in plots as they are, and make file names that every file system takes."""

import warnings
from itertools import combinations

import numpy as np
import pytest

from factorgraph_loc.drawing.figures import drawing, grid, legend, png_bytes
from factorgraph_loc.files.models import file_name

NAMES = ["a $x^{$ b", "$$", r"\frac$", "n" * 3000, "", "_hidden", "a_b\\c", "two\nlines" * 50, "\x1b[31m", "廊下", "🤖"]
NAMES += ["\u202e", "caf\udce9", "{x}", "[red]", "'\"<&>"]


@pytest.mark.parametrize("names", [NAMES[i : i + 4] for i in range(0, len(NAMES), 4)])
def test_any_name_can_stand_in_a_plot(names: list[str]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure, axes = grid(2, 2, 8.0, f"{', '.join(names)}: trajectories")
        for name, axis in zip(names, axes.flat, strict=True):
            axis.plot([0.0, 1.0], [1.0, 10.0], label=name)
            axis.plot([0.0, 1.0], [2.0, 10.0], label=f"{name} 2")
            axis.annotate(name, (0.5, 5.0))
            axis.set_title(name)
            axis.set_yscale("log")
        legend(figure, axes.flat)
        assert png_bytes(figure)


def test_a_dollar_is_no_formula() -> None:
    figure, axes = grid(1, 1, 4.0, "from $5 to $6")
    axes[0, 0].plot([0.0, 1.0], [0.0, 1.0], label="$alpha$")
    legend(figure, axes.flat)
    with drawing(figure):
        shown = [figure.texts[0], *figure.legends[0].get_texts()]
        assert [text.get_text() for text in shown] == ["from $5 to $6", "$alpha$"]
        assert not any(text.get_parse_math() for text in shown)


def test_numbers_at_the_axes_are_set_as_before() -> None:
    figure, axes = grid(1, 1, 4.0, "")
    axes[0, 0].plot(np.logspace(0, 3, 4))
    axes[0, 0].set_yscale("log")
    png_bytes(figure)
    assert any(label.get_parse_math() for label in axes[0, 0].get_yticklabels())


def test_file_names_are_short_and_differ_where_long_names_do() -> None:
    assert file_name("hall 3/north.bag") == "hall_3_north.bag"
    for name in NAMES:
        made = file_name(name)
        assert made == file_name(made)
        assert 0 < len(made.encode()) <= 100
        assert not made.startswith(".")
        assert "/" not in made
    assert file_name("n" * 300 + "1") != file_name("n" * 300 + "2")
    assert len(file_name("廊" * 300).encode()) <= 100


@pytest.mark.parametrize(
    ("rows", "columns", "entries", "aspect", "wide"),  # how wide the data are is of no account where the aspect is free
    [
        (1, 1, 1, "equal", 0.2),
        (1, 2, 12, "auto", 30.0),
        (1, 2, 12, "equal", 30.0),
        (3, 2, 0, "equal", 0.2),
        (3, 2, 0, "auto", 30.0),
        (3, 1, 40, "auto", 0.2),
        (3, 1, 40, "equal", 0.2),
        (3, 1, 40, "equal", 30.0),
    ],
)
def test_nothing_overlaps(rows: int, columns: int, entries: int, aspect: str, wide: float) -> None:
    figure, axes = grid(rows, columns, 3.0 * rows + 2.0, "title")
    for axis in axes.flat:
        axis.set(title="panel", xlabel="x [m]", ylabel="y [m]", aspect=aspect)
        for i in range(max(entries, 1)):
            axis.plot([0.0, wide], [-1000.0, 1000.0], label=f"an estimator with number {i}" if entries else None)
    legend(figure, axes.flat)
    png_bytes(figure)
    parts = [*axes.flat, *figure.legends, *figure.texts]
    extents = [part.get_tightbbox() for part in parts]
    for one, other in combinations(extents, 2):
        assert not one.overlaps(other)
    for one in extents:
        assert one.x0 > 0.0
        assert one.y0 > 0.0
        assert one.x1 < figure.bbox.width
        assert one.y1 < figure.bbox.height
