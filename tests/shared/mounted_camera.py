"""A camera with a distorting lens, mounted obliquely on a robot."""

import numpy as np

from factors.camera.model import CameraModel, mounting

MODEL = CameraModel(
    500.0,
    510.0,
    319.5,
    239.5,
    640,
    480,
    distortion=(-0.1, 0.02, 0.001, -0.002),
    position=np.array((0.2, -0.05, 0.8)),
    rotation=mounting(0.02, -0.1, 0.3),
    sigma=0.7,
)
