"""The University of Toronto's "Starry Night" (``starry_night_dataset.mat``): a hand-held stereo camera and inertial unit among 20
known points.

Fields of the file: ``theta_vk_i`` (3, N) is the rotation, as angle times axis, from the vehicle frame to the world (the transpose
of the file's C_vk_i), ``r_i_vk_i`` (3, N) [m] the vehicle's position; ``rho_i_pj_i`` (3, 20) [m] are the points. ``C_c_v`` rotates
from the vehicle frame to the left camera, which is at ``rho_v_c_v`` in the vehicle frame; the right camera is ``b`` to the right of
it. ``y_k_j`` (4, N, 20) [px] are u and v in the left and in the right image, -1 if a point was not seen. ``v_vk_vk_i``,
``w_vk_vk_i`` (3, N) are velocity and turn rate in the vehicle frame.
"""

import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import checks
from factorgraph_loc.files.models import FileModel, parse_model
from factorgraph_loc.io.readers.left_out import not_read
from factorgraph_loc.io.readers.matlab import read_arrays
from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.trajectory3 import Trajectory3
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.camera.stream import RightSightingStream, SightingStream
from factorgraph_loc.sensors.twist.measurement import TwistStream
from factorgraph_loc.sensors.twist.settings import TwistSettings
from factors.camera.model import FORWARD
from factors.se2 import Array, Integers

POINTS = 20
SERIES = ("theta_vk_i", "r_i_vk_i", "w_vk_vk_i", "v_vk_vk_i")
SCALARS = ("cu", "cv", "fu", "fv", "b")
SHAPES: dict[str, tuple[int | None, ...]] = {
    "t": (1, None),
    **dict.fromkeys(SERIES, (3, None)),
    "rho_i_pj_i": (3, POINTS),
    "y_k_j": (4, None, POINTS),
    "C_c_v": (3, 3),
    "rho_v_c_v": (3, 1),
    **dict.fromkeys(("v_var", "w_var"), (3, 1)),
    "y_var": (4, 1),
    **dict.fromkeys(SCALARS, (1, 1)),
}
NOT_SEEN = -1.0
ORTHONORMAL = 1e-3  # tolerance of the camera's rotation matrix
SIZE = (680, 480)  # px of the rectified images, inferred from the pixels
ROBUST = 2.0  # half of the pixel errors are below 0.6, and 1 % above 2.4 of the stated standard deviations


class Options(FileModel):
    """The format has no options."""


def read(path: Path | None, _: Options) -> Log:
    """The run, with points named 1 to 20 and a vehicle in space. InputError names file, field and column (from 1)."""
    if path is None:
        raise InputError("starry_night: the path of starry_night_dataset.mat is missing")
    fields, others = read_arrays(path, SHAPES)
    count = fields["t"].shape[1]
    if count < 2:
        raise InputError(f"{path}: t has {count} columns, expected 2 or more")
    for name in (*SERIES, "y_k_j"):
        if fields[name].shape[1] != count:
            raise InputError(f"{path}: {name} has {fields[name].shape[1]} columns, expected {count} as t has")
    for name, values in fields.items():
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            raise bad_field(path, name, float(values[tuple(bad[0])]), "a finite number", row=int(bad[0, 1]) + 1)
    numbers = np.arange(1, count + 1, dtype=np.int64)
    warnings: list[str] = []
    t_ns = checks.stamps(path, numbers, fields["t"][0])
    keep = checks.in_order(path, numbers, t_ns, warnings)
    t0_ns = int(t_ns[0])
    t = checks.seconds(t_ns[keep], t0_ns)
    turns, positions, w, v = (fields[name][:, keep].T for name in SERIES)
    pixels = fields["y_k_j"][:, keep]
    _check_pixels(path, pixels, numbers[keep])
    rows, columns = np.nonzero(np.all(pixels != NOT_SEEN, axis=0))
    names = [str(j + 1) for j in columns.tolist()]
    left_u, left_v, right_u, right_v = pixels[:, rows, columns]
    return Log(
        name=path.stem,
        rig=_rig(path, fields, t),
        world=World(
            name="starry_night", points=PointMap.of([str(j + 1) for j in range(POINTS)], fields["rho_i_pj_i"].T.copy())
        ),
        streams={
            "twist": TwistStream(t, v, w),
            "sightings": SightingStream(t[rows], names, left_u, left_v),
            "sightings_right": RightSightingStream(t[rows], names, right_u, right_v),
        },
        reference3=Trajectory3(t, positions, Rotation.from_rotvec(turns).as_matrix()),
        t0_ns=t0_ns,
        warnings=tuple(warnings),
        metadata=not_read(others),
    )


