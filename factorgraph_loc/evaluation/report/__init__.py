"""A report of results as one self-contained HTML file."""

from factorgraph_loc.evaluation.report.page import write_report
from factorgraph_loc.evaluation.report.tracks import Scene

__all__ = ["Scene", "write_report"]
