"""``scripts/baseline compare`` sees an estimator that became worse."""

import json

import pytest
from scripts_here import run_script

SCORES = {"family": "recorded", "estimator": "ekf", "processor_seconds": 1.0, "found_after": 2.0, "wrong": 0.0}
ERRORS = [f"{kind}.{of}_rmse" for kind in ("causal", "final") for of in ("position", "heading")]
ALIGNED = ["final.aligned_position_rmse", "final.aligned_rotation_rmse"]


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({}, 0),
        ({"final.position_rmse": 0.1005}, 0),
        ({"final.position_rmse": 0.12}, 1),
        ({"causal.anees": 3.2}, 1),
        ({"wrong": 1.0}, 1),
        ({"found_after": None}, 1),
    ],
)
def test_limits_are_held(tmp_path, capsys, changes, code):
    old = SCORES | dict.fromkeys([*ERRORS, *ALIGNED, "landmarks.rmse"], 0.1) | {"causal.anees": 3.0, "final.anees": 3.0}
    for folder, scores in (("old", old), ("new", old | changes)):
        (tmp_path / folder / "runs").mkdir(parents=True)
        (tmp_path / folder / "runs" / "plaza2+rig+known+ekf.json").write_text(json.dumps(scores))
    assert run_script("baseline", "compare", tmp_path / "old", tmp_path / "new") == code
    assert all(name in capsys.readouterr().out for name in changes)
