"""The key of a stored run depends on the source files that a run imports, and on no others."""

import shutil

import pytest
from package_tables import MODULES, ROOT, imported

from factorgraph_loc.experiments import keys
from factorgraph_loc.files.shipped import readers

RUN = {
    "factorgraph_loc.builtin",  # the registries
    *(f"factorgraph_loc.experiments.{name}" for name in ("log_source", "output", "run")),
}
# reached by registries and constants, but unused by a run: the calibration of sensors, exports, the store
UNUSED = ("calibrator", "exports.trajectories", "experiments.store")


@pytest.fixture(scope="module")
def used():
    """The files that a run imports, also within functions, relative to the folder of the packages."""
    found, waiting = set(), list(RUN)
    while waiting:
        module = waiting.pop()
        if module not in found and not module.endswith(UNUSED):
            found.add(module)
            waiting += imported(module)
    return {MODULES[module].relative_to(ROOT) for module in found}


@pytest.fixture
def copied(tmp_path):
    """A folder with a copy of the packages."""
    for package in ("factorgraph_loc", "factors"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path


def test_a_key_depends_on_what_a_run_imports_and_on_nothing_else(copied):
    before = keys.digest_of_code(copied)
    assert before == keys.code_version()

    def counts(file):
        content = (copied / file).read_bytes()
        (copied / file).write_bytes(content + b"# changed\n")
        changed = keys.digest_of_code(copied) != before
        (copied / file).write_bytes(content)
        return changed

    for name in (
        "factors/rfid/model.py",
        "factors/se2.py",
        "factorgraph_loc/fusion/ekf.py",
        "factorgraph_loc/evaluation/metrics.py",
        "factorgraph_loc/sensors/motion.py",
        "factorgraph_loc/vision/weights.npz",
    ):
        assert counts(name), name
    for name in (
        "factorgraph_loc/api/running.py",
        "factorgraph_loc/drawing/figures.py",
        "factorgraph_loc/evaluation/plots.py",
        "factorgraph_loc/evaluation/report/page.py",
        "factorgraph_loc/drawing/templates/page.css",
        "factorgraph_loc/experiments/reporting.py",
        "factorgraph_loc/sensors/rfid/calibration/learn.py",
    ):
        assert not counts(name), name


def test_the_parts_that_count_are_those_that_a_run_imports(used):
    counted = {
        file.relative_to(ROOT)
        for file in MODULES.values()
        if file.is_relative_to(ROOT / "factors")
        or keys.is_counted(file.relative_to(ROOT / "factorgraph_loc").as_posix())
    }
    assert used - counted == set()
    for part in keys.COUNTED:
        assert any(file.as_posix().startswith(f"factorgraph_loc/{part}") for file in used), part


def test_a_key_depends_on_the_tables_that_readers_are_described_by(copied, tmp_path, monkeypatch):
    before = keys.digest_of_code(copied)
    changed = tmp_path / "mrclam.reader.toml"
    changed.write_text(readers()["mrclam"].read_text() + "# changed\n")
    monkeypatch.setattr(keys, "readers", lambda: {"mrclam": changed})
    assert keys.digest_of_code(copied) != before
