"""The report of a calibration: one HTML page that needs no other file, and the same as a document for programs."""

import math
from collections.abc import Sequence
from typing import Any

from factorgraph_loc.calibration import figures
from factorgraph_loc.calibration.calibrate import Calibration, Scores
from factorgraph_loc.calibration.constants import Learnt
from factorgraph_loc.calibration.selection import MODEL, NOISE, SCATTER
from factorgraph_loc.drawing.markup import image, table, text
from factorgraph_loc.sensors.rfid.calibration import figures as rfid_figures
from factorgraph_loc.sensors.rfid.calibration import report as rfid_report
from factors.se2 import Array

UNITS = {
    "speed_bias": "m/s",
    "heading_rate_bias": "rad/s",
    "heading_drift": "rad/m",
    "direction": "rad",
    "delay": "s",
    "lag": "s",
    "turn_slowdown": "m/rad",
    "x": "m",
    "y": "m",
    "bearing_bias": "rad",
    "depth_axis": "rad",
    "time_offset": "s",
}
Rows = tuple[tuple[str, ...], list[tuple[str, ...]]]
"""Header and rows of a table."""

KINDS = ("causal", "final")
FIGURES = {"position RMSE [m]": ("position_rmse", 3), "heading RMSE [rad]": ("heading_rmse", 4), "ANEES": ("anees", 1)}
_STYLE = """body{font:15px/1.45 sans-serif;max-width:1100px;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse;margin:1em 0}td,th{padding:.2em .7em;border-bottom:1px solid #ddd;text-align:right}
th:first-child,td:last-child{text-align:left}tbody th{font-weight:normal}.wide{overflow-x:auto}img{max-width:100%}
.doubt{background:#fff4d6;padding:.5em 1em;margin:.4em 0}"""


