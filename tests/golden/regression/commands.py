"""What ``scripts/golden`` does: hold results anew, or hold those of two commits against each other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from recorded_logs import present_logs

from regression.differences import Difference
from regression.records import DIGITS, Record, read_records, write_records
from regression.scenarios import SCENARIOS, ActiveScenario, Scenario
from regression.tolerances import SAME, beyond, beyond_processors

RESULTS = Path(__file__).parents[1] / "results"
SHOWN = 4  # differences of one case
Scenarios = Mapping[str, Scenario | ActiveScenario]


def renew(names: Iterable[str]) -> list[str]:
    """Write the stored results anew, of these scenarios or of all, and return what changed, a line a case.

    What differs by no more than processors do stays as it is stored, and so do results of recorded logs that are not here.
    """
    chosen = _chosen(SCENARIOS, names)
    lines = []
    if chosen.keys() == SCENARIOS.keys():
        for path in sorted(RESULTS.glob("*.json")):
            if path.stem not in SCENARIOS:
                path.unlink()
                lines.append(f"{path.stem}: removed")
    for name, scenario in _present(chosen).items():
        path = RESULTS / f"{name}.json"
        stored = read_records(path) if path.exists() else {}
        kept, changed = {}, []
        for label in scenario.cases():
            new = scenario.record(label)
            kept[label] = new
            if label not in stored:
                changed.append(f"{name}/{label}: new")
            elif found := beyond_processors(f"{name}/{label}", stored[label], new):
                changed.append(described(f"{name}/{label}", found, stored[label], new))
            else:
                kept[label] = stored[label]
        changed += [f"{name}/{label}: removed" for label in stored if label not in kept]
        if changed:
            write_records(path, kept, DIGITS)
        lines += changed
    return lines


def write(folder: Path, names: Iterable[str], *, extra: Scenarios) -> None:
    """Run the scenarios and write their results with all digits."""
    for name, scenario in _present(_chosen({**SCENARIOS, **extra}, names)).items():
        write_records(folder / f"{name}.json", {label: scenario.record(label) for label in scenario.cases()})


def compare(folder: Path, names: Iterable[str], *, extra: Scenarios, tolerance: float = SAME) -> list[str]:
    """Run the scenarios and return what is not as :func:`write` left it in a folder, a line a case."""
    lines = []
    for name, scenario in _present(_chosen({**SCENARIOS, **extra}, names)).items():
        path = folder / f"{name}.json"
        stored = read_records(path) if path.exists() else {}
        for label in scenario.cases():
            new = scenario.record(label)
            if label not in stored:
                lines.append(f"{name}/{label}: is not in {folder}")
            elif found := beyond(stored[label], new, tolerance):
                lines.append(described(f"{name}/{label}", found, stored[label], new))
        lines += [f"{name}/{label}: only in {folder}" for label in stored if label not in scenario.cases()]
    return lines


def described(case: str, found: list[Difference], old: Record, new: Record) -> str:
    """One case: the largest differences, and its RMSE before and after."""
    parts = [str(difference) for difference in found[:SHOWN]]
    if len(found) > SHOWN:
        parts.append(f"{len(found) - SHOWN} more")
    parts += [
        f"{figure} {old.rmse[figure]:.4g} -> {new.rmse[figure]:.4g} m" for figure in old.rmse if figure in new.rmse
    ]
    return f"{case}: " + "; ".join(parts)


def is_present(scenario: Scenario | ActiveScenario) -> bool:
    """Whether the recorded log of a scenario is here."""
    return scenario.data is None or scenario.data in present_logs()


def _present(scenarios: Scenarios) -> Scenarios:
    return {name: scenario for name, scenario in scenarios.items() if is_present(scenario)}


def _chosen(scenarios: Scenarios, names: Iterable[str]) -> Scenarios:
    wanted = list(names)
    if unknown := [name for name in wanted if name not in scenarios]:
        raise SystemExit(f"there is no scenario {unknown[0]}; there are {', '.join(scenarios)}")
    return {name: scenario for name, scenario in scenarios.items() if not wanted or name in wanted}
