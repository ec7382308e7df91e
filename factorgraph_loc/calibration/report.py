"""The report of a calibration: a few lines, a self-contained HTML page, and a document for programs."""

import math
from collections.abc import Sequence
from typing import Any

from factorgraph_loc.calibration.calibrate import Calibration
from factorgraph_loc.calibration.held_out import ESTIMATORS, Trial, growth, pooled
from factorgraph_loc.calibration.learn import calibrators
from factorgraph_loc.drawing.pages import Part, Rows, sectioned
from factorgraph_loc.files.settings import settings_in
from factorgraph_loc.fitting.posterior import FittedConstant
from factorgraph_loc.model.scoring import KINDS
from factorgraph_loc.model.sections import sections
from factorgraph_loc.plugins import load
from factorgraph_loc.text import listed, number

FIGURES = {"position RMSE [m]": ("position_rmse", 3), "heading RMSE [rad]": ("heading_rmse", 4), "ANEES": ("anees", 1)}
MOST = 8  # lines of constants
CLEAR = 2.0  # standard deviations; smaller changes are within chance


def constants_table(constants: Sequence[FittedConstant]) -> Rows:
    """The constants before and after, with standard deviations, those of the priors too."""
    header = ("constant", "input rig", "learnt", "standard deviation", "before", "")
    rows: list[tuple[str, ...]] = [
        (
            _label(c),
            number(c.before),
            number(c.fitted),
            number(c.error),
            number(c.prior),
            "" if c.is_determined else "hardly determined",
        )
        for c in constants
    ]
    return header, rows


def accuracy_table(calibration: Calibration) -> Rows:
    """Errors on each held-out log, and pooled, with the input rig and with a rig learnt from the rest."""
    header = ("held-out log", "estimator", "rig", *(f"{kind} {name}" for kind in KINDS for name in FIGURES))
    rows = []
    logs = dict.fromkeys(t.log for t in calibration.trials)
    for log in (*logs, "all") if len(logs) > 1 else logs:
        for estimator in ESTIMATORS:
            trials = [t for t in calibration.trials if t.estimator == estimator and log in (t.log, "all")]
            for which, name in enumerate(("input", "learnt")):
                found = [number(pooled(trials, which, f"{k}.{f}"), n) for k in KINDS for f, n in FIGURES.values()]
                rows.append((log, estimator, name, *found))
    return header, rows


def summary(calibration: Calibration) -> list[str]:
    """The result in about ten lines: changed constants, undetermined ones, correlations, and held-out errors."""
    constants = calibration.knowledge.constants
    clear = [c for c in constants if c.is_determined and abs(c.fitted - c.before) > CLEAR * c.error]
    same = [_name(c) for c in constants if c.is_determined and c not in clear]
    lines = [f"learnt: {_name(c)} {number(c.before)} -> {number(c.fitted)} +- {number(c.error)}" for c in clear[:MOST]]
    if more := [_name(c) for c in clear[MOST:]]:
        lines.append(f"learnt, see the report: {listed(more)}")
    if same:
        lines.append(f"as in the input rig, within chance: {listed(same)}")
    if vague := [_name(c) for c in constants if not c.is_determined]:
        lines.append(f"hardly determined, so near the input rig: {listed(vague)}")
    if alike := [f"{a} and {b} ({rho:+.2f})" for a, b, rho in _correlations(calibration)]:
        lines.append(f"known mainly by their sum or difference (correlation): {listed(alike)}")
    for estimator in ESTIMATORS if calibration.trials else ():
        trials = [t for t in calibration.trials if t.estimator == estimator]
        figures = [
            f"{k} {_change(trials, f'{k}.position_rmse')} m, ANEES {_change(trials, f'{k}.anees', 1)}" for k in KINDS
        ]
        lines.append(f"held-out errors of {estimator}: {'; '.join(figures)}")
    if calibration.turns:
        lines.append(f"learnt without a reference, in {len(calibration.turns)} turns with the smoother")
    elif calibration.refused:
        lines.append(f"the input rig is kept: {calibration.refused}")
    elif math.isfinite(ratio := growth(calibration.trials)):
        lines.append(f"the position errors are {number(ratio, 2)} times those with the input rig")
    else:
        lines.append("the input rig lacks what its sensors need, so that its errors are not known")
    return lines


