"""Recorded logs by name: those that ``fgloc datasets`` lists, and those that scripts/convert writes."""

import re
from pathlib import Path

from rfid_aisle_log import read_rfid_aisle
from woods_log import read_woods

from factorgraph_loc.files.data_root import find_data_root
from factorgraph_loc.io.readers import describe, read_log
from factorgraph_loc.model.log import Log

WOODS, AISLE = "utias/dataset2.mat", "rfid_aisle"  # in the data folder
CONVERTED = {
    **{f"woods-r{max_range}": WOODS for max_range in (1, 3, 5)},
    **{f"rfid-aisle-run{run}": AISLE for run in (13, 16)},
}


def recorded_log(name: str, data_root: Path | None = None, odometry_seed: int = 0) -> Log:
    """Read the recorded log ``name``. ``data_root``: the data folder; None uses the environment variable FGLOC_DATA.
    ``odometry_seed``: the seed of the simulated odometry of rfid-aisle logs."""
    found = re.fullmatch(r"(woods-r|rfid-aisle-run)(\d+)", name)
    if found is None:
        return read_log(name, data_root=data_root)
    root = find_data_root(data_root, name)
    if found[1] == "woods-r":
        return read_woods(root / WOODS, float(found[2]))
    return read_rfid_aisle(root / AISLE, int(found[2]), odometry_seed)


def present_logs(data_root: Path | None = None) -> set[str]:
    """Return the names of the recorded logs whose files are in the data folder."""
    known = {dataset.name for dataset in describe(data_root) if dataset.present}
    if "mrclam6-robot1" not in known:
        return known
    root = find_data_root(data_root, "recorded logs")
    return known | {name for name, path in CONVERTED.items() if (root / path).exists()}
