"""``fgloc map`` of 3-D points that a camera sees."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from factorgraph_loc.cli import show
from factorgraph_loc.errors import InputError

if TYPE_CHECKING:
    from factorgraph_loc.calibration.point_mapping import PointReport
    from factorgraph_loc.log import Log

TURN_SIGMA, SHIFT_SIGMA = 0.01, 0.02  # rad, m: of a reference without covariances
OF_CAMERA = ("camera", "sightings")


@dataclass(frozen=True)
class PointOptions:
    """The options of the command that points take."""

    poses: str | None
    prior: str | None
    json: bool


def map_log(log: Log, options: PointOptions, out: Path, picture: Path) -> None:
    """Make the map of the points in a log's images, write it and its picture, and say what was found."""
    from factorgraph_loc.calibration.camera_poses import posed_frames
    from factorgraph_loc.calibration.map_figure import point_figure
    from factorgraph_loc.calibration.point_mapping import map_points
    from factorgraph_loc.evaluation.figures import save
    from factorgraph_loc.files import replacing
    from factorgraph_loc.vision.frontend import with_features
    from factorgraph_loc.world import write_world

    camera = log.rig.camera
    if camera is None:
        raise InputError(f"{log.name}: its rig {log.rig.name} has no [camera], so that its images cannot be mapped")
    if "camera" not in log.streams:
        raise InputError(f"{log.name}: has no images (camera), so that there are no points to map")
    log, frame = _posed(log, options)
    with show.progress("features", counted=False) as report:
        seen, warnings = with_features(log, camera.frontend, lambda share: report(share, 1.0))
    posed = posed_frames(seen, TURN_SIGMA, SHIFT_SIGMA)
    with show.progress("points", counted=False) as report:
        made = map_points(camera.model(), posed, progress=lambda share: report(share, 1.0))
    world = log.world.model_copy(update={"name": f"{log.name}-map", "points": made.points})
    try:
        with replacing(picture) as temporary:
            save(point_figure(log.name, made.points, posed.cameras.positions, world.walls), temporary)
        write_world(world, out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from error
    for warning in (*log.warnings, *warnings):
        show.note(f"warning: {warning}")
    if options.json:
        show.document(asdict(made.report) | {"frame": frame, "files": {"map": str(out), "picture": str(picture)}})
        return
    for line in _lines(made.report):
        typer.echo(line)
    typer.echo(f"the frame of the new map is {frame}")
    typer.echo(f"\nthe map is in {out}, a picture of it in {picture}")


def _posed(log: Log, options: PointOptions) -> tuple[Log, str]:
    """The log with poses as its reference, and the frame in words."""
    if options.poses not in (None, "reference", "odometry"):
        raise InputError(f"--poses is {options.poses!r}, expected reference or odometry")
    has_reference = log.reference is not None or log.reference3 is not None
    if options.poses == "reference" or (options.poses is None and has_reference):
        return log, "that of the reference"
    return _smoothed(log, options.prior)


def _smoothed(log: Log, prior: str | None) -> tuple[Log, str]:
    """The log with the smoother's final trajectory, from all sensors but the camera, in place of its reference.

    Its covariances say how well each pose is known, so that images of a place that is visited again still draw it together.
    """
    from dataclasses import replace

    from factorgraph_loc.cli.mapping import started_exactly
    from factorgraph_loc.experiments.run import RunConfig, run

    others = tuple(name for name in log.rig.sensors if name in log.streams and name not in OF_CAMERA)
    started, frame = started_exactly(log, prior)
    blind = replace(started, streams={name: s for name, s in log.streams.items() if name not in OF_CAMERA})
    with show.progress("smoother", counted=False) as report:
        result = run(blind, RunConfig("smoother", sensors=others, prior="log"), lambda share: report(share, 1.0))
    for warning in result.warnings:
        show.note(f"warning: {warning}")
    return replace(log, reference=result.final, reference3=None), f"that of the start: {frame}"


def _lines(report: PointReport) -> tuple[str, ...]:
    return (
        f"{report.points} points are in the new map, with {report.observations} observations in {report.keyframes} keyframes",
        f"reprojection residual: {report.rms:.2f} px root mean square, {report.mad:.2f} px median",
        f"parallax {report.parallax:.3f} rad, standard deviation in the worst direction {report.sigma:.3f} m (medians)",
        f"the cameras were moved by {report.shifted:.3f} m and {report.turned:.4f} rad (medians)",
    )
