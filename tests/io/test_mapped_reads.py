"""Reads of tags as programs of RFID readers write them, by a mapping: in lines of JSON, in several files, of several readers."""

import json

import numpy as np
import pytest
from function_calls import calls_of
from mapped_hall import MANIFEST, READS, WHEELS
from recorded_logs import recorded_log

from factorgraph_loc import Tag, World
from factorgraph_loc.evaluation.inspect import inspect


def test_events_of_an_r700_as_json_lines(hall, with_options, one):
    def event(t, antenna):
        inventory = {"epcHex": "E2001", "antennaPort": antenna, "peakRssiCdbm": -5234, "phaseAngle": 90.0}
        return {"timestamp": f"1970-01-01T00:00:0{t}Z", "tagInventoryEvent": inventory | {"frequency": 866300}}

    lines = [event("1.5", 1), {"timestamp": "1970-01-01T00:00:02Z", "inventoryStatusEvent": {}}, event("2.25", 2)]
    (hall.parent / "run" / "events.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    log = one(with_options(f'{WHEELS}\n[options.rfid]\nfile = "events.jsonl"\npreset = "impinj_iot"\n'))
    rfid = log.streams["rfid"]
    np.testing.assert_allclose(rfid.t, (0.55, 1.3))  # after the gap
    np.testing.assert_allclose((rfid.rssi[0], rfid.phase[0], rfid.frequency[0]), (-52.34, np.pi / 2, 866.3e6))
    assert list(rfid.antenna) == ["1", "2"]
    assert [w.fields["objects"] for w in log.warnings if w.kind == "incomplete_objects"] == [1]
    assert not any(w.kind == "unread_columns" for w in log.warnings)  # of the objects that are read


def test_events_of_an_r700_with_epcs_in_base64(hall, with_options, one, refused):
    """The fields of an event as the reader's IoT device interface writes it."""
    event = {
        "timestamp": "1970-01-01T00:00:01.277766184Z",
        "hostname": "impinj-14-2f-f4",
        "eventType": "tagInventory",
        "tagInventoryEvent": {
            "epc": "4sRRo6UBH6APNUaT",
            "tidHex": "E2C451A32000269379AAFD00",
            "antennaPort": 2,
            "peakRssiCdbm": -5750,
            "frequency": 921625,
            "transmitPowerCdbm": 1000,
            "lastSeenTime": "1970-01-01T00:00:01.225324Z",
            "phaseAngle": 208.82,
        },
    }

    def manifest(*epcs):
        lines = [json.dumps(event | {"tagInventoryEvent": event["tagInventoryEvent"] | epc}) for epc in epcs]
        (hall.parent / "run" / "events.json").write_text("\n".join(lines))
        return with_options(f'{WHEELS}\n[options.rfid]\nfile = "events.json"\npreset = "impinj_iot"\n')

    log = one(manifest({}))
    rfid = log.streams["rfid"]
    assert rfid.epc == ["E2C451A3A5011FA00F354693"]
    np.testing.assert_allclose(rfid.t - rfid.age, 0.277766184, rtol=0, atol=1e-9)
    np.testing.assert_allclose((rfid.phase[0], rfid.frequency[0]), (np.radians(208.82), 921.625e6))
    (told,) = (str(w) for w in log.warnings if w.kind == "unread_columns")
    for name in ("hostname", "tagInventoryEvent.lastSeenTime", "tagInventoryEvent.transmitPowerCdbm"):
        assert name in told
    assert one(manifest({"epc": "-_8"}, {"epc": "+/8="}, {"epcHex": "AB"})).streams["rfid"].epc == [
        "FBFF",
        "FBFF",
        "AB",
    ]
    refused(manifest({"epc": "a"}), "events.json:1", "tagInventoryEvent.epc is 'a', expected an EPC in base64")
    refused(manifest({}, {"epc": ""}), "events.json:2", "tagInventoryEvent.epc is '', expected the EPC of a tag")
    refused(
        manifest({"epc": None}),
        "no object has the key 'tagInventoryEvent.epcHex', the first object has the keys eventType",
    )


@pytest.mark.parametrize("value", [True, 12])
def test_only_a_text_is_an_epc_in_base64(hall, with_options, refused, value):
    event = {"timestamp": "1970-01-01T00:00:01.5Z", "tagInventoryEvent": {"epc": value, "antennaPort": 2}}
    (hall.parent / "run" / "events.json").write_text(json.dumps(event))
    refused(
        with_options(f'{WHEELS}\n[options.rfid]\nfile = "events.json"\npreset = "impinj_iot"\n'),
        "events.json:1:",
        "a text",
    )


def test_epcs_that_are_digits_of_a_text(hall, with_options, one):
    """Digits that are no text are EPCs as they are; a line has lists of one, as old versions of sllurp write them."""
    lines = [{"EPC-96": epc, "AntennaID": [1], "LastSeenTimestampUTC": [1_500_000]} for epc in ("453230303031", "E2FF")]
    (hall.parent / "run" / "old.json").write_text("\n".join(map(json.dumps, lines)))
    columns = 'columns = { epc = "EPC-96", antenna = "AntennaID", t = "LastSeenTimestampUTC" }\nunits = { t = "us" }'
    options = f'{WHEELS}\n[options.rfid]\nfile = "old.json"\nepc_case = "ascii-hex"\n{columns}\n'
    assert one(with_options(options)).streams["rfid"].epc == ["E20001", "E2FF"]
    read = one(
        with_options(options.replace('epc_case = "ascii-hex"', "")), world=World(tags={"E20001": Tag(x=1.0, y=2.0)})
    )
    assert "coded_epcs" in [problem.kind for problem in inspect(read).problems]


def test_phases_and_channels_in_rows_of_sllurp(hall, with_options, one):
    rows = "timestamp,reader,antenna,rssi,epc,phase_angle,channel_index\n1.15,r:5084,1,-60,aa,1024,3\n1.2,r:5084,1,-60,aa,,\n"
    (hall.parent / "run" / "log.csv").write_text(rows)
    options = f'{WHEELS}\n[options.rfid]\nfile = "log.csv"\npreset = "sllurp_log"\n'
    plain = one(with_options(options))
    np.testing.assert_allclose(plain.streams["rfid"].phase, (np.pi / 2, np.nan))
    assert any("columns that are not read: reader, channel_index" in str(w) for w in plain.warnings)
    tuned = one(with_options(options + "channels = { first = 902.75, step = 0.5 }\n"))
    np.testing.assert_allclose(tuned.streams["rfid"].frequency, (903.75e6, np.nan))


WIDE = """
[options.rfid]
file = "wide.csv"
separator = ";"
decimal = ","
columns = {{ t = "t", {columns} }}
units = {{ t = "s" }}
{more}
"""


@pytest.mark.parametrize(
    ("head", "columns", "more", "reads"),
    [
        (
            "tag;rssi_1;rssi_2",
            'epc = "tag", rssi = "rssi_*"',
            "",
            [("A", "1", -60.5), ("A", "2", -61), ("B", "2", -70)],
        ),
        ("port;A;B", 'antenna = "port", rssi = "*"', "", [("A", "A", -60.5), ("B", "A", -61), ("B", "B", -70)]),
        ("A [dBm];B [dBm]", 'rssi = "* [dBm]"', 'antenna = "l"', [("A", "l", -60.5), ("B", "l", -61), ("B", "l", -70)]),
    ],
    ids=["a column per antenna", "a column per tag", "a column per tag of one antenna"],
)
def test_strengths_in_columns(hall, with_options, one, refused, head, columns, more, reads):
    names = ("A;", "B;") if head.count(";") == 2 else ("", "")
    text = f"t;{head}\n1,1;{names[0]}-60,5;-61\n1,2;{names[1]};-70\n"
    (hall.parent / "run" / "wide.csv").write_text(text)
    rfid = one(with_options(WHEELS + WIDE.format(columns=columns, more=more))).streams["rfid"]
    assert sorted(zip(rfid.epc, rfid.antenna, rfid.rssi.tolist(), strict=True)) == sorted(reads)
    np.testing.assert_allclose(sorted(rfid.t - rfid.age), (0.1, 0.1, 0.2))
    (hall.parent / "run" / "wide.csv").write_text(text.replace("-70", "weak"))
    refused(with_options(WHEELS + WIDE.format(columns=columns, more=more)), "wide.csv:3", "'weak', expected a number")
    refused(
        with_options(WHEELS + WIDE.format(columns=columns.replace("*", "*x"), more=more)),
        "has no column that matches '",
    )
    first, last = head.split(";")[-2:]
    (hall.parent / "run" / "wide.csv").write_text(text.replace(last, first))
    twice = with_options(WHEELS + WIDE.format(columns=columns, more=more))
    refused(twice, f"wide.csv:1: has the column '{first}' more than once")


def test_columns_of_a_wide_table_are_found_once_and_not_in_each_row(hall, with_options, one):
    def searches(rows):
        head = ";".join(f"tag{i}" for i in range(100))
        lines = [f"1,{k:04d};{'-60;' * 99}-60" for k in range(rows)]
        (hall.parent / "run" / "wide.csv").write_text("\n".join([f"t;{head}", *lines]))
        manifest = with_options(WHEELS + WIDE.format(columns='rssi = "tag*"', more='antenna = "l"'))
        return calls_of(lambda: one(manifest))["index"]

    assert searches(60) == searches(20)


def test_reports_of_sllurp_with_several_reads_in_a_row(hall, with_options, one):
    report = {
        "EPC": "b'e2001'",
        "AntennaID": 1,
        "PeakRSSI": -50,
        "ChannelIndex": 3,
        "ImpinjRFPhaseAngle": 1024,
        "FirstSeenTimestampUTC": 1_500_000,
        "LastSeenTimestampUTC": 1_900_000,
        "TagSeenCount": 4,
    }
    single = {**report, "FirstSeenTimestampUTC": 1_200_000, "LastSeenTimestampUTC": 1_200_000, "TagSeenCount": 1}
    (hall.parent / "run" / "tags.json").write_text(json.dumps([report, single]) + "\n")  # a report holds a list
    log = one(
        with_options(
            f'{WHEELS}\n[options.rfid]\nfile = "tags.json"\npreset = "sllurp_reports"\nround_gap = 0.1\n'
            "channels = { first = 902.75, step = 0.5 }\n"
        )
    )
    rfid = log.streams["rfid"]
    np.testing.assert_allclose(rfid.t - rfid.age, (0.2, 0.5, 0.9))
    np.testing.assert_allclose(rfid.rssi, (-50.0, -50.0, np.nan))
    np.testing.assert_allclose(rfid.phase[:2], np.pi / 2)
    np.testing.assert_allclose(rfid.frequency[:2], 903.75e6)
    assert set(rfid.epc) == {"e2001"}
    assert [w.fields["reads"] for w in log.warnings if w.kind == "summarized_reads"] == [2]


def test_rows_of_sllurp_log_and_rounds_that_another_file_tells(hall, with_options, one):
    folder = hall.parent / "run"
    (folder / "log.csv").write_text("timestamp,reader,antenna,rssi,epc\n1.15,r:5084,1,-60,aa\n1.12,r:5084,1,-61,bb\n")
    (folder / "rounds.csv").write_text("end,port,took\n1.2,1,200\n1.4,2,200\n")
    log = one(
        with_options(
            f'{WHEELS}\n[options.rfid]\nfile = "log.csv"\npreset = "sllurp_log"\nclock_offset = 0.01\n'
            '[options.inventories]\nfile = "rounds.csv"\ncolumns = { t = "end", antenna = "port", duration = "took" }\n'
            'units = { t = "s", duration = "ms" }\n'
        )
    )
    rfid = log.streams["rfid"]
    assert list(rfid.epc) == ["bb", "aa", ""]
    np.testing.assert_allclose(rfid.t, (0.2, 0.2, 0.4))
    np.testing.assert_allclose(rfid.age[:2], (0.07, 0.04), atol=1e-9)


def test_reads_in_several_files(hall, one, refused):
    folder = hall.parent / "run"
    expected = one(hall).streams["rfid"]
    head, first, last = READS.partition("1970-01-01T01:00:02")
    (folder / "reads.csv").unlink()
    (folder / "reads-b.csv").write_text(head)
    (folder / "reads-a.csv").write_text("".join(READS.splitlines(keepends=True)[:2]) + first + last)
    hall.write_text(MANIFEST.replace("reads.csv", "reads-*.csv"))
    found = one(hall).streams["rfid"]
    assert found.epc == expected.epc
    np.testing.assert_array_equal(found.t, expected.t)
    unread = [str(w) for w in one(hall).warnings if w.kind == "unread_columns"]
    assert sum("reads-a.csv and 1 more files: columns that are not read: TID" in line for line in unread) == 1
    (folder / "reads-c.csv").write_text(READS + "soon,e2001,,1,-60,866.3,r,1,0,\n")
    refused(hall, "reads-c.csv:6", "soon")
    hall.write_text(MANIFEST.replace("reads.csv", "log-*.csv"))
    refused(hall, "log-*.csv", "existing files")
    hall.write_text(MANIFEST.replace("reads.csv", "../*.csv"))
    refused(hall, "leaves its folder")


READERS = "\n".join(
    f"""
[options.readers.{name}]
file = "{name}.txt"
antenna = "{name}"
separator = " "
header = false
columns = {{ t = "8", epc = "2", frequency = "4", phase = "5", rssi = "6" }}
units = {{ t = "us", frequency = "MHz", phase = "deg" }}
"""
    for name in ("first", "second", "third")
)


def test_three_readers_of_a_recorded_robot(data_root, tmp_path, one):
    """The same reads as the converter of this data set gives within its span, to the last digit."""
    (tmp_path / "aisle.toml").write_text(
        MANIFEST.partition("[options")[0].replace('"run"', '"rfid_aisle/run13"')
        + '[options.odometry]\nfile = "reference_pose.txt"\nseparator = " "\nheader = false\nunits = { t = "s" }\n'
        + 'columns = { t = "4", x = "1", y = "2", heading = "3" }\n'
        + READERS
    )
    log = one(tmp_path / "aisle.toml", data_root=data_root)
    expected = recorded_log("rfid-aisle-run13", data_root)
    theirs, ours = expected.streams["rfid"], log.streams["rfid"]
    shift = (log.t0_ns - expected.t0_ns) / 1e9
    begin = np.searchsorted(ours.t + shift, theirs.t[0] - 1e-6)
    part = slice(begin, begin + len(theirs.t))
    np.testing.assert_allclose(ours.t[part] + shift, theirs.t, rtol=0, atol=2e-7)
    assert ours.epc[part] == theirs.epc
    assert ours.antenna[part] == theirs.antenna
    for column in ("age", "rssi", "phase", "frequency"):
        np.testing.assert_allclose(getattr(ours, column)[part], getattr(theirs, column), rtol=0, atol=1e-6)
