"""Calibration without a reference: smoothing and learning by turns."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from factorgraph_loc.api.running import run_and_learn
from factorgraph_loc.calibration import report
from factorgraph_loc.calibration.calibrate import calibrate, check
from factorgraph_loc.calibration.held_out import growth
from factorgraph_loc.calibration.learn import learn_by_turns
from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.log import cut
from factorgraph_loc.sensors.rfid.settings import BeamSettings, RfidSettings
from factorgraph_loc.sensors.smoothed import pooled, recordings
from factorgraph_loc.simulation import preset, simulate


def smoothed(log):
    return run(log, RunConfig("smoother"))


def outcome(log, estimator):
    return SimpleNamespace(result=run(log, RunConfig(estimator)))


def with_beam(log, **changes):
    rfid = log.rig.of(RfidSettings)
    models = {"default": rfid.models["default"].model_copy(update=changes)}
    return log.rig.model_copy(update={"rfid": rfid.model_copy(update={"models": models})})


@pytest.fixture(scope="module")
def offices():
    """Two logs of 90 s."""
    return [simulate(preset("office", {"drive": {"duration": 90.0}}), seed) for seed in (1, 2)]


@pytest.fixture(scope="module")
def blind(offices):
    return [replace(log, reference=None) for log in offices]


@pytest.fixture(scope="module")
def learnt(blind, tmp_path_factory):
    """From a rig whose antennas reach 20 % too far, and read too little; one is turned by 0.1 rad, and the clock is 0.06 s late."""
    rig = with_beam(blind[0], r_max=5.4, p0=0.7)
    antennas = dict(rig.rfid.all_antennas())
    antennas["3"] = antennas["3"].model_copy(update={"yaw": antennas["3"].yaw + 0.1})
    changes = {"antennas": antennas, "preset": None, "time_offset": 0.06}
    rig = rig.model_copy(update={"rfid": rig.rfid.model_copy(update=changes)})
    grids = tmp_path_factory.mktemp("grids") / "cart"
    return calibrate(blind, outcome, rig, grids=grids)


def test_the_antennas_are_learnt_without_a_reference(learnt):
    """Each within four standard errors of what made the reads, and these are small."""
    beam = learnt.rig.rfid.models["default"]
    assert isinstance(beam, BeamSettings)
    errors = {c.name.rpartition(".")[2]: c.error for c in learnt.knowledge.constants if c.sensor == "rfid"}
    for name, true in {"p0": 0.9, "r_max": 4.5, "s_r": 0.3, "sigma_phi": 0.698}.items():
        assert getattr(beam, name) == pytest.approx(true, abs=4.0 * errors[name] + 1e-3), name
        assert errors[name] < 0.06 * true, name
    assert learnt.knowledge.turns[-1] < 0.3 < learnt.knowledge.turns[0]


def test_yaw_and_clock_of_antennas_are_learnt_without_a_reference(learnt, blind):
    known = {name: antenna.yaw for name, antenna in blind[0].rig.rfid.all_antennas().items()}
    for name, antenna in learnt.rig.rfid.antennas.items():
        assert antenna.yaw == pytest.approx(known[name], abs=0.05), name
    (clock,) = (c for c in learnt.knowledge.constants if c.name == "time_offset")
    assert clock.is_determined
    assert learnt.rig.rfid.time_offset == pytest.approx(0.0, abs=4.0 * clock.error)


def test_independent_reads_keep_their_tempering(learnt):
    (tempering,) = (c for c in learnt.knowledge.constants if c.name == "tempering")
    assert tempering.fitted == 1.0
    assert learnt.rig.rfid.tempering == 1.0


def test_bursts_lower_the_tempering(tmp_path):
    """Fades of five seconds that the rig does not model."""
    faults = {"fading": {"duration": 5.0, "share": 0.4}}
    log = simulate(preset("office", {"drive": {"duration": 90.0}, "faults": faults}), 3)
    turns = learn_by_turns([log], log.rig, smoothed, tmp_path / "cart")
    assert 0.12 < turns.rig.rfid.tempering < 0.5


def test_priors_come_from_the_scatter_between_logs(learnt):
    prior = learnt.rig.rfid.models["default"].prior
    assert 0.005 < prior.range_scale < 0.03
    assert 0.02 < prior.read_rate < 0.2


def test_a_grid_learns_its_range_and_rate(blind, tmp_path):
    """A grid that was made of a beam whose range is 10 % too long."""
    from factorgraph_loc.sensors.rfid.settings import GridSettings, write_grid  # noqa: PLC0415
    from factors.rfid.model import BeamModel, bake  # noqa: PLC0415

    beam = BeamModel(r_max=4.95)
    write_grid(bake(beam, 7.0, 0.25), tmp_path / "given.npz")
    rfid = blind[0].rig.of(RfidSettings)
    models = {"default": GridSettings(file="given.npz").placed(tmp_path)}
    rig = blind[0].rig.model_copy(update={"rfid": rfid.model_copy(update={"models": models})})
    turns = learn_by_turns(blind[:1], rig, smoothed, tmp_path / "cart")
    (scale,) = (c for c in turns.constants if c.name.endswith("range_scale"))
    assert scale.fitted == pytest.approx(-np.log(1.1), abs=0.03)
    assert turns.rig.rfid.models["default"].model().cell == pytest.approx(0.25 * np.exp(scale.fitted), rel=1e-6)


def test_what_logs_agree_on_becomes_the_rigs_and_their_scatter_its_uncertainty():
    same = pooled([(0.1, 0.001), (0.1, 0.001), (0.1, 0.001)], 0.02)
    assert same.mean == pytest.approx(0.1)
    assert same.scatter == pytest.approx(0.02 * np.sqrt(2.0 / 4.0))
    apart = pooled([(0.2, 0.001), (0.0, 0.001)], 0.02)
    assert 0.05 < apart.scatter < 0.15
    vague = pooled([(0.14, 0.1), (0.0, 0.1)], 0.02)  # as far apart as their errors let them be
    assert vague.scatter < 0.03


def test_the_final_trajectory_alone_is_of_what_was_learnt(offices):
    log = replace(offices[0], rig=with_beam(offices[0], r_max=5.4, s_r=0.6, sigma_phi=1.1))
    plain, (learning, _) = run(log, RunConfig("ekf")), run_and_learn(log, RunConfig("ekf"))
    for name in ("t", "poses", "covariances"):
        assert np.array_equal(getattr(plain, name), getattr(learning, name))
    assert plain.status == learning.status
    given, improved = score(plain, log), score(learning, log)
    assert improved["causal.position_rmse"] == given["causal.position_rmse"]
    assert improved["final.position_rmse"] < 0.9 * given["final.position_rmse"]
    assert learning.config["learnt_rig"]["rfid"]["models"]["default"]["r_max"] == pytest.approx(4.5, abs=0.1)
    assert learning.config["rig"]["rfid"]["models"]["default"]["r_max"] == 5.4


def test_the_reference_is_not_used(offices, tmp_path):
    """Learnt is the same with a reference that lies elsewhere."""
    log = cut(offices[0], 0.0, 40.0)
    shifted = replace(log.reference, poses=log.reference.poses + 1.0)
    pair = [replace(log, reference=reference) for reference in (None, shifted)]
    learnt = [learn_by_turns([each], each.rig, smoothed, tmp_path / "cart").rig for each in pair]
    assert learnt[0] == learnt[1]


def test_what_does_not_tell_enough_is_named(offices, blind, tmp_path):
    with pytest.raises(
        InputError, match=r"office-2: has no reference, expected one to calibrate against; calibrate logs without"
    ):
        check([offices[0], blind[1]])
    lost = replace(blind[0], world=blind[0].world.model_copy(update={"tags": {}}))
    with pytest.raises(InputError, match=r"office-1: the smoother .* to learn from it without a reference"):
        learn_by_turns([lost], lost.rig, smoothed, tmp_path / "cart")
    bare = blind[0].rig.model_copy(update={"sensors": ("odometry",)})
    known = bare.odometry.model_copy(update={"uncertainty": type(bare.odometry.uncertainty)()})
    certain = bare.model_copy(update={"odometry": known})
    with pytest.raises(
        InputError, match=r"office-1: nothing can be learnt without a reference, because the rig rackham"
    ):
        learn_by_turns(blind[:1], certain, smoothed, tmp_path / "cart")


def known_outcome(error, anees=3.0):
    kinds = {f"{kind}.{name}": error for kind in ("causal", "final") for name in ("position_rmse", "heading_rmse")}
    scores = kinds | {"causal.anees": anees, "final.anees": anees, "causal.scored": 1000, "final.scored": 1000}
    diagnostics = Diagnostics(doubted={"moved_tags": {"tag3": 0.9}, "dead_tags": {}})
    return SimpleNamespace(scores=scores, result=SimpleNamespace(diagnostics=diagnostics))


@pytest.fixture(scope="module")
def logs(read_tags):
    made = [read_tags(seed=seed, seconds=70.0) for seed in (1, 2)]
    rfid = made[0].rig.rfid.model_copy(update={"models": {"default": BeamSettings(p0=0.8)}})
    rig = made[0].rig.model_copy(update={"rfid": rfid})
    return [replace(log, rig=rig) for log in made]


def calibrated(logs, folder, factor, anees=3.0):
    """With an estimator whose error is that many times larger with any rig but that of the logs, and whose ANEES is another."""
    runs = []

    def run(log, estimator):
        runs.append((log.name, estimator, log.rig))
        return known_outcome(0.1) if log.rig == logs[0].rig else known_outcome(0.1 * factor, anees)

    return calibrate(logs, run, grids=folder / "cart"), runs


def test_each_log_is_tried_with_a_rig_from_the_others(logs, tmp_path):
    calibration, runs = calibrated(logs, tmp_path, 0.5)
    assert not calibration.refused
    assert calibration.rig == calibration.knowledge.rig != logs[0].rig
    assert growth(calibration.trials) == pytest.approx(0.5)
    assert [(t.log, t.estimator) for t in calibration.trials] == [
        (log.name, estimator) for log in logs for estimator in ("ekf", "smoother")
    ]
    learnt = {name: rig for name, _, rig in runs if rig != logs[0].rig}
    assert calibration.rig not in learnt.values()
    assert learnt["reads-1"] != learnt["reads-2"]
    assert any("moved tags tag3" in str(doubt) for doubt in calibration.doubts)


@pytest.mark.parametrize(
    ("factor", "anees", "refused"),
    [(1.01, 3.0, False), (1.05, 3.0, True), (0.95, 3.5, False), (0.95, 7.0, True), (0.7, 7.0, False)],
)
def test_a_rig_with_larger_or_less_consistent_errors_is_refused(logs, tmp_path, factor, anees, refused):
    calibration, _ = calibrated(logs, tmp_path, factor, anees)
    assert bool(calibration.refused) == refused
    assert calibration.rig == (calibration.input_rig if refused else calibration.knowledge.rig)
    assert any(doubt.kind == "refused" for doubt in calibration.doubts) == refused
    assert ("input rig is kept" in report.summary(calibration)[-1]) == refused


def test_logs_with_the_same_reads_are_one_recording(logs, tmp_path):
    """Its halves are held out, as those of a single log."""
    again = replace(logs[0], name="again")
    assert len(set(recordings([logs[0], again, logs[1]]))) == 2
    calibration, _ = calibrated([logs[0], again], tmp_path, 0.5)
    assert [t.log for t in calibration.trials if t.estimator == "ekf"] == ["reads-1", "again"] * 2
