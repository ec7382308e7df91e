"""`fgloc features evaluate`, from the arguments to the files, on small images."""

import cv2
import numpy as np
import polars as pl
import pytest
from PIL import Image

NAMES = "sift,orb"


@pytest.fixture(scope="module")
def picture():
    """Smooth spots of several sizes, (150, 200)."""
    rng = np.random.default_rng(1)
    layers = [
        cv2.GaussianBlur(rng.random((150, 200)).astype(np.float32), (0, 0), sigma) * sigma for sigma in (1.5, 3.0, 6.0)
    ]
    return np.asarray(cv2.normalize(sum(layers), None, 0, 255, cv2.NORM_MINMAX), dtype=np.uint8)


@pytest.fixture
def images(tmp_path, picture):
    """A folder of one sequence, and a photograph beside it."""
    folder = tmp_path / "images" / "spots"
    folder.mkdir(parents=True)
    matrix = np.array(((0.8, 0.1, 12.0), (-0.1, 0.8, 20.0), (0.0, 0.0, 1.0)))
    cv2.imwrite(str(folder / "img1.png"), picture)
    cv2.imwrite(
        str(folder / "img2.pgm"), cv2.warpPerspective(picture, matrix, (200, 150), borderMode=cv2.BORDER_REFLECT)
    )
    np.savetxt(folder / "H1to2p", matrix)
    cv2.imwrite(str(tmp_path / "photograph.jpg"), picture)
    return folder.parent


def test_results_are_written_and_named(fgloc, images, tmp_path):
    out = tmp_path / "out"
    result = fgloc(
        "features", "evaluate", images, tmp_path / "photograph.jpg", "-o", out, "--features", NAMES, "--count", 100
    )
    assert result.exit_code == 0, result.output
    assert f"results are in {out}: table.md, pairs.parquet, figure3.png" in result.stdout
    assert [line.split()[0] for line in result.stdout.splitlines()[1:3]] == NAMES.split(",")

    pairs = pl.read_parquet(out / "pairs.parquet")
    assert set(pairs["sequence"]) == {
        "spots",
        f"{tmp_path.name}/photograph zoomed",
        f"{tmp_path.name}/photograph rotated",
    }
    assert pairs.height == 2 * (1 + 6 + 6)
    assert pairs["features"].max() == 100
    sift = pairs.filter((pl.col("feature") == "sift") & (pl.col("sequence") == "spots"))
    assert sift["precision"].item() > 0.8

    table = (out / "table.md").read_text()
    assert "Mean over 13 pairs of images" in table
    assert "spots, scale change" not in table  # by 1.24: below what is called one
    with Image.open(out / "figure3.png") as shown:
        assert shown.width == 1600