def number(value: float | None, digits: int = 4) -> str:
    """A number for a table, a dash where there is none."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def constants_table(constants: Sequence[Learnt]) -> Rows:
    """Each constant before and after, and how well it is known."""
    header = ("constant", "input rig", "fitted", "standard error", "in the rig")
    rows: list[tuple[str, ...]] = [
        (_label(c), number(c.before), number(c.fitted), number(c.error), number(c.value) if c.kept else "as before")
        for c in constants
    ]
    return header, rows


def judgements_table(calibration: Calibration) -> Rows:
    """What the estimator says of each learnt parameter, on stretches that had no part in what was learnt: with it and without."""
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
    """The EKF on each log with the input rig, the new one, and one learnt from the other logs."""
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


def rfid_tables(calibration: Calibration) -> list[Rows]:
    """Survey and mounting, models of detection, and doubtful tags if there are any."""
    found = calibration.knowledge.rfid
    if found is None:
        return []
    tables = [rfid_report.offsets_table(found), rfid_report.models_table(found, accepted=calibration.accepts(MODEL))]
    return [*tables, rfid_report.tags_table(found)] if found.doubts else tables


def document(calibration: Calibration) -> dict[str, Any]:
    """Everything of the report as plain values."""
    noise, rfid = calibration.knowledge.noise, calibration.knowledge.rfid
    trial = calibration.consistency.trial if calibration.consistency else None
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
        "odometry_outliers": None if noise is None else noise.outliers,
        "odometry_widened": None if noise is None else noise.widened,
        "noise_factor": None if trial is None else trial.factor,
        "correlation": {
            log: {"next": c.next_one.tolist(), "time": c.time.tolist()}
            for log, c in zip(calibration.logs, calibration.knowledge.correlations, strict=False)
        },
        "rfid": None if rfid is None else rfid_report.rfid_document(rfid, accepted=calibration.accepts(MODEL)),
        "before": scores(calibration.before),
        "after": scores(calibration.after),
        "held_out": scores(calibration.held_out),
        "doubts": list(calibration.doubts),
        "rig": calibration.rig.model_dump(mode="json", exclude_none=True),
    }


def _parameters(names: Sequence[str]) -> str:
    """Names of one section, which is said once."""
    section = names[0].partition(".")[0]
    return f"{section}." + ", ".join(name.removeprefix(f"{section}.") for name in names)


def _figures(values: Array) -> dict[str, float]:
    names = (figure for figure, _ in FIGURES.values())
    return {f"{kind}.{name}": float(values[k, i]) for i, name in enumerate(names) for k, kind in enumerate(KINDS)}


def page(calibration: Calibration) -> str:
    """The report as one HTML page, with its plots inside."""
    knowledge = calibration.knowledge
    parts = [
        f"<h1>Calibration of {text(calibration.rig.name)}</h1>",
        f"<p>From {text(', '.join(calibration.logs))}. {text(_verdict(calibration))}</p>",
        *(f'<p class="doubt">{text(doubt)}</p>' for doubt in calibration.doubts),
        "<h2>Constants</h2>",
        "<p>A constant is kept if it predicts data better that it was not fitted to: "
        + ("the other logs" if len(calibration.logs) > 1 else "another fifth of the log")
        + f", and if the {_estimator(calibration)} is better with it. Else the rig keeps the value of the input. "
        + ("<i>Each log alone</i> says how much it differs between runs." if len(calibration.logs) > 1 else "")
        + "</p>",
        table(*_long_constants(calibration)),
        "<h2>Noise</h2>",
        *_noise(calibration),
        *_rfid(calibration),
        *_judgements(calibration),
        f"<h2>Accuracy of the {_estimator(calibration)}</h2>",
        "<p>ANEES is ideal at 3 (at 2 without the reference's heading); above it the estimator is too sure. "
        + (
            "The rows <i>from the other logs</i> are the honest ones: of that rig, only the factor on the noise has seen the log."
            if calibration.held_out
            else "With one log there is no cross-validation: try the rig on another log before you trust it."
        )
        + "</p>",
        table(*accuracy_table(calibration)),
    ]
    if knowledge.seen:
        parts += [
            "<h2>How alike neighbouring errors are</h2>",
            "<p>Estimators take errors as independent. Where the correlation is far above 0, many sightings say little more than "
            "one, and the noise in the rig must be larger than the scatter.</p>",
            table(*_correlations(calibration)),
            "<h2>Residuals of the sightings</h2>",
            image(figures.sightings_figure(knowledge)),
            image(figures.correlation_figure(knowledge)),
        ]
    if knowledge.windows:
        parts += ["<h2>Residuals of the odometry</h2>", image(figures.odometry_figure(knowledge))]
    title = f"Calibration of {text(calibration.rig.name)}"
    head = f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style></head>'
    return f"{head}<body>\n" + "\n".join(parts) + "\n</body></html>\n"


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


def _noise(calibration: Calibration) -> list[str]:
    noise = calibration.knowledge.noise
    trial = calibration.consistency.trial if calibration.consistency else None
    out = []
    if noise is not None:
        if not calibration.accepts(NOISE):
            out.append("<p>The noise of the odometry below is refused: the rig has that of the input.</p>")
        rows = [
            (error, *(number(v) for v in (g.per_distance, g.per_rotation, g.per_time)))
            for error, g in noise.growth.items()
        ]
        header = ("error of the odometry [m, m, rad]", "per sqrt(m)", "per sqrt(rad)", "per sqrt(s)")
        out.append(table(header, rows))
        out.append(
            f"<p>{100.0 * noise.outliers:.1f} % of the windows were outliers. The odometry's noise is {noise.widened:.2f} times "
            "that of windows up to 10 s, so that it holds for half a minute without landmarks.</p>"
        )
    scatter, rig = calibration.knowledge.rig.bearing_range, calibration.rig.bearing_range
    if not calibration.knowledge.seen or scatter is None or rig is None:
        return out
    if not calibration.accepts(SCATTER):
        out.append("<p>The noise of the sightings is refused: the rig has that of the input.</p>")
    names = {"range_sigma": "m", "range_sigma_relative": "m per m", "bearing_sigma": "rad"}
    rows = [(f"{n} [{unit}]", number(getattr(scatter, n)), number(getattr(rig, n))) for n, unit in names.items()]
    out.append(table(("noise of the sightings", "scatter", "in the rig"), rows))
    if trial is not None and calibration.accepts(SCATTER):
        out.append(
            f"<p>The scatter was multiplied by {trial.factor:.2f}: then the EKF's errors are as large as it says "
            f"(ANEES over its ideal value: {trial.causal:.2f} causal, {trial.final:.2f} final).</p>"
        )
    return out


def _rfid(calibration: Calibration) -> list[str]:
    found = calibration.knowledge.rfid
    if found is None:
        return []
    tables = [table(*one) for one in rfid_tables(calibration)]
    return [
        "<h2>RFID</h2>",
        f"<p>{text(rfid_report.tempering_text(found, calibration.rig))}</p>",
        f"<p>{text(rfid_report.dead_text(found))}</p>",
        *tables,
        "<p>How often tags were read, against the probability predicted by a model that was fitted to other logs or stretches.</p>",
        image(rfid_figures.reliability_figure(found)),
        "<p>The probability of a read around the antenna, which is the triangle: observed on the left, beside it the model.</p>",
        image(rfid_figures.field_figure(found)),
    ]


def _judgements(calibration: Calibration) -> list[str]:
    if not calibration.judgements:
        return []
    whose = "the other logs" if len(set(calibration.logs)) > 1 else "the other parts of the log"
    return [
        "<h2>What pays</h2>",
        f"<p>The {_estimator(calibration)} ran on stretches with what {whose} tell of each parameter (new), and without (old). The "
        "rig has what makes its score, which holds errors and consistency, better by more nats a pose than chance would, and no "
        "error larger by more than 2 %. What is refused has the value of the input rig.</p>",
        table(*judgements_table(calibration)),
    ]


def _estimator(calibration: Calibration) -> str:
    return "EKF" if calibration.knowledge.rfid is None else "smoother"


def _correlations(calibration: Calibration) -> Rows:
    header = ("log", "range: next sighting", "falls to 1/e in [s]", "bearing: next sighting", "falls to 1/e in [s]")
    rows: list[tuple[str, ...]] = [
        (log, number(c.next_one[0], 2), number(c.time[0], 1), number(c.next_one[1], 2), number(c.time[1], 1))
        for log, c in zip(calibration.logs, calibration.knowledge.correlations, strict=True)
    ]
    return header, rows


def _label(c: Learnt) -> str:
    unit = f" [{UNITS[c.name]}]" if c.name in UNITS else ""
    return f"{c.sensor}.{c.name}{unit}"
