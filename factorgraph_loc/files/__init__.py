"""Validated reading and atomic writing of files: text, tables, arrays, images, and settings (pydantic models)."""

__all__ = [
    "bounded",
    "cells",
    "checks",
    "column_mapping",
    "columns",
    "data_root",
    "images",
    "models",
    "row_rules",
    "settings",
    "several",
    "shipped",
    "tables",
    "temporary",
    "values",
    "yaml",
]
