"""Trajectories with errors, and files of them in the formats of others."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

T0 = 1_403_636_580.0  # s


def wander(seed, count=100, *, flat=False):
    """Times (N,) [s], positions (N, 3) and quaternions (N, 4) of a reference, and of an estimate that drifts in its own frame."""
    rng = np.random.default_rng(seed)
    t = T0 + 0.1 * np.arange(count)
    turns = np.cumsum(rng.normal(0.0, 0.05, (count, 3)), axis=0) * ((0, 0, 1) if flat else (1, 1, 1))
    steps = np.column_stack((rng.uniform(0.05, 0.3, count), *rng.normal(0.0, 0.01, (2, count))))
    steps[:, 2] *= not flat
    rotations = Rotation.from_rotvec(turns)
    positions = np.cumsum(rotations.apply(steps), axis=0)
    frame = Rotation.from_rotvec(rng.normal(0.0, 1.0, 3) * ((0, 0, 1) if flat else (1, 1, 1)))
    drift = np.cumsum(rng.normal(0.0, 0.02, (count, 3)), axis=0) * ((1, 1, 0) if flat else (1, 1, 1))
    wrong = Rotation.from_rotvec(
        np.cumsum(rng.normal(0.0, 0.01, (count, 3)), axis=0) * ((0, 0, 1) if flat else (1, 1, 1))
    )
    moved = 1.1 * frame.apply(positions + drift) + ((4.0, -3.0, 0.0) if flat else (4.0, -3.0, 1.0))
    late = t + rng.uniform(-0.009, 0.009, count)
    return (t, positions, rotations.as_quat()), (late, moved, (frame * rotations * wrong).as_quat())


def write(path: Path, poses) -> Path:
    """A file of poses in the format that the suffix names: .tum, .kitti or .csv (EuRoC)."""
    t, positions, quaternions = poses
    if path.suffix == ".kitti":
        matrices = np.concatenate((Rotation.from_quat(quaternions).as_matrix(), positions[:, :, None]), axis=2)
        np.savetxt(path, matrices.reshape(-1, 12), fmt="%.9e")
    elif path.suffix == ".csv":
        rows = ["#timestamp, p_x [m], p_y [m], p_z [m], q_w [], q_x [], q_y [], q_z [], v_x [m s^-1]\n"]
        for stamp, (x, y, z), (qx, qy, qz, qw) in zip(t, positions, quaternions, strict=True):
            rows.append(
                f"{round(stamp * 1e6)}000,{x:.9f},{y:.9f},{z:.9f},{qw:.12f},{qx:.12f},{qy:.12f},{qz:.12f},0.0\n"
            )
        path.write_text("".join(rows))
    else:
        np.savetxt(path, np.column_stack((t, positions, quaternions)), fmt=["%.6f", *["%.9f"] * 3, *["%.12f"] * 4])
    return path
