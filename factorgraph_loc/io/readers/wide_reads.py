"""Reads of tags from tables with a column of strengths per tag or per antenna."""

from pathlib import Path

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.column_mapping import ColumnMapping, Mapped, read_mapped
from factorgraph_loc.files.csv_cells import Cells
from factorgraph_loc.text import listed, quoted

NAME = "the * of "  # and the pattern: the column of the names


def read_wide(path: Path, mapping: ColumnMapping, antenna: str | None) -> Mapped:
    """The reads of a table whose columns of strengths are a pattern, ``rssi_*``, with a row for each cell that is not empty.

    What ``*`` stands for in a column's name is its antenna, or its tag if ``columns`` maps the antenna or ``antenna``, the only
    one, is given. InputError names file, row and column.
    """
    pattern = mapping.columns["rssi"]
    fixed = {field: column for field, column in mapping.columns.items() if field != "rssi"}
    missing = "epc" if "antenna" in fixed or antenna is not None else "antenna"
    if set(fixed) | {missing} != {"t", "epc", *(() if antenna is not None else ("antenna",))} or missing in fixed:
        expected = "t and one of epc, antenna" if antenna is None else "t"
        raise InputError(f"{path}: with rssi = {quoted(pattern)} columns maps {listed(fixed)}, expected {expected}")
    units = {field: unit for field, unit in mapping.units.items() if field != "rssi"}
    narrow = read_mapped(path, mapping.model_copy(update={"columns": fixed, "units": units}), (tuple(fixed),))
    before, _, after = pattern.partition("*")
    names = {
        column: column[len(before) : len(column) - len(after)]
        for column in narrow.left_out
        if column.startswith(before) and column.endswith(after) and len(column) > len(before) + len(after)
    }
    if not names:
        raise InputError(f"{path}: has no column {quoted(pattern)}, it has {listed(narrow.left_out)}")
    strengths = {f"{NAME}{column}": column for column in names}
    told = mapping.model_copy(update={"columns": fixed | strengths, "units": units})
    wide = read_mapped(path, told, (tuple(fixed),), tuple(strengths))
    cells = wide.cells.columns
    reads = [(i, column) for i in range(len(wide.rows)) for column in names if cells[column][i]]
    if not reads:
        raise InputError(f"{path}: contains no reads: all cells of {quoted(pattern)} are empty")
    columns = {column: [cells[column][i] for i, _ in reads] for column in fixed.values()}
    columns[pattern] = [cells[column][i] for i, column in reads]
    columns[NAME + pattern] = [names[column] for _, column in reads]
    of_reads = mapping.model_copy(update={"columns": mapping.columns | {missing: NAME + pattern}})
    rows = [wide.cells.rows[i] for i, _ in reads]
    return Mapped(
        Cells(path, rows, columns), of_reads, tuple(of_reads.columns), wide.passed, wide.left_out, wide.unwanted
    )
