"""Warnings in the rows of runs, and each told once."""

from factorgraph_loc.evaluation.warned import lines, row_of


def row(log, estimator, *warnings, seed=0):
    return {"log": log, "estimator": estimator, "seed": seed} | row_of({"causal.scored": 3, "warnings": list(warnings)})


def test_lists_are_no_cells_but_warnings_are_a_text():
    assert row_of({"a": 1.0, "nees_bounds": [1.0, 2.0], "warnings": ["one", "two"]}) == {
        "a": 1.0,
        "warnings": "one\ntwo",
    }
    assert row_of({"a": 1.0, "warnings": []})["warnings"] is None
    assert row_of({"a": 1.0})["warnings"] is None  # of a run that failed


def test_each_is_told_once_and_of_whom_where_not_of_all():
    rows = [
        row("one", "ekf", "one: no map"),
        row("one", "smoother", "one: no map", "one: never localized", seed=0),
        row("one", "smoother", "one: no map", "one: never localized", seed=1),
        row("two", "ekf"),
        {"log": "two", "estimator": "smoother", "label": "short"},  # of a table without warnings
    ]
    assert lines(rows) == ["one: no map", "one: never localized (smoother)"]
