"""Reads: as often as the model says, and each fault does what it is for.

Bounds on frequencies are five standard deviations of a binomial: a false alarm in 2 million tests each.
"""

from itertools import pairwise

import numpy as np
import pytest

from factorgraph_loc import RfidScan, Rig
from factorgraph_loc.sensors.rfid.known_tags import tag_map
from factorgraph_loc.sensors.rfid.simulation import FaultSettings, draw_dead, draw_reads, read_probabilities
from factorgraph_loc.simulation import preset
from factors.rfid.detection import RfidLikelihood
from factors.rfid.model import BeamModel

TIMES = np.arange(1, 2001) * 0.5


def drawn(faults, p, seed=0, rfid=None):
    rfid = rfid or preset("office").rig.rfid
    rng, settings = np.random.default_rng(seed), FaultSettings.model_validate(faults)
    return draw_reads(rfid, p, TIMES, settings, draw_dead(settings, p.shape[2], rng), rng)


def flat(p):
    return np.full((len(TIMES), 8, 10), p)


def five_sigma(p, n):
    return 5.0 * np.sqrt(p * (1.0 - p) / n)


def scans(log):
    return [m for m in log.measurements(("rfid",)) if isinstance(m, RfidScan)]


def reads_of(log):
    """Times and EPCs of all reads."""
    stream = log.streams["rfid"]
    rows = [(t, epc) for t, epc in zip(stream.t.tolist(), stream.epc, strict=True) if epc]
    return np.array([t for t, _ in rows]), np.array([epc for _, epc in rows])


def test_rounds_of_all_antennas_end_together_twice_a_second(office):
    found = scans(office)
    np.testing.assert_allclose([scan.t for scan in found], np.arange(1, 1201) * 0.5)
    assert all(scan.antennas == tuple("12345678") for scan in found)


def test_tags_are_read_as_often_as_the_model_says(office):
    """The model's formula written out once more, at the true poses, in ten classes of probability."""
    tags = tag_map(office.world, office.rig.survey)
    beam, p, hits = BeamModel(), [], []
    for scan, pose in zip(scans(office), office.reference.at(np.arange(1, 1201) * 0.5), strict=True):
        for i in range(8):
            yaw = pose[2] + i * np.pi / 4.0
            x, y = pose[:2] + 0.25 * np.array((np.cos(yaw), np.sin(yaw)))
            dx, dy = tags.tags.points[:, 0] - x, tags.tags.points[:, 1] - y
            bearing = np.remainder(np.arctan2(dy, dx) - yaw + np.pi, 2.0 * np.pi) - np.pi
            near = 1.0 / (1.0 + np.exp(-(beam.r_max - np.hypot(dx, dy)) / beam.s_r))
            p.append(1e-3 + 0.999 * beam.p0 * near * np.exp(-0.5 * (bearing / beam.sigma_phi) ** 2))
            row = np.zeros(len(tags.names))
            row[[tags.index[scan.tags[k]] for k in np.flatnonzero(scan.antenna == i)]] = 1.0
            hits.append(row)
    p, hits = np.concatenate(p), np.concatenate(hits)
    edges = np.array((0.0, 1.01e-3, 0.01, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.85, 1.0))
    for low, high in pairwise(edges):
        chosen = (p >= low) & (p < high)
        assert chosen.sum() > 500, (low, high)
        bound = 5.0 * np.sqrt((p[chosen] * (1.0 - p[chosen])).sum())
        assert abs(hits[chosen].sum() - p[chosen].sum()) < bound, (low, high)


def test_fades_take_their_share_and_last_and_leave_the_model_right():
    rfid = preset("bursty").rig.rfid
    fading = {"fading": {"duration": 2.0, "share": 0.2}}
    hits = drawn(fading, flat(0.799), rfid=rfid)  # all that the misses leave: outside a fade every round reads
    faded = ~hits
    n = faded.size
    # neighbours in time go together: a fade of 4 rounds in the mean leaves about n / 8 independent values
    assert abs(faded.mean() - 0.201) < five_sigma(0.2, n / 8.0)
    starts = (faded[1:] & ~faded[:-1]).sum()
    ends_of_rounds = faded[1:].sum() / starts * 0.5
    # sampled every 0.5 s, fades shorter than that are missed: the mean of the seen ones is a little longer
    exact = 0.5 / ((1.0 - np.exp(-0.5 / (2.0 * 0.8))) * 0.8)
    assert ends_of_rounds == pytest.approx(exact, rel=0.05)


