"""A summary of the results in words, which tables and charts support."""

from collections.abc import Mapping, Sequence

from factorgraph_loc.drawing.markup import Html, join, tag
from factorgraph_loc.evaluation.report.results import SCORED, MetricComparison, Results, score
from factorgraph_loc.evaluation.report.tables import p_value, uncertainty
from factorgraph_loc.evaluation.statistics import ENOUGH_LOGS

_SPOKEN = 2  # metrics whose best variant is named


def summary(
    results: Results,
    against_best: Sequence[MetricComparison],
    trust: Mapping[str, tuple[float, float, float]],
    damaged: Sequence[str] = (),
) -> Html:
    """The summary as paragraphs.

    ``against_best``: comparisons with the best variant of each metric. ``trust``: of each variant the mean NEES per degree of
    freedom of its causal poses, and its 95 % band for correct covariances. ``damaged``: runs that are excluded."""
    paragraphs = [_extent(results)]
    paragraphs += [_best(c) for c in [c for c in against_best if c.best is not None][:_SPOKEN]]
    paragraphs += _trust(trust)
    if damaged:
        left_out = f"{_count(len(damaged), 'run')} {_is(damaged)} damaged, and excluded: "
        paragraphs.append(join([left_out, _list(damaged), "; fgloc experiment run --verify makes them again."]))
    paragraphs += _cautions(results, against_best)
    return join(tag("p", paragraph) for paragraph in paragraphs)


def _extent(results: Results) -> Html:
    failed = sum(row["status"] != "ok" for row in results.rows)
    seeds = {row["seed"] for row in results.rows}
    outcome = "All succeeded." if not failed else tag("strong", f"{failed} of them failed.")
    several = f" and up to {len(seeds)} seeds each" if len(seeds) > 1 else ""
    compared = f"{_count(len(results.variants), 'estimator')} on {_count(len(results.logs), 'log')}{several}"
    return join((f"{compared}: {_count(len(results.rows), 'run')}. ", outcome))


def _best(c: MetricComparison) -> Html:
    assert c.best is not None
    figure, unit = c.pooled[c.best], f" {c.metric.unit}" if c.metric.unit else ""
    sure = uncertainty(c.metric, figure)
    range_of = f" (from log to log {sure})" if sure and figure.units == "logs" else f" (from seed to seed {sure})"
    about = f" (95 % interval {sure})" if figure.low is not None else range_of if sure else ""
    parts: list[object] = [
        f"The {'least' if c.metric.better == 'low' else 'largest'} {c.metric.title} is that of ",
        tag("strong", c.best),
        f": {c.metric.text(figure.value)}{unit}{about}. ",
    ]
    tied = [v for v in c.contrasts if c.can_tell and c.p[v] is not None and not c.is_significant(v)]
    worse = [v for v in c.contrasts if c.is_significant(v)]
    if tied:
        parts += ["It is not significantly different from that of ", _list(tied), ". "]
    if worse:
        apart = {v: c.metric.text(c.contrasts[v].difference, sign=True) for v in worse}
        told = [join([tag("strong", v), f" ({apart[v]}{unit}, p {p_value(c.p[v])})"]) for v in worse]
        parts += ["It differs significantly from that of ", _and(told), "."]
    missing = [v for v in c.pooled if c.contrasts.get(v) is not None and c.contrasts[v].count < c.pooled[c.best].count]
    if missing:
        parts += [" ", _list(missing), f" {'lacks' if len(missing) == 1 else 'lack'} some of the logs."]
    return join(parts)


def _trust(trust: Mapping[str, tuple[float, float, float]]) -> list[Html]:
    sure = [v for v, (mean, _, high) in trust.items() if mean > high]
    timid = [v for v, (mean, low, _) in trust.items() if mean < low]
    right = [v for v, (mean, low, high) in trust.items() if low <= mean <= high]
    told: list[Html] = []
    if sure:
        told.append(join([_list(sure), f" {_is(sure)} overconfident"]))
    if timid:
        told.append(join([_list(timid), f" {_is(timid)} underconfident"]))
    if right:
        told.append(join(["the stated covariances of ", _list(right), " are consistent with the errors"]))
    return [join(["Consistency of causal estimates: ", join(told, "; "), "."])] if told else []


def _cautions(results: Results, comparisons: Sequence[MetricComparison]) -> list[Html]:
    told: list[tuple[object, ...]] = []
    if poor := results.unscored():
        told.append((f"Fewer than {SCORED} poses of ", _list(poor), " have a reference: nothing is scored there."))
    found = [c for comparison in comparisons for c in comparison.contrasts.values()]
    if found and all(c.p is None for c in found):
        units = f"{ENOUGH_LOGS} logs, or {ENOUGH_LOGS} seeds of one log"
        told.append((f"With fewer than {units}, nothing is tested: read the figures log by log.",))
    untold = [c for c in comparisons if not c.can_tell and any(p is not None for p in c.p.values())]
    if untold:
        tested = [c for c in untold[0].contrasts.values() if c.p is not None]
        most = max(tested, key=lambda c: c.count)
        few = f"{most.count} {most.units} are too few for {len(tested)} comparisons: "
        told.append((f"{few}whatever the difference, it cannot become significant.",))
    if all(score(row, c.metric.key) is None for row in results.rows for c in comparisons):
        told.append(("No run has any of the requested scores.",))
    return [join(parts) for parts in told]


def _count(count: int, what: str) -> str:
    return f"{count:,} {what}{'' if count == 1 else 's'}".replace(",", "\u202f")


def _is(names: Sequence[str]) -> str:
    return "is" if len(names) == 1 else "are"


def _list(names: Sequence[str]) -> Html:
    """**a**, **a** and **b**, **a**, **b** and **c**; of many the first ones, and the number of the rest."""
    return _and([tag("strong", name) for name in names])


def _and(parts: Sequence[Html]) -> Html:
    shown: list[object] = [*parts[:5], f"{len(parts) - 5} more"] if len(parts) > 6 else list(parts)
    return join([join(shown[:-1], ", "), " and ", shown[-1]]) if len(shown) > 1 else join(shown)