def _check_pixels(path: Path, pixels: Array, numbers: Integers) -> None:
    """InputError unless pixels (4, N, 20) are in the image, or all four coordinates of a point are -1."""
    width, height = SIZE
    limits = np.array((width, height, width, height))[:, None, None]
    unseen = pixels == NOT_SEEN
    bad = np.argwhere((~unseen & ((pixels < 0.0) | (pixels >= limits))) | (unseen != unseen.all(axis=0)))
    if len(bad):
        i, k, j = (int(x) for x in bad[0])
        value, expected = float(pixels[i, k, j]), f"0 to {int(limits[i, 0, 0]) - 1} px, or -1 in all four if not seen"
        raise bad_field(path, f"y_k_j of point {j + 1}", value, expected, row=int(numbers[k]))


def _rig(path: Path, fields: dict[str, Array], t: Array) -> Rig:
    """Both cameras and the noise of the file. Variances of velocities are per row, which gives a random walk. One standard
    deviation is used for u and v. As pixels of one image are off by nearly the same from the poses of the motion capture, it is
    that of the camera's orientation too."""
    fu, fv, cu, cv, b = (float(fields[name][0, 0]) for name in ("fu", "fv", "cu", "cv", "b"))
    if min(fu, fv, b) <= 0.0:
        raise InputError(f"{path}: fu, fv, b are {fu:g}, {fv:g}, {b:g}, expected more than 0")
    for name in ("v_var", "w_var", "y_var"):
        if fields[name].min() <= 0.0:
            raise bad_field(path, name, float(fields[name].min()), "more than 0")
    turn = fields["C_c_v"]
    off = float(np.abs(turn @ turn.T - np.eye(3)).max())
    if off > ORTHONORMAL or np.linalg.det(turn) < 0.0:
        raise InputError(f"{path}: C_c_v is not a rotation (off by {off:.3g})")
    yaw, pitch, roll = Rotation.from_matrix(turn.T @ FORWARD.T).as_euler("ZYX").tolist()
    step = float(np.mean(np.diff(t)))
    shift, turns = (np.sqrt(fields[name][:, 0] * step).tolist() for name in ("v_var", "w_var"))

    def camera(to_the_right: float) -> CameraSettings:
        x, y, z = (fields["rho_v_c_v"][:, 0] + to_the_right * turn[0]).tolist()
        sigma = float(np.sqrt(fields["y_var"].mean()))
        lens = {"width": SIZE[0], "height": SIZE[1], "fx": fu, "fy": fv, "cx": cu, "cy": cv}
        place = {"x": x, "y": y, "z": z, "roll": roll, "pitch": pitch, "yaw": yaw}
        wobble = dict.fromkeys(("roll", "pitch", "yaw"), sigma / math.sqrt(fu * fv))
        settings = {**lens, **place, "pixel_sigma": sigma, "robust": ROBUST, "uncertainty": wobble}
        return parse_model(CameraSettings, settings, path)

    return Rig(
        name="starry_night",
        sensors=("twist", "sightings", "sightings_right"),
        twist=parse_model(TwistSettings, {"shift": shift, "turn": turns}, path),
        camera=camera(0.0),
        camera_right=camera(b),
    )
