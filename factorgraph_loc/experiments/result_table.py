"""The table of all results of an experiment, with a row for each run."""

from collections.abc import Iterable
from pathlib import Path

import polars as pl

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.warned import WARNINGS
from factorgraph_loc.experiments.execute import Planned
from factorgraph_loc.experiments.store import Store, StoreError
from factorgraph_loc.files.bounded import kind
from factorgraph_loc.files.tables import read_parquet, write_parquet
from factorgraph_loc.io.results import INDEX
from factorgraph_loc.text import error_text

TEXTS = {"label", "log", "estimator", "sensors", "prior", "status", "kind", "reason", "key", "scoring.align", WARNINGS}


def collect(runs: Iterable[Planned], store: Store) -> pl.DataFrame:
    """Return a table with a row for each of ``runs``, see :func:`load_results`. ``store``: the store with their
    results. Raises DamagedError if a result is missing or damaged."""
    rows = [run.columns | store.row(run.key) for run in runs]
    keys = dict.fromkeys(key for row in rows for key in row) or dict.fromkeys(sorted(TEXTS))
    table = pl.DataFrame(rows, schema=list(keys), infer_schema_length=None)
    nothing = {
        name: pl.String if name in TEXTS else pl.Float64 for name, kind in table.schema.items() if kind == pl.Null
    }
    return table.cast(nothing)  # type: ignore[arg-type]


def write_index(table: pl.DataFrame, folder: Path) -> None:
    """Write the table of results into ``folder``, atomically. Raises StoreError if it cannot be written."""
    try:
        write_parquet(table, folder / INDEX)
    except OSError as error:
        raise StoreError(f"{folder / INDEX}: cannot be written: {error_text(error)}") from error


def load_results(path: str | Path) -> pl.DataFrame:
    """Return the results of an experiment as a table with a row for each run. ``path``: folder of the results.

    The columns are:

    - ``label``, ``log``, ``estimator``, ``prior``, ``seed``. ``sensors``: separated by commas, null for the rig's
      sensors.
    - ``sweep.KEY``: value of each swept setting, null if it does not apply to the run.
    - ``status``: ok or failed. ``kind`` (error, timeout, memory, killed, vanished), ``reason``: of a failure.
    - ``key``: key of the stored files. ``duration`` [s]: of the log. ``warnings``: a text with one warning per line.
    - the scores of :func:`~factorgraph_loc.evaluation.metrics.score`, null for failed runs.

    Raises InputError if there are no results.
    """
    file = Path(path) / INDEX if kind(Path(path)) == "a folder" else Path(path)
    try:
        return read_parquet(file)
    except InputError as error:
        raise InputError(f"{error}; `fgloc experiment run` writes it again") from error
