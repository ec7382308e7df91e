"""Each estimator on short logs with several faults: a sound result, or one line that refuses it."""

from itertools import cycle

import numpy as np
import pytest
from absurd_logs import FAULTS, verdict, whole
from hypothesis import given
from hypothesis import strategies as st
from refusals import examples
from test_calls import ESTIMATORS

pytestmark = pytest.mark.filterwarnings("ignore")
SENSORS = (None, ("odometry",), ("odometry", "bearing_range"), ("odometry", "rfid"))
PRIORS = (None, "reference", "log", "unknown", "0,0,0", "10,6", "1e5,-1e5,3")

BEYOND = ("glitch_beyond_bounds", "clocks_years_apart")  # the bounds of their columns, or of a log's length


# each fault with one of the estimators; of landmarks in no map, some logs give no place
@pytest.mark.parametrize(
    ("fault", "estimator"),
    list(zip(FAULTS, cycle(e for e in ESTIMATORS if "landmarks" not in e[1]), strict=False)),
)
def test_a_log_with_a_fault_is_survived(fault, estimator):
    result = verdict(FAULTS[fault](whole(), np.random.default_rng(len(fault))), *estimator)
    assert result == ("refused" if fault in BEYOND else "ok")


@examples(cost=4)
@given(
    faults=st.lists(st.sampled_from(sorted(FAULTS)), min_size=1, max_size=3),
    seed=st.integers(0, 2**32 - 1),
    estimator=st.sampled_from(ESTIMATORS),
    sensors=st.sampled_from(SENSORS),
    prior=st.sampled_from(PRIORS),
)
def test_faults_come_together(faults, seed, estimator, sensors, prior):
    log, rng = whole(), np.random.default_rng(seed)
    for fault in faults:
        if all(len(stream.t) > 5 for stream in log.streams.values()):
            log = FAULTS[fault](log, rng)
    verdict(log, *estimator, sensors, prior)
