"""The report of a calibration: a few lines of text, an HTML page, and a dictionary for JSON."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from factorgraph_loc.calibration.calibrate import Calibration
from factorgraph_loc.calibration.held_out import ESTIMATORS, RIGS, Trial, growth, pooled
from factorgraph_loc.calibration.learn import calibrators
from factorgraph_loc.drawing.figures import COLOURS, grid, legend, png
from factorgraph_loc.drawing.pages import Part, Picture, Rows, sectioned
from factorgraph_loc.files.settings import settings_in
from factorgraph_loc.fitting.posterior import FittedConstant
from factorgraph_loc.model.scoring import KINDS
from factorgraph_loc.model.sections import kind_of, sections
from factorgraph_loc.plugins import load
from factorgraph_loc.sensors.calibrating import Residuals
from factorgraph_loc.text import listed, number

FIGURES = {"position RMSE [m]": ("position_rmse", 3), "heading RMSE [rad]": ("heading_rmse", 4), "ANEES": ("anees", 1)}
MOST = 5  # maximum number of constants that the summary lists
CLEAR = 2.0  # standard deviations; smaller changes of a constant may be chance
DOTS = 3000  # residuals of a log that are drawn in a panel, approximately
VIEW = 5.0  # standard deviations; larger residuals are drawn at the edge


def constants_table(constants: Sequence[FittedConstant], logs: Sequence[str] = ()) -> Rows:
    """Return a table of constants, as header and list of rows: initial value, learnt value with standard deviation,
    prior. ``logs``: names of the logs. If there are any, the table also has the values that are learnt from each log
    separately."""
    header = ("constant", "input rig", "learnt", "standard deviation", "prior", "", *logs)
    rows = []
    for c in constants:
        figures = [number(value) for value in (c.initial, c.fitted, c.error, c.prior)]
        each = [number(value) for value in c.per_log] if len(c.per_log) == len(logs) else ["-"] * len(logs)
        rows.append((_label(c), *figures, "" if c.is_determined else "not determined", *each))
    return header, rows


def accuracy_table(calibration: Calibration) -> Rows:
    """Return a table of errors, as header and list of rows. The errors are those with the input rig and a learnt rig,
    on each held-out log and on all. For each held-out log, the rig is learnt from the other logs."""
    header = ("held-out log", "estimator", "rig", *(f"{kind} {name}" for kind in KINDS for name in FIGURES))
    rows = []
    logs = dict.fromkeys(t.log for t in calibration.trials)
    for log in (*logs, "all") if len(logs) > 1 else logs:
        for estimator in ESTIMATORS:
            trials = [t for t in calibration.trials if t.estimator == estimator and log in (t.log, "all")]
            for name in RIGS:
                values = [number(pooled(trials, name, f"{k}.{f}"), n) for k in KINDS for f, n in FIGURES.values()]
                rows.append((log, estimator, name, *values))
    return header, rows


def summary(calibration: Calibration) -> list[str]:
    """Return about ten lines of text: changed and undetermined constants, correlations, and errors on held-out logs."""
    constants = calibration.knowledge.constants
    clear = [c for c in constants if c.is_determined and abs(c.fitted - c.initial) > CLEAR * c.error]
    same = [_name(c) for c in constants if c.is_determined and c not in clear]
    lines = [f"learnt: {_name(c)} {number(c.initial)} -> {number(c.fitted)} +- {number(c.error)}" for c in clear[:MOST]]
    if more := [_name(c) for c in clear[MOST:]]:
        lines.append(f"learnt, see the report: {listed(more)}")
    if same:
        lines.append(f"no significant change from the input rig: {listed(same)}")
    if vague := [_name(c) for c in constants if not c.is_determined]:
        lines.append(f"not determined by the logs, and therefore near the input rig: {listed(vague)}")
    if alike := [f"{a} and {b} ({rho:+.2f})" for a, b, rho in _correlations(calibration)]:
        lines.append(f"strongly correlated, so that only their sum or difference is certain: {listed(alike)}")
    for estimator in ESTIMATORS if calibration.trials else ():
        trials = [t for t in calibration.trials if t.estimator == estimator]
        figures = [
            f"{k} {_change(trials, f'{k}.position_rmse')} m, ANEES {_change(trials, f'{k}.anees', 1)}" for k in KINDS
        ]
        lines.append(f"held-out errors of {estimator}: {'; '.join(figures)}")
    if calibration.knowledge.turns:
        turns = len(calibration.knowledge.turns)
        lines.append(
            f"learnt without a reference, in {turns} turns with the smoother; noise and [survey] are not learnt"
        )
    elif calibration.refused:
        lines.append(f"the input rig is kept: {calibration.refused}")
    elif math.isfinite(ratio := growth(calibration.trials)):
        lines.append(f"the position errors are {number(ratio, 2)} times those with the input rig")
    else:
        lines.append("the errors of the input rig are unknown, because it lacks settings that its sensors need")
    return lines


def document(calibration: Calibration) -> dict[str, Any]:
    """Return the report as a dictionary for JSON. Its keys include ``constants``, ``held_out`` (scores), ``refused``,
    ``rig``."""
    wanted = [f"{kind}.{figure}" for kind in KINDS for figure, _ in FIGURES.values()]
    return {
        "logs": list(calibration.logs),
        "constants": [asdict(c) | {"is_determined": c.is_determined} for c in calibration.knowledge.constants],
        "correlations": [{"constants": [a, b], "correlation": rho} for a, b, rho in _correlations(calibration)],
        "figures": {name: dict(sensor.figures) for name, sensor in calibration.knowledge.sensors.items()},
        "held_out": [
            {"log": t.log, "estimator": t.estimator}
            | {rig: scores and {key: scores.get(key) for key in wanted} for rig, scores in t.scores.items()}
            for t in calibration.trials
        ],
        "growth": growth(calibration.trials),
        "refused": calibration.refused,
        "turns": list(calibration.knowledge.turns),
        "doubts": [str(doubt) for doubt in calibration.doubts],
        "rig": calibration.rig.model_dump(mode="json", exclude_none=True),
    }


def page(calibration: Calibration) -> str:
    """Return the report as one HTML page with embedded plots."""
    logs = calibration.logs if len(calibration.logs) > 1 else ()
    content: dict[str, list[Part]] = {
        "Summary": list(summary(calibration)),
        "Constants": [_method(calibration), constants_table(calibration.knowledge.constants, logs)],
    }
    if calibration.trials:
        explained = (
            "Each log, or each half of a single log, is held out once. There the learnt rig is learnt from the other data. The "
            "ideal ANEES is 3, or 2 without headings in the reference. Above it the estimator is overconfident."
        )
        content["Accuracy"] = [explained, accuracy_table(calibration)]
    for name, sensor in calibration.knowledge.sensors.items():
        parts = [*_tables(sensor.figures), *calibrators(calibration.rig)[name].pictures(sensor)]
        if sensor.residuals:
            parts.append(_residuals_figure(sensor.residuals))
        if parts:
            content[name.capitalize()] = parts
    lead = f"From {', '.join(calibration.logs)}."
    return sectioned(f"Calibration of {calibration.rig.name}", lead, calibration.doubts, content)


def _method(calibration: Calibration) -> str:
    """Return a paragraph about the method of the calibration."""
    if calibration.knowledge.turns:
        turns = ", ".join(number(change, 1) for change in calibration.knowledge.turns)
        return (
            "The logs were smoothed, and constants were learnt from the smoothed trajectories, in turns. Largest change of a "
            f"constant in each turn, in standard deviations: {turns}."
        )
    return (
        "All constants of a sensor are estimated together from all logs, with priors about the input rig. A constant is "
        "determined if its standard deviation is clearly below that of the prior."
    )


def _tables(figures: Mapping[str, Any]) -> list[Part]:
    """Return a table of the single values in ``figures``, and one table for each list of rows in it."""
    single = [{"figure": name, "value": value} for name, value in figures.items() if not isinstance(value, list)]
    tables: list[Part] = []
    for rows in filter(None, (single, *(value for value in figures.values() if isinstance(value, list)))):
        texts = [[number(v) if isinstance(v, float) else str(v) for v in row.values()] for row in rows]
        tables.append((tuple(rows[0]), [tuple(row) for row in texts]))
    return tables


def _residuals_figure(logs: Sequence[Residuals]) -> Picture:
    """Return a figure of the residuals of a sensor. It has a row of three panels for each quantity: a histogram, the
    residuals over distance, and the residuals over time. ``logs``: the residuals of each log."""
    known = [i for i in range(len(logs[0].units)) if any(np.isfinite(log.errors[:, i]).any() for log in logs)]
    figure, axes = grid(len(known), 3, 4.0 * len(known))
    for panels, column in zip(axes, known, strict=True):
        name, unit = list(logs[0].units.items())[column]
        sigmas = np.concatenate([log.sigmas[:, column] for log in logs])
        limit = VIEW * float(np.nanmedian(sigmas))
        edges = np.linspace(-limit, limit, 61)
        for i, log in enumerate(logs):
            values = np.clip(log.errors[:, column], -limit, limit)
            dots = slice(None, None, max(1, len(values) // DOTS))
            style: dict[str, Any] = {"color": COLOURS[i % len(COLOURS)], "label": log.log}
            panels[0].hist(values[np.isfinite(values)], edges, density=True, histtype="step", linewidth=1.5, **style)
            panels[1].plot(log.distance[dots], values[dots], ".", markersize=2, **style)
            panels[2].plot(log.t[dots], values[dots], ".", markersize=2, **style)
        density = np.exp(-0.5 * (edges[:, None] / sigmas) ** 2) / (sigmas * np.sqrt(2.0 * np.pi))
        panels[0].plot(edges, np.nanmean(density, axis=1), color="0.3", linestyle="--", label="learnt noise")
        panels[0].set(xlabel=f"{name} residual [{unit}]", ylabel=f"density [1/{unit}]")
        panels[1].set(xlabel="distance [m]", ylabel=f"{name} residual [{unit}]")
        panels[2].set(xlabel="time [s]", ylabel=f"{name} residual [{unit}]")
    legend(figure, axes.flat, markers=3.0)
    return png(figure)


def _correlations(calibration: Calibration) -> list[tuple[str, str, float]]:
    """Return tuples (constant, other constant, correlation) of the constants that are strongly correlated."""
    known = {name: calibrator.section for name, calibrator in calibrators(calibration.rig).items()}
    return [
        (f"{known[name]}.{a}", f"{known[name]}.{b}", rho)
        for name, sensor in calibration.knowledge.sensors.items()
        for a, b, rho in sensor.correlations
    ]


def _change(trials: Sequence[Trial], key: str, digits: int = 3) -> str:
    """Return the pooled score ``key`` with the input rig and with the learnt rig: "0.123 -> 0.098"."""
    return " -> ".join(number(pooled(trials, rig, key), digits) for rig in RIGS)


def _name(c: FittedConstant) -> str:
    return f"{c.sensor}.{c.name}"


def _label(c: FittedConstant) -> str:
    """Return the name of a constant with its unit."""
    settings = settings_in(load(sections()[kind_of(c.sensor)].kind))
    unit = next((setting.unit for setting in settings if setting.key == c.name), "")
    return f"{_name(c)} [{unit}]" if unit else _name(c)