@pytest.mark.parametrize(("p", "times"), [(0.5, 1.9), (0.7, 2.7)])
def test_fades_make_counts_vary_more_than_independent_rounds_would(p, times):
    """The formula beside the preset. Counts of 8 runs, 80 antennas and tags, in 10 parts of 200 rounds: 6,400,
    of which the variance is right to five standard errors, 9 %."""
    rfid = preset("bursty").rig.rfid
    fading = {"fading": {"duration": 2.0, "share": 0.2}}
    q = 0.001 + 0.999 * p * 0.8
    counts = [drawn(fading, flat(q), seed, rfid).reshape(10, 200, 80).sum(axis=1).ravel() for seed in range(8)]
    assert np.concatenate(counts).var() / (200.0 * q * (1.0 - q)) == pytest.approx(times, rel=0.09)


def test_dead_tags_are_never_read(make):
    log = make(faults={"dead": 0.25, "false_reads": 0.2}, drive={"duration": 300.0})
    assert len(set(reads_of(log)[1])) == 30


def test_false_reads_are_their_share_of_all():
    p = np.zeros((len(TIMES), 8, 10))
    p[:, :, 0] = 0.5
    hits = drawn({"false_reads": 0.2}, p)
    false = hits[:, :, 1:].sum() / 0.9  # one in ten falls on the tag that is read rightly
    n = int(hits[:, :, 0].sum() + false)
    assert abs(false / n - 0.2) < five_sigma(0.2, n) + 0.01  # some fall on a read that is there


@pytest.mark.parametrize("go_on", [False, True])
def test_an_antenna_stops(make, go_on):
    log = make(faults={"antenna_stop": {"antenna": 3, "time": 20.0, "rounds_go_on": go_on}})
    for scan in scans(log):
        stopped = scan.t >= 20.0
        assert ("3" in scan.antennas) == (not stopped or go_on)
        if stopped:
            assert "3" not in {scan.antennas[k] for k in scan.antenna}


def test_the_readers_clock_jumps(make):
    log = make(faults={"clock_jump": {"time": 30.0, "jump": 0.75}})
    t = np.unique(log.streams["rfid"].t)
    assert t[58] == 29.5
    assert t[59] == 30.75
    assert log.streams["odometry"].t[-1] == 60.0


def test_a_rigs_survey_tells_where_the_tags_are(make):
    """A map that is shifted, and a rig that knows by how much, give the reads of the tags' true places."""
    rig = preset("office").rig.model_dump(mode="json", exclude_none=True)
    shifted = Rig.model_validate(rig | {"survey": {"x": 3.0}})
    log = make(rig={"survey": {"x": 3.0}})
    tags = tag_map(log.world, shifted.survey)
    likelihood = RfidLikelihood(shifted.rfid.model(), tags.tags)
    p = read_probabilities(likelihood, log.reference.at(np.arange(1, 121) * 0.5))
    likely = p.sum(axis=(0, 1))
    _, epcs = reads_of(log)
    counts = np.array([(epcs == name).sum() for name in tags.names])
    assert np.abs(counts - likely).max() < 5.0 * np.sqrt(likely.max()) + 5.0


def test_another_detection_model_and_other_rates_are_drawn_from(make):
    model = {"kind": "logistic", "coefficients": [30.0] + [0.0] * 10}
    log = make(rig={"rfid": {"models": {"default": model}}}, rounds_per_second=5.0)
    assert len(scans(log)) == 300
    reach, near = 8.0, 0
    tags = tag_map(log.world, log.rig.survey)
    scan = scans(log)[0]
    pose = log.reference.at(np.array([scan.t]))[0]
    for i, antenna in enumerate(log.rig.rfid.all_antennas().values()):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        x, y = pose[0] + c * antenna.x - s * antenna.y, pose[1] + s * antenna.x + c * antenna.y
        inside = np.hypot(tags.tags.points[:, 0] - x, tags.tags.points[:, 1] - y) < reach
        near += inside.sum()
        assert (scan.antenna == i).sum() >= inside.sum() - 5  # 999 of 1000 are read
    assert near > 50


