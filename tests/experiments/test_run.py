"""What an estimator is given in a run, in which order, and what is kept."""

from dataclasses import replace

import numpy as np
import pytest
from by_hand import reads

from factorgraph_loc import InputError, RunFailedError, StartPose, Tag, Trajectory, VelocityStream, World
from factorgraph_loc.experiments.preparation import resolve_prior, use_of
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.registry import estimator_type, settings_of
from factorgraph_loc.model.belief import Learnt
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.sensors.rfid.summary import doubts
from factorgraph_loc.simulation import preset, simulate


def test_order_of_what_is_fed(log, fake):
    run(log, RunConfig("fake"))
    calls = fake.made.calls
    assert calls[:2] == [("VelocityOdometry", 0.0), ("initialize", 0.0)]
    fed = [call for call in calls if call[0] not in ("estimate", "initialize")]
    assert [t for _, t in fed] == sorted(t for _, t in fed)
    kinds = [kind for kind, t in fed if t == pytest.approx(0.1)]
    assert kinds == ["VelocityOdometry", "Tick"]


def test_an_update_is_one_stamp(log, fake):
    result = run(log, RunConfig("fake"))
    assert result.timings.update_t == pytest.approx(np.arange(4) * 0.5 + 0.02)
    assert (result.timings.update_ms > 0.0).all()
    calls = fake.made.calls
    after = [calls[i + 1][0] for i, (kind, _) in enumerate(calls) if kind == "BearingRange"]
    assert set(after) == {"estimate"}
    # what is asked for a tick does not depend on the tick
    assert all(calls[i - 1] == ("estimate", t) for i, (kind, t) in enumerate(calls) if kind == "Tick")
    assert result.timings.real_time_factor == pytest.approx(2.0 / result.timings.causal_seconds)
    assert result.timings.peak_memory_mb > 10.0


@pytest.mark.parametrize("name", ["ekf", "particle_filter"])
def test_a_first_run_is_rehearsed_and_no_result_depends_on_it(log, name, monkeypatch):
    log = replace(log, start=StartPose(0.0, np.zeros(3), np.full(3, 0.1)))
    estimator = estimator_type(name)
    process = estimator.process
    taken = {}
    monkeypatch.setattr(
        estimator, "process", lambda self, m: (taken.setdefault(id(self), []).append(m.t), process(self, m))
    )
    monkeypatch.setattr("factorgraph_loc.experiments.run._REHEARSED", set())
    monkeypatch.setattr("factorgraph_loc.experiments.run._REHEARSAL", 0.8)
    first = run(log, RunConfig(name, seed=3))
    rehearsal, itself = taken.values()
    assert 0.0 < max(rehearsal) <= 0.8 < max(itself)
    taken.clear()
    second = run(log, RunConfig(name, seed=3))
    assert len(taken) == 1
    assert np.array_equal(first.poses, second.poses)
    assert np.array_equal(first.covariances, second.covariances)


@pytest.mark.parametrize("start", [None, 0.72])
@pytest.mark.parametrize("name", ["dead_reckoning", "ekf", "smoother"])
def test_rows_of_odometry_may_come_at_once(log, name, start, monkeypatch):
    if start is not None:
        log = replace(log, start=StartPose(start, np.array((start, 0.0, 0.0)), np.full(3, 0.1)))
    estimator = estimator_type(name)
    whole = run(log, RunConfig(name))
    counts = []
    taken = estimator.process
    monkeypatch.setattr(estimator, "process", lambda self, m: (counts.append(m.is_motion * m.count), taken(self, m)))
    run(log, RunConfig(name))
    assert max(counts) > 1
    monkeypatch.setattr(estimator, "takes_rows", False)
    counts.clear()
    singly = run(log, RunConfig(name))
    assert max(counts) == 1
    assert whole.status == singly.status
    for one, other in ((whole, singly), (whole.final, singly.final)):
        np.testing.assert_array_equal(one.t, other.t)
        np.testing.assert_array_equal(one.poses, other.poses)
        np.testing.assert_array_equal(one.covariances, other.covariances)


@pytest.mark.parametrize(
    ("name", "prior"),
    [
        *((name, "reference") for name in ("ekf", "smoother", "particle_filter")),
        *((name, "unknown") for name in ("smoother", "particle_filter")),
    ],
)
def test_several_ticks_may_be_processed_at_once(name, prior):
    world, drive = {"tags": 20, "landmarks": 10}, {"duration": 20.0}
    log = simulate(preset("office", {"world": world, "drive": drive, "sightings": {"rate": 2.0}}), 3)
    config = RunConfig(name, {}, ("odometry", "bearing_range", "rfid"), prior=prior, seed=2)
    together, singly = run(log, config), run(log, config, watch=lambda *_: None)
    assert len(set(together.status)) > 1 or prior == "reference"
    assert together.status == singly.status
    for one, other in ((together, singly), (together.final, singly.final)):
        np.testing.assert_array_equal(one.t, other.t)
        np.testing.assert_array_equal(one.poses, other.poses)
        np.testing.assert_allclose(one.covariances, other.covariances, rtol=1e-12, atol=0.0)


