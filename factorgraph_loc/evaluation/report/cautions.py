"""What the results do not support, in words."""

from collections.abc import Sequence

from factorgraph_loc.evaluation.metrics import FEWEST_SCORED
from factorgraph_loc.evaluation.report.results import MetricComparison, Results, score
from factorgraph_loc.evaluation.statistics import ENOUGH_LOGS
from factorgraph_loc.text import listed


def cautions(results: Results, comparisons: Sequence[MetricComparison]) -> list[str]:
    """Sentences on logs that are not scored, and on differences that cannot become significant."""
    said = []
    if poor := results.unscored():
        said.append(f"Fewer than {FEWEST_SCORED} poses of {listed(poor)} have a reference: nothing is scored there.")
    contrasts = [c for comparison in comparisons for c in comparison.contrasts.values()]
    if contrasts and all(c.p is None for c in contrasts):
        units = f"{ENOUGH_LOGS} logs, or {ENOUGH_LOGS} seeds of one log"
        said.append(f"With fewer than {units}, nothing is tested: read the figures log by log.")
    untold = [c for c in comparisons if not c.can_tell and any(p is not None for p in c.p.values())]
    if untold:
        tested = [c for c in untold[0].contrasts.values() if c.p is not None]
        most = max(tested, key=lambda c: c.count)
        few = f"{most.count} {most.units} are too few for {len(tested)} comparisons"
        said.append(f"{few}: whatever the difference, it cannot become significant.")
    if all(score(row, c.metric.key) is None for row in results.rows for c in comparisons):
        said.append("No run has any of the requested scores.")
    return said
