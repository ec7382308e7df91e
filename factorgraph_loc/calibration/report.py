"""The report of a calibration, as a self-contained HTML page and as a document for programs."""

import math
from collections.abc import Sequence
from typing import Any

from factorgraph_loc.calibration.calibrate import Calibration, Scores, estimator_for
from factorgraph_loc.drawing.pages import Part, Rows, sectioned
from factorgraph_loc.files.settings import settings_in
from factorgraph_loc.fitting.constants import FittedConstant
from factorgraph_loc.io.results import KINDS
from factorgraph_loc.model.sections import sections
from factorgraph_loc.plugins import load
from factorgraph_loc.text import number
from factors.se2 import Array

FIGURES = {"position RMSE [m]": ("position_rmse", 3), "heading RMSE [rad]": ("heading_rmse", 4), "ANEES": ("anees", 1)}


def constants_table(constants: Sequence[FittedConstant]) -> Rows:
    """The constants before and after, with standard errors."""
    header = ("constant", "input rig", "fitted", "standard error", "in the rig")
    rows: list[tuple[str, ...]] = [
        (_label(c), number(c.before), number(c.fitted), number(c.error), number(c.value) if c.kept else "as before")
        for c in constants
    ]
    return header, rows


def judgements_table(calibration: Calibration) -> Rows:
    """The verdict on each learnt parameter, with results on held-out stretches with and without it."""
    figures_of = (f"{how} {name}" for name in FIGURES for how in ("new", "old"))
    header = ("parameter", "judged", "gain", "standard error", *figures_of)
    rows: list[tuple[str, ...]] = []
    for one in calibration.judgements:
        pairs = zip(one.new[0].tolist(), one.old[0].tolist(), [n for _, n in FIGURES.values()], strict=True)
        figures = [number(value, digits) for new, old, digits in pairs for value in (new, old)]
        verdict = "accepted" if one.accepted else "refused"
        rows.append((_parameters(one.names), verdict, number(one.gain, 3), number(one.error, 3), *figures))
    return header, rows


def accuracy_table(calibration: Calibration) -> Rows:
    """Accuracy on each log with the input rig, the new rig, and a rig learnt from the other logs."""
    header = ("log", "rig", *(f"{kind} {name}" for kind in KINDS for name in FIGURES))
    rigs: list[tuple[str, tuple[Scores, ...]]] = [("input", calibration.before), ("calibrated", calibration.after)]
    if calibration.held_out:
        rigs.append(("from the other logs", calibration.held_out))
    rows = []
    for i, log in enumerate(calibration.logs):
        for name, scores in rigs:
            if not scores:
                continue
            found = [number(scores[i][f"{k}.{figure}"], n) for k in KINDS for figure, n in FIGURES.values()]
            rows.append((log, name, *found))
    return header, rows


def sensor_tables(calibration: Calibration) -> list[Rows]:
    """The tables of the sensors, such as survey, mounting and detection models."""
    return [table for calibrator, told in calibration.told() for table in calibrator.tables(told)]


def document(calibration: Calibration) -> dict[str, Any]:
    """The report as plain values."""
    wanted = [f"{kind}.{figure}" for kind in KINDS for figure, _ in FIGURES.values()]

    def scores(found: Sequence[Scores]) -> dict[str, Any]:
        return {log: {key: s[key] for key in wanted} for log, s in zip(calibration.logs, found, strict=False)}

    return {
        "logs": list(calibration.logs),
        "constants": [
            {
                "sensor": c.sensor,
                "name": c.name,
                "before": c.before,
                "fitted": c.fitted,
                "standard_error": c.error,
                "kept": c.kept,
                "why": c.why,
                "per_log": list(c.per_log),
                "uncertainty": c.uncertainty,
            }
            for c in calibration.knowledge.constants
        ],
        "judged": [
            {
                "parameters": list(one.names),
                "accepted": one.accepted,
                "why": one.why,
                "gain": one.gain,
                "gain_error": one.error,
                "new": _figures(one.new),
                "old": _figures(one.old),
            }
            for one in calibration.judgements
        ],
        **{key: value for calibrator, told in calibration.told() for key, value in calibrator.document(told).items()},
        "before": scores(calibration.before),
        "after": scores(calibration.after),
        "held_out": scores(calibration.held_out),
        "turns": list(calibration.turns),
        "doubts": list(calibration.doubts),
        "rig": calibration.rig.model_dump(mode="json", exclude_none=True),
    }


def _parameters(names: Sequence[str]) -> str:
    """Names of parameters of one section, with the section named once."""
    section = names[0].partition(".")[0]
    return f"{section}." + ", ".join(name.removeprefix(f"{section}.") for name in names)


