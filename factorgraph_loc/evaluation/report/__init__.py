"""A report of results as one self-contained HTML file."""

from factorgraph_loc.evaluation.report.page import write_report
from factorgraph_loc.evaluation.report.reading import RunFiles
from factorgraph_loc.evaluation.report.scene import Scene
from factorgraph_loc.evaluation.report.shell import remark, whole_page

__all__ = ["RunFiles", "Scene", "remark", "whole_page", "write_report"]