def test_what_is_older_than_the_prior(log, fake):
    log = replace(log, start=StartPose(0.72, np.array((0.72, 0.0, 0.0)), np.full(3, 0.1)))
    result = run(log, RunConfig("fake"))
    calls = fake.made.calls
    started = calls.index(("initialize", 0.72))
    assert {kind for kind, _ in calls[:started]} == {"VelocityOdometry"}
    assert result.diagnostics.ignored == {"before the start": 2}
    assert result.t[0] == 0.72
    assert result.t[-1] <= 2.0


def test_sensors_are_a_setting(log, fake):
    result = run(log, RunConfig("fake", sensors=("odometry",)))
    assert fake.made.setup.sensors == ("odometry",)
    assert len(result.timings.update_t) == 0
    with pytest.raises(InputError, match=r"straight: has no sensor 'bearing_rnge': did you mean bearing_range\?"):
        run(log, RunConfig("fake", sensors=("odometry", "bearing_rnge")))
    with_rfid = replace(log, rig=log.rig.model_copy(update={"sensors": ("odometry", "rfid")}))
    assert run(with_rfid, RunConfig("fake")).warnings[0].fields["sensor"] == "rfid"


def test_effective_configuration(log):
    config = run(log, RunConfig("fake", {"localized_at": 0.5}, seed=7)).config
    assert config["settings"] == {"localized_at": 0.5, "broken_at": 1e9}
    assert (config["prior"], config["seed"], config["sensors"]) == ("reference", 7, ["odometry", "bearing_range"])
    assert config["rig"]["bearing_range"]["range_sigma"] == 0.1
    assert set(config["versions"]) == {"factorgraph-loc", "gtsam", "numpy", "python"}
    with pytest.raises(InputError, match="localised_at"):
        run(log, RunConfig("fake", {"localised_at": 0.5}))


def test_a_pose_that_is_not_finite_is_an_error(log):
    with pytest.raises(
        RunFailedError, match=r"^fake on straight: the estimate at 1\.000 s \(after .*\): the pose is not finite$"
    ):
        run(log, RunConfig("fake", {"broken_at": 0.95}))


@pytest.mark.parametrize("far", [100.0, 2.5e6])
@pytest.mark.parametrize("name", ["dead_reckoning", "ekf", "smoother"])
def test_a_clock_that_jumps_costs_no_ticks(log, name, far):
    """The first row of the odometry is from before the clock was set."""
    jumped = {key: replace(s, t=np.where(s.t > 0.0, s.t + far, s.t)) for key, s in log.streams.items()}
    result = run(replace(log, streams=jumped, reference=None), RunConfig(name, prior="0,0,0"))
    assert result.t[0] == 0.0
    assert result.t[1:] == pytest.approx(far + np.arange(1, 21) * 0.1)
    assert np.all(np.isfinite(result.poses))
    assert np.all(np.linalg.eigvalsh(result.covariances) > 0.0)
    # the odometry alone may be anywhere after a minute of silence, landmarks tell the place
    assert (np.sqrt(result.covariances[1, 0, 0]) > 1.0) == (name == "dead_reckoning")
    assert any((w.kind, w.fields.get("limit")) == ("gaps", 60.0) for w in result.warnings)
    assert result.timings.real_time_factor < 1e4
    assert result.config["tick_gap"] == 60.0


def test_priors(log):
    prior, source = resolve_prior(log, None)
    assert source == "reference"
    assert np.sqrt(np.diag(prior.covariance)) == pytest.approx((0.02, 0.02, 0.01))
    vague = replace(log, reference=Trajectory(log.reference.t, log.reference.poses, has_heading=False))
    prior, source = resolve_prior(vague, None)
    assert (prior.has_heading, source) == (False, "reference")
    assert np.sqrt(np.diag(prior.covariance)) == pytest.approx((0.02, 0.02, np.pi / np.sqrt(3.0)))
    stated = replace(log, start=StartPose(0.3, np.ones(3), np.array((0.1, 0.2, 0.3))))
    prior, source = resolve_prior(stated, None)
    assert (prior.t, source) == (0.3, "log")
    assert np.diag(prior.covariance) == pytest.approx((0.01, 0.04, 0.09))
    prior, source = resolve_prior(log, "1, -2, 0.5")
    assert (prior.pose.tolist(), prior.t, source) == ([1.0, -2.0, 0.5], 0.0, "1, -2, 0.5")
    assert np.sqrt(np.diag(prior.covariance)) == pytest.approx((0.05, 0.05, 0.05))
    prior, source = resolve_prior(log, "1, -2")
    assert (prior.pose[:2].tolist(), prior.has_heading, source) == ([1.0, -2.0], False, "1, -2")
    assert np.sqrt(np.diag(prior.covariance)) == pytest.approx((0.05, 0.05, np.pi / np.sqrt(3.0)))
    assert resolve_prior(replace(log, reference=None), None) == (None, "unknown")


def test_the_reference_prior_is_not_before_the_odometry(log):
    odometry = log.streams["odometry"]
    later = VelocityStream(odometry.t[9:], odometry.v[9:], odometry.w[9:])
    assert resolve_prior(replace(log, streams={"odometry": later}), "reference")[0].t == pytest.approx(0.45)


