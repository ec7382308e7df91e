"""A page of results: one HTML file that needs nothing else."""

from factorgraph_loc.evaluation.report.page import write_report
from factorgraph_loc.evaluation.report.reading import RunFiles
from factorgraph_loc.evaluation.report.scene import Scene

__all__ = ["RunFiles", "Scene", "write_report"]
