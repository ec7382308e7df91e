"""Where the parts of a picture are."""

from itertools import combinations

import pytest

from factorgraph_loc.drawing.figures import grid, legend, png_bytes


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
