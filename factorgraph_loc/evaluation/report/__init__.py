"""A report of results as one self-contained HTML file."""

from factorgraph_loc.evaluation.report.metrics import DEFAULT
from factorgraph_loc.evaluation.report.page import remark, whole_page, write_report
from factorgraph_loc.evaluation.report.results import RunFiles
from factorgraph_loc.evaluation.report.scene import Scene

__all__ = ["DEFAULT", "RunFiles", "Scene", "remark", "whole_page", "write_report"]
