"""Maps of tags made from the rfid-aisle recordings, with and without the phases of reads, compared with the surveyed positions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from benchmarking.report import Options, Report
from recorded_logs import recorded_log

from factorgraph_loc.experiments.maps import MapOptions, make_map
from factorgraph_loc.mapping.tag_mapping import MadeTags
from rfid_benchmark.aisle import RUNS

NEAR = 0.05  # m


def section(options: Options) -> Report:
    report = Report("maps", options)
    jobs = {
        (f"run {run}", "yes" if phases else "no"): (run, phases, options.data_root)
        for run in RUNS
        for phases in (True, False)
    }
    report.say("The table has distances [m] between mapped and surveyed positions of the tags.")
    rows = []
    for key, (distances, count) in report.collect(made, jobs).items():
        near = f"{np.mean(distances <= NEAR):.0%}"
        figures = (np.sqrt(np.mean(distances**2)), np.median(distances), distances.max())
        cells = [f"{len(distances)} of {count}", *(f"{figure:.3f}" for figure in figures), near]
        rows.append((*key, *cells))
    report.table(("log", "phases", "tags", "root mean square", "median", "largest", f"within {NEAR} m"), rows)
    return report


def made(run: int, phases: bool, data_root: Path | None) -> tuple[np.ndarray, int]:
    """Make a map of tags from a recording. Returns the distances [m] of located tags from their surveyed positions, and the
    number of surveyed tags."""
    log = recorded_log(f"rfid-aisle-run{run}", data_root)
    if not phases:
        assert log.rig.rfid is not None
        log = replace(log, rig=log.rig.model_copy(update={"rfid": log.rig.rfid.model_copy(update={"phase": None})}))
    found = make_map(log, MapOptions(of="tags")).details
    assert isinstance(found, MadeTags)
    distances = [entry.distance for entry in found.made.entries if entry.distance is not None]
    return np.array(distances), len(log.world.tags)
