"""Evaluation of image localization: a map from some images of a log, and the errors of others against the
reference, by feature.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from factorgraph_loc.drawing.figures import COLOURS, grid, legend
from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.figures import write_picture
from factorgraph_loc.evaluation.tables import markdown
from factorgraph_loc.files.models import write_text
from factorgraph_loc.files.temporary import require_free, writing
from factorgraph_loc.mapping.bends import Bends
from factorgraph_loc.mapping.camera_poses import PosedFrames, posed_frames
from factorgraph_loc.mapping.image_localization import ImageLocalizer, Located
from factorgraph_loc.mapping.point_mapping import PointReport, PointSettings, map_points
from factorgraph_loc.mapping.triangulation import Cameras
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.camera.frontend import with_features
from factorgraph_loc.sensors.camera.prepare import frames_of
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.vision.settings import FrontendSettings
from factors.se2 import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FILES = ("table.md", "images.csv", "images.png")
NEAR, TURNED = 0.05, np.radians(5.0)  # m, rad: an image with smaller errors is located
TURN_SIGMA, SHIFT_SIGMA = 0.002, 0.003  # rad, m: of the reference
METHODS = ("image by image", "graph")
HEADER = ("feature", "images", "method", "located", "position [m]", "angle [degrees]", "p90 [m]", "p90 [degrees]")


@dataclass(frozen=True, eq=False)
class ImageErrors:
    """Errors of a query's images ``frames`` (F,), numbered as in the log: of the camera's centre (F,) [m] and of its rotation
    (F,) [rad], infinite if not located; ``cameras``: estimated poses, NaN likewise."""

    feature: str
    query: str
    method: str
    frames: Sequence[int]
    position: Array
    angle: Array
    cameras: Array

    @property
    def success(self) -> float:
        """The fraction of images with errors below :data:`NEAR` and :data:`TURNED`."""
        return float(np.mean((self.position < NEAR) & (self.angle < TURNED)))

    def cells(self) -> list[str]:
        """The row of a table with :data:`HEADER`."""
        degrees = np.degrees(self.angle)
        numbers = (
            f"{np.median(self.position):.4f}",
            f"{np.median(degrees):.2f}",
            f"{np.percentile(self.position, 90, method='higher'):.3f}",
            f"{np.percentile(degrees, 90, method='higher'):.1f}",
        )
        return [self.feature, self.query, self.method, f"{100.0 * self.success:.0f} %", *numbers]


@dataclass(frozen=True, eq=False)
class ImageResults:
    """All ``outcomes``, the ``maps`` by feature, and the reference poses of the cameras of all images (N, 3)."""

    outcomes: list[ImageErrors]
    maps: Mapping[str, PointReport]
    reference: Array
    warnings: tuple[str, ...]


def evaluate_images(
    log: Log,
    features: Sequence[str],
    count: int,
    mapped: Sequence[int],
    queries: Mapping[str, Sequence[int]],
    progress: Callable[[float], None] = lambda _: None,
) -> ImageResults:
    """Map the images ``mapped`` of a log with their poses, for each of ``features`` (``count`` per image), and locate those of
    each of ``queries``, image by image and all of one query in a graph.

    Poses of queries are used for their errors only. Raises InputError if the log has no such images or poses.
    """
    outcomes: list[ImageErrors] = []
    maps: dict[str, PointReport] = {}
    doubts: list[str] = []
    steps = len(features) * (1 + 2 * len(queries))
    done = 0

    def told(share: float) -> None:
        progress((done + share) / steps)

    for feature in features:
        seen, warnings = with_features(log, FrontendSettings.model_validate({"feature": feature, "count": count}))
        doubts += [one for one in warnings if one not in doubts]
        posed = posed_frames(seen, TURN_SIGMA, SHIFT_SIGMA)
        _check(log, seen, posed, {"map": mapped, **queries})
        made = map_points(
            log.rig.of(CameraSettings).model(),
            posed[np.array(mapped, dtype=np.int64)],
            PointSettings(distance=0.0, angle=0.0, lens=True),
            told,
        )
        maps[feature] = made.report
        localizer = ImageLocalizer(made.points, made.model)
        bends = Bends.of(posed.cameras[list(mapped)], [localizer.one(posed.frames[i]) for i in mapped])
        done += 1
        for query, numbers in queries.items():
            frames = [posed.frames[i] for i in numbers]
            t = np.array([frame.t for frame in frames])
            truth = posed.cameras[list(numbers)]
            ones: list[Located | None] = []
            for frame in frames:
                ones.append(localizer.one(frame))
                told(len(ones) / len(frames))
            done += 1
            both = localizer.all(frames, t, ones, told)
            done += 1
            together = [bends.combined(*pair) for pair in zip(ones, both, strict=True)]
            alone, together = ([bends.in_reference(place) for place in places] for places in (ones, together))
            for method, places in zip(METHODS, (alone, together), strict=True):
                outcomes.append(_outcome(feature, query, method, numbers, places, truth))
    return ImageResults(outcomes, maps, posed.cameras.positions, tuple(doubts))


def check_free(folder: Path, *, overwrite: bool) -> None:
    """Raise InputError if ``folder`` is not a folder, or contains such results already."""
    require_free(folder, FILES, overwrite=overwrite)


def table(results: ImageResults) -> tuple[tuple[str, ...], list[list[str]]]:
    """Header and rows, one per outcome."""
    return HEADER, [outcome.cells() for outcome in results.outcomes]


def write_results(log: str, results: ImageResults, folder: Path) -> None:
    """Write :data:`FILES`: the table, the errors of each image, and a plot of trajectories and errors."""
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        write_text(folder / "table.md", markdown(*table(results)) + "\n")
        write_text(folder / "images.csv", _rows(results).write_csv())
        write_picture(picture(log, results), folder / "images.png")


def picture(log: str, results: ImageResults) -> Figure:
    """Plot the camera positions from the graph, and the errors of all images, one column per query."""
    queries = list(dict.fromkeys(outcome.query for outcome in results.outcomes))
    features = list(results.maps)
    out, axes = grid(3, len(queries), 16.0, f"{log}: images located in a map of points")
    for column, query in enumerate(queries):
        above, position, angle = axes[:, column]
        above.set_title(f"{query}, by the graph from above")
        above.plot(*results.reference[:, :2].T, color="0.75", label="reference", zorder=1)
        for outcome in results.outcomes:
            if outcome.query != query:
                continue
            colour = COLOURS[features.index(outcome.feature) % len(COLOURS)]
            graph = outcome.method == METHODS[-1]
            label = f"{outcome.feature}, {outcome.method}"
            if graph:
                above.plot(*outcome.cameras[:, :2].T, ".", color=colour, label=label, markersize=5)
            style = {"color": colour, "linestyle": "-" if graph else ":", "label": label}
            position.plot(outcome.frames, np.clip(outcome.position, 1e-4, 10.0), **style)
            angle.plot(outcome.frames, np.clip(np.degrees(outcome.angle), 1e-2, 180.0), **style)
        above.set_aspect("equal", adjustable="datalim")
        above.set(xlabel="x [m]", ylabel="y [m]")
        for axis, limit, name in (
            (position, NEAR, "position error [m]"),
            (angle, np.degrees(TURNED), "angle [degrees]"),
        ):
            axis.axhline(limit, color="0.4", linestyle="--")
            axis.set(yscale="log", xlabel="image", ylabel=name)
    legend(out, axes.flat)
    return out


def _check(log: Log, seen: Log, posed: PosedFrames, numbers: Mapping[str, Sequence[int]]) -> None:
    """Raise InputError for image numbers out of range, or images without a pose."""
    count = len(frames_of(seen)[0])
    if len(posed.frames) != count:
        raise InputError(f"{log.name}: {count - len(posed.frames)} of {count} images have no pose")
    for name, wanted in numbers.items():
        if not wanted or min(wanted) < 0 or max(wanted) >= count:
            raise InputError(f"{log.name}: {name} asks for images {_span(wanted)}, expected some of 0 to {count - 1}")


def _span(wanted: Sequence[int]) -> str:
    return f"{min(wanted)} to {max(wanted)}" if wanted else "of an empty range"


def _outcome(
    feature: str, query: str, method: str, numbers: Sequence[int], places: Sequence[Located | None], truth: Cameras
) -> ImageErrors:
    position, angle = np.full(len(places), np.inf), np.full(len(places), np.inf)
    cameras = np.full((len(places), 3), np.nan)
    for i, place in enumerate(places):
        if place is not None:
            cameras[i] = place.position
            position[i] = np.linalg.norm(place.position - truth.positions[i])
            cosine = (np.trace(place.rotation.T @ truth.rotations[i]) - 1.0) / 2.0
            angle[i] = np.arccos(np.clip(cosine, -1.0, 1.0))
    return ImageErrors(feature, query, method, numbers, position, angle, cameras)


def _rows(results: ImageResults) -> pl.DataFrame:
    """One row per image and outcome."""
    return pl.concat(
        pl.DataFrame(
            {
                "feature": [one.feature] * len(one.frames),
                "query": [one.query] * len(one.frames),
                "method": [one.method] * len(one.frames),
                "image": list(one.frames),
                "position_error": one.position,
                "angle_error": one.angle,
            }
        )
        for one in results.outcomes
    )
