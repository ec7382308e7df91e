"""Fit of the signal strength model to logs with a reference: see :mod:`factors.rfid.signals`."""

import math
from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import gammaln

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.rfid.known_tags import tag_map
from factorgraph_loc.sensors.rfid.settings import RfidSettings, RssiSettings, SurveySettings
from factorgraph_loc.sensors.rfid.stream import along_reference
from factorgraph_loc.text import listed
from factors.rfid.signals import FEATURES, RssiReads, features
from factors.se2 import Array

ENOUGH_READS = 200
ITERATIONS = 30
DOF = (1.0, 100.0)


def fit_rssi(logs: Sequence[Log], rfid: RfidSettings, survey: SurveySettings) -> RssiSettings:
    """Fit the RSSI model to all ``logs`` by maximum likelihood. InputError if a log has no reference, or too few reads have an
    RSSI.

    Signals below the reader's sensitivity are missing, so the path loss is flatter than in free space.
    """
    names = {name: i for i, name in enumerate(rfid.all_antennas())}
    tables, values = list[Array](), list[Array]()
    for log in logs:
        tags = tag_map(log.world, survey)
        stream, rows, _, poses, antenna, tag = along_reference(log, tags.index, names)
        good = np.isfinite(stream.rssi[rows])
        reads = RssiReads(poses[good], antenna[good], tag[good], stream.rssi[rows][good])
        tables.append(features(rfid.model().antennas, tags.tags, np.zeros(3), reads))
        values.append(reads.rssi)
    if (count := sum(map(len, values))) < ENOUGH_READS:
        raise InputError(
            f"{listed(log.name for log in logs)}: hold {count} reads with an RSSI, expected at least {ENOUGH_READS}"
        )
    coefficients, sigma, dof = _fit(np.concatenate(tables).reshape(-1, len(FEATURES)), np.concatenate(values))
    return RssiSettings.bounded(coefficients=tuple(coefficients.tolist()), sigma=sigma, dof=dof)


def _fit(x: Array, y: Array) -> tuple[Array, float, float]:
    """Coefficients, scale and degrees of freedom, by conditional maximisation (Liu, Rubin, Stat. Sinica 5, 1995)."""
    dof, weights = 5.0, np.ones(len(y))
    for _ in range(ITERATIONS):
        root = np.sqrt(weights)
        coefficients: Array = np.linalg.lstsq(x * root[:, None], y * root, rcond=None)[0].astype(float)
        residuals = y - x @ coefficients
        sigma = math.sqrt(np.mean(weights * residuals**2))

        def cost(v: float, ratios: Array = residuals / sigma) -> float:
            dof = math.exp(v)  # mean negative log density of the Student distribution
            scale = gammaln(dof / 2.0) - gammaln((dof + 1.0) / 2.0) + 0.5 * math.log(dof * math.pi)
            return float(scale + 0.5 * (dof + 1.0) * np.mean(np.log1p(ratios**2 / dof)))

        dof = math.exp(minimize_scalar(cost, bounds=np.log(DOF), method="bounded").x)
        weights = (dof + 1.0) / (dof + (residuals / sigma) ** 2)
    return coefficients, sigma, dof
