"""Processor time of the runs of an experiment, on its first log."""

from __future__ import annotations

from collections.abc import Mapping
from time import process_time

from factorgraph_loc.experiments.experiment import Prepared
from factorgraph_loc.experiments.run import run

MINUTE = 60.0  # s


def seconds_per_minute(prepared: Prepared, names: Mapping[str, str]) -> dict[tuple[str, str], float]:
    """Processor time [s] per minute of drive by name and label; ``names`` as for :func:`~smoothing_tables.cases.cases_of`.

    That of the second run of two, as the first one compiles: causal estimates and final trajectory, without simulation and
    scoring.
    """
    first = prepared.runs[0].log
    log = prepared.runs[0].source.load()
    found = {}
    for planned in prepared.runs:
        name = names.get(",".join(planned.sensors or ()))
        if planned.log != first or name is None:
            continue
        run(log, planned.config)
        started = process_time()
        run(log, planned.config)
        found[name, planned.label] = (process_time() - started) * MINUTE / planned.duration
    return found
