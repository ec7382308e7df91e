"""What tests of commands need not wait for: the start of other processes, and the drawing of pictures.

Comparisons and experiments in processes of their own, and pictures in full, have tests of their own (``tests/test_processes.py``,
``tests/experiments``, ``tests/evaluation/test_plots.py``, ``tests/drawing``), and here those that are marked ``in_full``.
"""

import pytest
from computed_here import Here
from matplotlib.figure import Figure
from PIL import Image

from factorgraph_loc.drawing import figures
from factorgraph_loc.drawing.pages import Picture
from factorgraph_loc.evaluation.report import plots


@pytest.fixture(autouse=True)
def in_short(request):
    """Runs are made in this process, and pictures are a blank line, but for tests that are marked ``in_full``."""
    if request.node.get_closest_marker("in_full") is None:
        request.getfixturevalue("runs_here")
        request.getfixturevalue("blank_pictures")


@pytest.fixture
def runs_here(monkeypatch):
    """Comparisons and experiments make their runs in this process. What would be sent to another is pickled all the same."""
    monkeypatch.setattr("factorgraph_loc.experiments.experiment.Processes", Here)


@pytest.fixture
def blank_pictures(monkeypatch):
    """Figures are made, but neither laid out nor drawn: a picture is one blank line, as wide as it would be."""
    leave_blank(monkeypatch)


def leave_blank(patch):
    """What ``blank_pictures`` does, for fixtures that last longer than a test."""

    def drawn(figure):
        with figures.drawing(figure):
            return Image.new("RGB", (round(figure.get_figwidth() * 100), 1), "white")

    def svg(figure):
        with figures.drawing(figure):
            return Picture.of("image/svg+xml", b"")

    def draw(*_):
        pytest.fail("a figure is drawn after all: blank_pictures has to replace what does it")

    patch.setattr(figures, "_drawn", drawn)
    patch.setattr(plots, "svg", svg)
    patch.setattr(Figure, "draw", draw)
