"""Export of a map of points as PLY (G. Turk, "The PLY polygon file format", 1994), which viewers of point clouds read."""

from pathlib import Path

import numpy as np

from factorgraph_loc.files.models import write_text
from factorgraph_loc.files.temporary import writing
from factorgraph_loc.maps.points import PointMap
from factors.positive import worst_sigma

HEADER = """ply
format ascii 1.0
comment points of a map in metres; sigma: standard deviation in the worst direction; views: stored views of a point
element vertex {count}
property double x
property double y
property double z
property double sigma
property int views
end_header
"""


def write_ply(points: PointMap, path: Path) -> None:
    """Write the positions of points, with the standard deviation in the worst direction [m] and the number of their views."""
    sigma = worst_sigma(points.covariances)
    views = np.bincount(points.owners, minlength=len(points))
    rows = zip(points.positions.tolist(), sigma.tolist(), views.tolist(), strict=True)
    body = "".join(f"{x:.6f} {y:.6f} {z:.6f} {s:.6f} {count}\n" for (x, y, z), s, count in rows)
    with writing(path):
        write_text(path, HEADER.format(count=len(points)) + body)