def reads(log):
    """Row, antenna, tag, and the way (3,) from the tag to the antenna in the world, of each read."""
    stream, antennas = log.streams["rfid"], log.rig.rfid.all_antennas()
    for row, (pose, name, epc) in enumerate(zip(log.reference.at(stream.t), stream.antenna, stream.epc, strict=True)):
        if epc:
            c, s = np.cos(pose[2]), np.sin(pose[2])
            a, tag = antennas[name], log.world.tags[epc]
            way = np.array((pose[0] + c * a.x - s * a.y - tag.x, pose[1] + s * a.x + c * a.y - tag.y, a.z - tag.z))
            yield row, name, epc, way, pose[2] + a.yaw


def test_phases_tell_the_distance_but_for_an_offset_of_each_antenna_and_tag(make):
    """Twice the phase is free of flips; less 8 pi f d / c it is constant for an antenna and tag, to twice the noise."""
    log = make(phase={"sigma": 0.05, "flips": 0.3}, drive={"duration": 120.0})
    stream = log.streams["rfid"]
    doubled: dict[tuple[str, str], list[complex]] = {}
    single: dict[tuple[str, str], list[complex]] = {}
    for row, name, epc, way, _ in reads(log):
        assert 0.0 <= stream.phase[row] < 2.0 * np.pi
        angle = stream.phase[row] + 4.0 * np.pi * stream.frequency[row] * np.linalg.norm(way) / 299_792_458.0
        doubled.setdefault((name, epc), []).append(np.exp(2j * angle))
        single.setdefault((name, epc), []).append(np.exp(1j * angle))
    large = {key for key, values in doubled.items() if len(values) >= 20}
    assert len(large) > 20
    # exp(-(2 sigma)^2 / 2) = 0.995 is the mean length expected
    assert min(abs(np.mean(doubled[key])) for key in large) > 0.98
    # flips pull the single phase's mean length to about 1 - 2 * 0.3
    assert abs(np.mean([abs(np.mean(single[key])) for key in large]) - 0.4) < 0.05


def test_strengths_follow_the_path_loss_with_students_noise(make):
    """Median and median deviation of 2,000 reads: standard errors of 3 % of sigma, bounds of five."""
    b, sigma = (-50.0, 2.5, -8.0, 1.0, 3.0, -2.0), 2.0
    log = make(rssi={"coefficients": b, "sigma": sigma, "dof": 4.0}, faults={"dead": 0.2})
    errors = []
    for row, _, epc, way, boresight in reads(log):
        d = np.linalg.norm(way)
        w = 1.0 + (way[0] * np.cos(boresight) + way[1] * np.sin(boresight)) / d
        facing = log.world.tags[epc].facing
        c = (way[0] * np.cos(facing) + way[1] * np.sin(facing)) / d
        expected = b[0] - 10.0 * b[1] * np.log10(d) + b[2] * w + b[3] * w**2 + b[4] * c + b[5] * c**2
        errors.append((log.streams["rfid"].rssi[row] - expected) / sigma)
    assert len(errors) > 1000
    assert abs(np.median(errors)) < 0.2
    assert abs(np.median(np.abs(errors)) - 0.741) < 0.15  # of Student's density with 4 degrees of freedom
    assert np.std(errors) > 1.15  # its tails: sqrt(2)


def test_signals_change_no_read_and_rows_without_a_read_have_none(make):
    with_signals, without = make(phase={}, rssi={}, name="sparse"), make(name="sparse")
    a, b = with_signals.streams["rfid"], without.streams["rfid"]
    assert a.epc == b.epc
    read = np.array([bool(epc) for epc in a.epc])
    assert 0 < read.sum() < len(read)
    for column in ("rssi", "phase", "frequency"):
        assert (np.isfinite(getattr(a, column)) == read).all()
        assert np.isnan(getattr(b, column)).all()
    assert preset("office").phase is None
