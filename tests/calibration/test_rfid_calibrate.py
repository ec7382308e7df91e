"""A whole calibration of logs with reads of tags, with an estimator whose ANEES is a known function of the tempering."""

import numpy as np
import pytest

from factorgraph_loc.calibration.calibrate import calibrate
from factorgraph_loc.calibration.report import document


def evaluate(log):
    """Ideal at a tempering of 0.25."""
    anees = 3.0 * (log.rig.rfid.tempering / 0.25) ** 0.8
    kinds = {f"{kind}.{name}": 0.1 for kind in ("causal", "final") for name in ("position_rmse", "heading_rmse")}
    return kinds | {"causal.anees": anees, "final.anees": anees, "causal.scored": 1000, "final.scored": 1000}


@pytest.fixture(scope="module")
def found(read_tags, tmp_path_factory):
    logs = [read_tags(seed=seed, seconds=70.0) for seed in (1, 2)]
    return calibrate(logs, evaluate, grids=tmp_path_factory.mktemp("grids") / "cart")


def test_tempering_makes_the_estimator_consistent(found):
    assert found.rfid_consistency.reached
    assert found.rig.rfid.tempering == pytest.approx(0.25, rel=0.3)


def test_each_log_is_scored_with_a_rig_from_the_others(found):
    assert len(found.held_out) == 2
    assert len(found.after) == 2
    assert found.before == ()


def test_the_document_holds_plain_numbers(found):
    import json  # noqa: PLC0415

    back = json.loads(json.dumps(document(found)))
    assert back["rig"]["rfid"]["tempering"] == found.rig.rfid.tempering
    assert np.isfinite([model["held_out_nll"] for model in back["rfid"]["models"]]).all()
