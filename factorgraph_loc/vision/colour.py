"""The Gaussian colour model: intensity and two opponent colours as linear combinations of red, green and blue.

It is the response, for RGB cameras, of a Gaussian receptive field to a spectrum and its first two derivatives (Geusebroek, van den
Boomgaard, Smeulders, Geerts, "Color invariance", IEEE TPAMI 23(12), 2001, eq. 5).
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.vision.images import Image

Float = NDArray[np.float32]

# rows: E, E_lambda (yellow against blue), E_lambda_lambda (red against green); columns: R, G, B
GAUSSIAN_COLOUR = np.array([[0.06, 0.63, 0.27], [0.30, 0.04, -0.35], [0.34, -0.60, 0.17]])
_FROM_BGR = GAUSSIAN_COLOUR[:, ::-1].astype(np.float32).copy()


def colour_channels(image: Image) -> list[Float]:
    """E, E_lambda, E_lambda_lambda, each (H, W), of a BGR image; a grey image (H, W) gives E only."""
    if image.ndim == 2:
        return [image.astype(np.float32)]
    channels = cv2.split(cv2.transform(image.astype(np.float32), _FROM_BGR))
    return [np.asarray(channel, dtype=np.float32) for channel in channels]