def document(calibration: Calibration) -> dict[str, Any]:
    """The report as plain values."""
    wanted = [f"{kind}.{figure}" for kind in KINDS for figure, _ in FIGURES.values()]
    return {
        "logs": list(calibration.logs),
        "constants": [
            {
                "sensor": c.sensor,
                "name": c.name,
                "before": c.before,
                "learnt": c.fitted,
                "standard_deviation": c.error,
                "prior": c.prior,
                "determined": c.is_determined,
                "per_log": list(c.per_log),
                "uncertainty": c.uncertainty,
            }
            for c in calibration.knowledge.constants
        ],
        "correlations": [{"constants": [a, b], "correlation": rho} for a, b, rho in _correlations(calibration)],
        **{
            key: value
            for name, found in calibration.knowledge.found.items()
            for key, value in calibrators()[name].document(found, calibration.rig).items()
        },
        "held_out": [
            {"log": t.log, "estimator": t.estimator}
            | {
                name: s and {key: s.get(key) for key in wanted}
                for name, s in (("before", t.before), ("after", t.after))
            }
            for t in calibration.trials
        ],
        "growth": growth(calibration.trials),
        "refused": calibration.refused,
        "turns": list(calibration.turns),
        "doubts": list(calibration.doubts),
        "rig": calibration.rig.model_dump(mode="json", exclude_none=True),
    }


def page(calibration: Calibration) -> str:
    """The report as one HTML page with embedded plots."""
    content: dict[str, list[Part]] = {"Summary": list(summary(calibration)), "Constants": [], "Noise": []}
    content["Constants"] = [_how(calibration), _long_constants(calibration)]
    if calibration.trials:
        explained = (
            "Each log is held out, or each half of a single one: the learnt rig is that of the rest. ANEES is ideal at 3 (at 2 "
            "without the reference's heading); above it the estimator is overconfident."
        )
        content["Accuracy"] = [explained, accuracy_table(calibration)]
    for name, found in calibration.knowledge.found.items():
        for title, parts in calibrators()[name].report(found, calibration.rig).items():
            content.setdefault(title, []).extend(parts)
    lead = f"From {', '.join(calibration.logs)}."
    return sectioned(f"Calibration of {calibration.rig.name}", lead, calibration.doubts, content)


def _how(calibration: Calibration) -> str:
    """How the constants were found."""
    if calibration.turns:
        turns = ", ".join(number(one, 1) for one in calibration.turns)
        return (
            "The logs have no reference. Smoothing the logs, and learning from the smoothed trajectories, took turns: the "
            f"largest change of a constant in each was {turns} of its standard deviations."
        )
    return (
        "All constants of a sensor are estimated together from all logs, with priors about the input rig. Where the standard "
        "deviation is not much smaller than that of the prior, before, the logs hardly determine a constant."
    )


def _long_constants(calibration: Calibration) -> Rows:
    header, rows = constants_table(calibration.knowledge.constants)
    parts = calibration.logs if len(calibration.logs) > 1 else ()
    long = []
    for row, c in zip(rows, calibration.knowledge.constants, strict=True):
        each = [number(v) for v in c.per_log] if len(c.per_log) == len(parts) else ["-"] * len(parts)
        long.append((*row, *each, number(c.uncertainty)))
    return (*header, *parts, "differs between logs by"), long


def _correlations(calibration: Calibration) -> list[tuple[str, str, float]]:
    return [
        (f"{calibrators()[name].section}.{a}", f"{calibrators()[name].section}.{b}", rho)
        for name, found in calibration.knowledge.found.items()
        for a, b, rho in found.correlations
    ]


def _change(trials: Sequence[Trial], key: str, digits: int = 3) -> str:
    return " -> ".join(number(pooled(trials, which, key), digits) for which in (0, 1))


def _name(c: FittedConstant) -> str:
    return f"{c.sensor}.{c.name}"


def _label(c: FittedConstant) -> str:
    settings = settings_in(load(sections()[c.sensor].kind))
    unit = next((one.unit for one in settings if one.key == c.name), "")
    return f"{_name(c)} [{unit}]" if unit else _name(c)