def _figures(values: Array) -> dict[str, float]:
    names = (figure for figure, _ in FIGURES.values())
    return {f"{kind}.{name}": float(values[k, i]) for i, name in enumerate(names) for k, kind in enumerate(KINDS)}


def page(calibration: Calibration) -> str:
    """The report as one HTML page with embedded plots."""
    sections: dict[str, list[Part]] = {"Constants": [_how(calibration), _long_constants(calibration)], "Noise": []}
    for calibrator, told in calibration.told():
        for title, parts in calibrator.report(told).items():
            sections.setdefault(title, []).extend(parts)
    for title, parts in (_judgements(calibration) | _accuracy(calibration)).items():
        sections[title] = list(parts)
    lead = f"From {', '.join(calibration.logs)}. {_verdict(calibration)}"
    return sectioned(f"Calibration of {calibration.rig.name}", lead, calibration.doubts, sections)


def _how(calibration: Calibration) -> str:
    """How the constants were found."""
    each = "The fits to each log show how much it differs between runs." if len(calibration.logs) > 1 else ""
    if calibration.turns:
        turns = ", ".join(number(one, 1) for one in calibration.turns)
        return (
            "The logs have no reference. Smoothing the logs, and learning from the smoothed trajectories, took turns: the "
            f"largest change of a constant in each was {turns} of its standard errors. One of the odometry or of landmarks is kept "
            f"if its mean over the logs differs from the input beyond chance. {each}"
        )
    whose = "the other logs" if len(calibration.logs) > 1 else "another fifth of the log"
    return (
        f"A constant is kept if it improves the prediction of held-out data: {whose}, and if it improves the "
        f"{_estimator(calibration)}. Otherwise the rig keeps the input value. {each}"
    )


def _accuracy(calibration: Calibration) -> dict[str, Sequence[Part]]:
    """The accuracy of the judging estimator, if there is a reference."""
    if calibration.turns:
        return {}
    unseen = (
        "The rows from the other logs are cross-validated: only the factor on the noise has used the log."
        if calibration.held_out
        else "With one log there is no cross-validation: test the rig on another log."
    )
    explained = (
        "ANEES is ideal at 3 (at 2 without the reference's heading); above it the estimator is overconfident. " + unseen
    )
    return {f"Accuracy of the {_estimator(calibration)}": [explained, accuracy_table(calibration)]}


def _verdict(calibration: Calibration) -> str:
    change = [
        after["causal.position_rmse"] / before["causal.position_rmse"]
        for before, after in zip(calibration.before, calibration.after, strict=False)
        if before["causal.position_rmse"] and after["causal.position_rmse"]
    ]
    kept = sum(c.kept for c in calibration.knowledge.constants)
    told = f"{kept} of {len(calibration.knowledge.constants)} constants were worth changing."
    if change:
        mean = math.exp(sum(map(math.log, change)) / len(change))
        told += f" The {_estimator(calibration)}'s position error is {mean:.2f} times that with the input rig."
    return told


def _long_constants(calibration: Calibration) -> Rows:
    header, rows = constants_table(calibration.knowledge.constants)
    parts = calibration.logs if len(calibration.logs) > 1 else ("first half", "second half")
    long = []
    for row, c in zip(rows, calibration.knowledge.constants, strict=True):
        each = [number(v) for v in c.per_log] or ["-"] * len(parts)
        long.append((*row, *each, number(c.uncertainty), c.why))
    return (*header, *parts, "differs between logs by", "why"), long


def _judgements(calibration: Calibration) -> dict[str, Sequence[Part]]:
    if not calibration.judgements:
        return {}
    whose = "the other logs" if len(set(calibration.logs)) > 1 else "the other parts of the log"
    explained = (
        f"The {_estimator(calibration)} ran on held-out stretches with each parameter as learnt from {whose} (new), and without "
        "it (old). A parameter is accepted if it improves the score, which combines accuracy and consistency [nats per pose], "
        "significantly, and increases no error by more than 2 %. Otherwise the rig keeps the input value."
    )
    return {"Selection": [explained, judgements_table(calibration)]}


def _estimator(calibration: Calibration) -> str:
    name = estimator_for(calibration.rig)
    return name.upper() if name == "ekf" else name


def _label(c: FittedConstant) -> str:
    settings = settings_in(load(sections()[c.sensor].kind))
    unit = next((one.unit for one in settings if one.key == c.name), "")
    return f"{c.sensor}.{c.name} [{unit}]" if unit else f"{c.sensor}.{c.name}"
