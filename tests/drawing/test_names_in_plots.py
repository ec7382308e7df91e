"""Names that others gave stand in plots as they are, and make file names that every file system takes."""

import warnings

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
