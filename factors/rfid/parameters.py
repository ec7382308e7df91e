"""The parameters of the likelihood of RFID reads. They adapt detection models, antenna mounting and clock to an installation.

Each detection model has two parameters, because power, cables and kinds of tags differ. ``a`` is the logarithm of a
factor of the range. ``b`` is a shift of the logit of the largest read probability ``peak``. The read probability ``p(x,
y, z)`` of a tag in the antenna's frame becomes

    rate * p(x / scale, y / scale, z),    scale = exp(a),    rate = sigmoid(logit(peak) + b) / peak.

For a beam model this changes ``r_max`` and ``s_r`` in proportion, and ``p0``.

The parameters of M models and A antennas are a vector (Q,) with Q = 2 M + A + 2. Its elements are ``a`` and ``b`` of
each model, the common change of yaw [rad] of all antennas, the additional change of yaw of each antenna, and the time
offset [s] that is added to the timestamps. Zeros change nothing.
"""

import math

import numpy as np

from factors.compiled import compiled
from factors.rfid.model import Packed
from factors.se2 import Array

OF_MODEL = ("range_scale", "read_rate")  # names of the parameters a and b of a detection model
MOST_CERTAIN = 0.99  # limit of the peak of a model, because a shift of the logit hardly changes a larger peak


@compiled
def rate_of(peak: float, shift: float) -> float:
    """Return the factor of a model's read probabilities that shifts the logit of the largest one, ``peak``, by
    ``shift``. The shift is the parameter b of a detection model, see :mod:`factors.rfid.parameters`."""
    certain = min(peak, MOST_CERTAIN)
    return float(1.0 / (certain + (1.0 - certain) * math.exp(-shift)))


@compiled
def adjusted(packed: Packed, parameters: Array) -> Packed:
    """Apply ``parameters`` (Q,) (range and read rate of each model, yaws of antennas, time offset) to ``packed``, the
    models with all parameters zero. Returns the adjusted models."""
    models, antennas = len(packed.reach), packed.antennas.copy()
    scale, reach, rate = np.empty(models), np.empty(models), np.empty(models)
    for m in range(models):
        scale[m] = math.exp(parameters[2 * m])
        reach[m] = packed.reach[m] * scale[m]
        rate[m] = rate_of(packed.peak[m], parameters[2 * m + 1])
    for row, turn in zip(antennas, parameters[2 * models + 1 :]):  # noqa: B905 - compiled
        c, s = math.cos(parameters[2 * models] + turn), math.sin(parameters[2 * models] + turn)
        row[3], row[4] = c * row[3] - s * row[4], s * row[3] + c * row[4]
    return Packed(
        antennas,
        packed.which,
        packed.kinds,
        packed.parameters,
        packed.shapes,
        packed.knots,
        reach,
        packed.false_read,
        packed.span,
        scale,
        rate,
        packed.peak,
        parameters[-1:].copy(),
        packed.fixed,
    )
