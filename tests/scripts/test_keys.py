"""The key of a stored run depends on the source files of the project."""

import shutil

import pytest
from package_tables import ROOT

from factorgraph_loc.experiments import keys
from factorgraph_loc.files.shipped import readers


@pytest.fixture
def copied(tmp_path):
    """A folder with a copy of the packages."""
    for package in ("factorgraph_loc", "factors"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path


def test_a_key_depends_on_the_source_and_the_weights_of_both_packages(copied):
    before = keys.digest_of_code(copied)
    assert before == keys.code_version()

    def counts(file):
        content = (copied / file).read_bytes()
        (copied / file).write_bytes(content + b"# changed\n")
        changed = keys.digest_of_code(copied) != before
        (copied / file).write_bytes(content)
        return changed

    for name in ("factors/se2.py", "factorgraph_loc/fusion/ekf.py", "factorgraph_loc/vision/weights.npz"):
        assert counts(name), name
    assert not counts("factorgraph_loc/drawing/templates/page.css")


def test_a_key_depends_on_the_tables_that_readers_are_described_by(copied, tmp_path, monkeypatch):
    before = keys.digest_of_code(copied)
    changed = tmp_path / "mrclam.reader.toml"
    changed.write_text(readers()["mrclam"].read_text() + "# changed\n")
    monkeypatch.setattr(keys, "readers", lambda: {"mrclam": changed})
    assert keys.digest_of_code(copied) != before
