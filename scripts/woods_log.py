"""Reader of "Lost in the Woods" of the University of Toronto (``dataset2.mat``): wheel odometry, and a laser that detects known
tree trunks."""

from pathlib import Path

import numpy as np
from scipy.io import loadmat

from factorgraph_loc.files import checks
from factorgraph_loc.files.shipped import rigs
from factorgraph_loc.io.native.rig_file import read_rig
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeStream, Landmark
from factorgraph_loc.sensors.odometry.measurement import VelocityStream
from factors import se2

ABOUT = {
    "title": '"Lost in the Woods": wheel odometry and a laser among 17 landmarks',
    "licence": "BSD-3-Clause (licence of the repository that holds it)",
    "origin": 'University of Toronto, data sets of the course on state estimation, set 2, "Lost in the Woods"',
}


def read_woods(path: Path, max_range: float) -> Log:
    """Read the log, with the sightings of landmarks nearer than ``max_range`` [m]. The time 0 is that of the first row."""
    with path.open("rb") as file:
        fields = loadmat(file)
    t_ns = checks.stamps(path, np.arange(1, len(fields["t"]) + 1), fields["t"][:, 0])
    t = checks.seconds(t_ns, int(t_ns[0]))
    v, w, x, y, heading, valid = (fields[n][:, 0] for n in ("v", "om", "x_true", "y_true", "th_true", "true_valid"))
    ranges, bearings = fields["r"], fields["b"]  # (N, 17); the range is 0 if the landmark is not detected
    row, column = np.nonzero((ranges > 0.0) & (ranges < max_range))
    names = [str(k + 1) for k in column.tolist()]
    known = valid > 0
    return Log(
        name=f"woods-r{max_range:g}",
        rig=read_rig(rigs()["woods"]),
        world=World(
            name="woods",
            landmarks={str(i): Landmark(x=x, y=y) for i, (x, y) in enumerate(fields["l"].tolist(), start=1)},
        ),
        streams={
            "odometry": VelocityStream(t, v, w),
            "bearing_range": BearingRangeStream(t[row], names, ranges[row, column], se2.wrap(bearings[row, column])),
        },
        reference=Trajectory(t[known], np.column_stack((x[known], y[known], se2.wrap(heading[known])))),
        t0_ns=int(t_ns[0]),
        metadata=ABOUT,
    )
