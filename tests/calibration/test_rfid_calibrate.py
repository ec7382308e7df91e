"""A whole calibration of logs with reads of tags, with an estimator whose ANEES is a known function of the tempering."""

import pytest

from factorgraph_loc.calibration.calibrate import calibrate
from factorgraph_loc.io.native.rig_file import read_rig, write_rig
from factorgraph_loc.sensors.rfid.settings import BeamSettings, RfidSettings


def scores(tempering, ideal):
    anees = 3.0 * (tempering / ideal) ** 0.8
    kinds = {f"{kind}.{name}": 0.1 for kind in ("causal", "final") for name in ("position_rmse", "heading_rmse")}
    return kinds | {"causal.anees": anees, "final.anees": anees, "causal.scored": 1000, "final.scored": 1000}


def evaluate(log):
    """Ideal at a tempering of 0.25."""
    return scores(log.rig.rfid.tempering, 0.25)


@pytest.fixture(scope="module")
def logs(read_tags):
    return [read_tags(seed=seed, seconds=70.0) for seed in (1, 2)]


@pytest.fixture(scope="module")
def models():
    """Those that were evaluated, in their order."""
    return []


@pytest.fixture(scope="module")
def found(logs, models, tmp_path_factory):
    """From a rig with a model, which is worth scoring."""

    def noted(log):
        models.append(log.rig.rfid.models)
        return evaluate(log)

    rfid = logs[0].rig.rfid.model_copy(update={"models": {"default": BeamSettings(p0=0.8)}})
    rig = logs[0].rig.model_copy(update={"rfid": rfid})
    return calibrate(logs, noted, rig, grids=tmp_path_factory.mktemp("grids") / "cart")


@pytest.fixture(scope="module")
def found_in_one(logs, tmp_path_factory):
    """From one log, a rig that was read from a file and has no model, and an estimator that is too careful at any tempering."""
    folder = tmp_path_factory.mktemp("grids")
    places = RfidSettings(antennas=logs[0].rig.rfid.antennas)
    write_rig(logs[0].rig.model_copy(update={"rfid": places}), folder / "places.rig.toml")
    rig = read_rig(folder / "places.rig.toml")
    return calibrate(logs[:1], lambda log: scores(log.rig.rfid.tempering, 10.0), rig, grids=folder / "cart")


def test_tempering_makes_the_estimator_consistent(found):
    assert found.consistency["rfid"].reached
    assert found.rig.rfid.tempering == pytest.approx(0.25, rel=0.3)


def test_each_log_is_scored_with_a_rig_from_the_others(found):
    assert len(found.held_out) == 2
    assert len(found.after) == 2


def test_tempering_is_sought_on_logs_that_the_models_have_not_seen(found, models):
    """The model of all logs comes last, for their scores."""
    of_all = found.rig.rfid.models
    assert len(models) > 4
    assert models[:2] == [found.input_rig.rfid.models] * 2
    assert of_all not in models[:-2]
    assert models[-2:] == [of_all, of_all]
    assert found.held_out == found.consistency["rfid"].trial.scores


def test_tempering_is_never_above_what_the_scatter_of_reads_says(found_in_one):
    """Even if an estimator would bear it, and that is no reason to doubt the rig."""
    assert found_in_one.rig.rfid.tempering == pytest.approx(found_in_one.knowledge.found["rfid"].knowledge.share)
    assert found_in_one.consistency["rfid"].trial.causal < 0.5
    assert not any("consistent" in doubt for doubt in found_in_one.doubts)
    assert found_in_one.after == found_in_one.consistency["rfid"].trial.scores
