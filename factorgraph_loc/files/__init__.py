"""Bounded text, numbers, tables and models of settings in files; what is wrong with them is one line."""

__all__ = [
    "bounded",
    "checks",
    "column_mapping",
    "columns",
    "csv_cells",
    "images",
    "models",
    "npz",
    "parquet",
    "quiet",
    "shipped",
    "tables",
    "temporary",
    "values",
    "yaml",
]