@pytest.mark.parametrize("prior", ["here", "1", "1,nan", "0,0,90", "1,2,0,0"])
def test_priors_that_are_none(log, prior):
    with pytest.raises(InputError, match=f"prior is '{prior}', expected"):
        resolve_prior(log, prior)


@pytest.mark.parametrize(
    ("prior", "why"), [("log", "no start"), ("reference", "no reference"), ("unknown", "an unknown pose")]
)
def test_missing_priors(log, prior, why):
    with pytest.raises(InputError, match=why):
        run(replace(log, reference=None), RunConfig("fake", prior=prior))


def test_a_start_without_a_heading_where_it_can_be_found(log, fake, monkeypatch):
    with pytest.raises(InputError, match="cannot find an unknown heading"):
        run(log, RunConfig("fake", prior="1,2"))
    monkeypatch.setattr(fake, "supports_unknown_heading", True, raising=False)
    run(log, RunConfig("fake", prior="1,2"))
    assert not fake.made.prior.has_heading
    with pytest.raises(InputError, match="cannot find an unknown heading"):  # nothing could tell it
        run(log, RunConfig("fake", sensors=("odometry",), prior="1,2"))


def test_a_log_that_tells_nothing_of_its_start_begins_at_the_origin(log, fake):
    bare = replace(log, reference=None, world=World())
    result = run(bare, RunConfig("fake"))
    assert fake.made.prior.pose.tolist() == [0.0, 0.0, 0.0]
    assert np.sqrt(np.diag(fake.made.prior.covariance)).max() < 0.002  # it is where the frame is
    assert result.config["prior"] == "origin"
    assert result.warnings[0].kind == "no_start"
    # in a map of what its sensors see, the origin is a place like any other
    with pytest.raises(InputError, match="cannot start from an unknown pose"):
        run(replace(log, reference=None), RunConfig("fake"))


ALL = ("odometry", "rfid", "rssi", "phase")


@pytest.fixture
def reading(log):
    """The short log with reads of tag a and of an unknown one; RSSI is known of the first read, phase of none."""
    stream = replace(reads((0.5, 0, "1", "a", 0.0), (1.0, 1, "1", "x", 0.0)), rssi=np.array((-60.0, np.nan)))
    world = log.world.model_copy(update={"tags": {name: Tag(x=1.0, y=1.0) for name in ("a", "b", "c")}})
    return replace(log, streams=dict(log.streams) | {"rfid": stream}, world=world)


def test_rssi_and_phase_are_sensors_of_the_reads(reading, fake):
    run(reading, RunConfig("fake", sensors=ALL[:3]))
    assert fake.made.setup.sensors == ALL[:3]
    assert sum(kind == "RfidScan" for kind, _ in fake.made.calls) == 2
    with pytest.raises(InputError, match="has no sensor 'phase': this column of rfid is missing or empty"):
        run(reading, RunConfig("fake", sensors=ALL))
    stream = replace(reading.streams["rfid"], phase=np.array((np.nan, 0.5)))
    run(replace(reading, streams=dict(reading.streams) | {"rfid": stream}), RunConfig("fake", sensors=ALL))
    assert fake.made.setup.sensors == ALL


def test_what_the_rig_lists_and_the_reads_lack_is_left_out(reading, fake):
    rig = reading.rig.model_copy(update={"sensors": ALL})
    result = run(replace(reading, rig=rig), RunConfig("fake"))
    assert fake.made.setup.sensors == ALL[:3]
    assert [w.fields["sensor"] for w in result.warnings if w.kind == "no_stream"] == ["phase"]


def test_an_estimator_is_given_all_tags_whatever_the_log_reads_later(reading, fake):
    result = run(reading, RunConfig("fake", sensors=ALL[:2]))
    assert set(fake.made.setup.world.tags) == {"a", "b", "c"}
    assert not any("tags" in warning.fields for warning in result.warnings)


def test_tags_that_are_believed_dead_are_named(reading):
    found = Diagnostics(doubted={"dead_tags": {"b": 0.7, "c": 0.999}})
    use = use_of(reading, ALL, "smoother", settings_of("smoother", {}))
    (told,) = doubts(use, found, Learnt())
    assert str(told).startswith("straight: 2 of 3 tags of the map are probably dead")
    assert str(told).endswith("c (> 99 %), b (70 %)")
    assert list(doubts(use, Diagnostics(), Learnt())) == []


@pytest.mark.usefixtures("fake")
def test_no_tag_of_the_map_is_ever_read(reading):
    stream = replace(reading.streams["rfid"], epc=["", "x"])
    result = run(replace(reading, streams=dict(reading.streams) | {"rfid": stream}), RunConfig("fake", sensors=ALL[:2]))
    assert "straight: none of the 3 tags of the map is read" in map(str, result.warnings)
    unmapped = replace(reading, world=reading.world.model_copy(update={"tags": {}}))
    result = run(unmapped, RunConfig("fake", sensors=ALL[:2]))
    assert any(warning.kind == "no_map" for warning in result.warnings)
