"""Semi-real reads: drawn from recorded rounds at like range, bearing, height and facing."""

import dataclasses

import numpy as np
import pytest
from recorded_logs import recorded_log

from factorgraph_loc.errors import InputError
from factorgraph_loc.sensors.rfid.known_tags import tag_map
from factorgraph_loc.sensors.rfid.recorded import FAR, SCALES
from factorgraph_loc.simulation import preset, recorded_looks, simulate
from factors.rfid.detection import RfidLikelihood


@pytest.fixture(scope="module")
def looks(office):
    """Rounds of a simulated recording, whose law is known."""
    return recorded_looks([office])


def test_reads_follow_the_law_of_the_recording(looks):
    """In classes of the recorded antennas' probability the frequency is right to 0.06."""
    log = simulate(preset("office", {"drive": {"duration": 300.0}}), 7, looks)
    tags = tag_map(log.world, log.rig.survey)
    times = np.arange(1, 601) * 0.5
    likelihood = RfidLikelihood(log.rig.rfid.model(), tags.tags)
    p = np.stack([likelihood.probabilities(log.reference.at(times), a) for a in range(8)], axis=1)
    hits = np.zeros(p.shape)
    stream = log.streams["rfid"]
    for t, antenna, epc in zip(stream.t, stream.antenna, stream.epc, strict=True):
        if epc:
            hits[round(t / 0.5) - 1, int(antenna) - 1, tags.index[epc]] = 1.0
    for low, high in ((0.0, 0.01), (0.1, 0.3), (0.4, 0.6), (0.6, 0.8), (0.85, 1.0)):
        chosen = (p >= low) & (p < high)
        # matching blurs: at the edge of the beam probabilities from 0 to 0.9 are neighbours
        assert abs(hits[chosen].mean() - p[chosen].mean()) < 0.06, (low, high)


def test_recorded_rounds_keep_what_the_antennas_missed(office, looks):
    """As many looks as rounds, antennas and tags that were ever read, but for those out of reach; as many reads as in the log."""
    reads = sum(map(bool, office.streams["rfid"].epc))
    assert looks.read.sum() == reads
    assert 1200 * 8 * 40 * 0.3 < len(looks.read) <= 1200 * 8 * 40
    assert (looks.features[:, 0] * SCALES[0]).max() <= looks.reach + 1.0


def test_a_virtual_world_unlike_the_recorded_one_is_told(looks):
    high = preset("office", {"world": {"tag_height": 4.0}, "drive": {"duration": 30.0}})
    assert FAR * SCALES[2] < 4.0 - 1.2
    (warning,) = simulate(high, 0, looks).warnings
    assert "100% of the rounds in range have no similar recorded one" in warning
    assert simulate(preset("office", {"drive": {"duration": 30.0}}), 0, looks).warnings == ()


def test_faults_come_on_top(looks):
    settings = preset("office", {"drive": {"duration": 30.0}, "faults": {"dead": 1.0}})
    assert not any(simulate(settings, 0, looks).streams["rfid"].epc)


def test_a_recording_without_what_it_takes_is_an_error(office):
    faceless = {name: tag.model_copy(update={"facing": None}) for name, tag in office.world.tags.items()}
    cases = [
        ({"reference": None}, "expected a log with rfid, antennas in its rig and a reference"),
        ({"rig": office.rig.model_copy(update={"rfid": None})}, "expected a log with rfid"),
        ({"streams": {"odometry": office.streams["odometry"]}}, "expected a log with rfid"),
        ({"world": office.world.model_copy(update={"tags": faceless})}, "has tags without a facing"),
        ({"world": office.world.model_copy(update={"tags": {}})}, "has 0 reads of tags of its map"),
    ]
    for change, message in cases:
        with pytest.raises(InputError, match=message):
            recorded_looks([dataclasses.replace(office, **change)])


def test_the_aisle_recording_makes_a_log(data_root):
    looks = recorded_looks([recorded_log("rfid-aisle-run13", data_root)])
    log = simulate(preset("warehouse", {"drive": {"duration": 60.0}}), 0, looks)
    assert len(log.rig.rfid.all_antennas()) == 3
    assert sum(map(bool, log.streams["rfid"].epc)) > 50
    assert "recorded" in log.metadata["reads"]
