"""A report of the results of an experiment as one HTML file that needs no other file."""

from factorgraph_loc.evaluation.report.page import write_report
from factorgraph_loc.evaluation.report.tracks import Scene

__all__ = ["Scene", "write_report"]
