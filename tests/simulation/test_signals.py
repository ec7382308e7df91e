"""Phase and strength of reads: the formulas written out once more, at the true poses."""

import numpy as np

from factorgraph_loc.simulation import preset


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
