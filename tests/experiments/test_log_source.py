"""Which files a log of an experiment is made from: what is kept of a run must not outlive a change in one of them."""

import pytest
from mapped_hall import HEAD, VELOCITIES

from factorgraph_loc.experiments.log_source import RecordedSource

MANIFEST = f'world = "hall.world.toml"\n{HEAD}{VELOCITIES}'


@pytest.fixture
def manifest(tmp_path, monkeypatch):
    """One's own manifest with its log and its map beside it, without a data root."""
    monkeypatch.delenv("FGLOC_DATA", raising=False)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "wheels.csv").write_text("t,v,w\n0,1,0\n1,1,0\n")
    (tmp_path / "hall.world.toml").write_text('walls = "hall.yaml"\n[tags]\nfile = "tags.csv"\n')
    (tmp_path / "hall.yaml").write_text("image: hall.pgm\n")
    (tmp_path / "hall.pgm").write_bytes(b"P5\n1 1\n255\n0")
    (tmp_path / "tags.csv").write_text("epc,x,y\n")
    (tmp_path / "hall.toml").write_text(MANIFEST)
    return tmp_path / "hall.toml"


def test_a_manifest_beside_its_log_has_all_files_behind_it(manifest):
    files = RecordedSource(str(manifest)).files()
    assert set(files) == {"hall.toml", "hall.world.toml", "hall.yaml", "hall.pgm", "tags.csv", "run/wheels.csv"}
    assert all(path.is_file() for path in files.values())


def test_a_log_below_the_data_root(manifest, tmp_path):
    root = tmp_path / "data"
    (root / "elsewhere").mkdir(parents=True)
    (root / "elsewhere" / "wheels.csv").write_text("")
    manifest.write_text(MANIFEST.replace('"run"', '"elsewhere"'))
    files = RecordedSource(str(manifest), data_root=str(root)).files()
    assert "elsewhere/wheels.csv" in files
    assert "run/wheels.csv" not in files


def test_a_rig_below_the_data_root_counts(manifest, tmp_path_factory):
    root = tmp_path_factory.mktemp("data")
    (root / "cart.rig.toml").write_text("")
    manifest.write_text(f'rig = "{root}/cart.rig.toml"\n{MANIFEST}')
    files = RecordedSource(str(manifest), data_root=str(root)).files()
    assert files["rig/cart.rig.toml"].is_file()
    given = RecordedSource(str(manifest), rig=str(root / "cart.rig.toml"))  # in place of that of the manifest
    assert set(given.files()) == set(files)


def test_a_file_that_is_named_outside_of_the_folder_is_not_read(manifest):
    other = manifest.parent / "below"
    other.mkdir()
    moved = manifest.rename(other / "hall.toml")
    moved.write_text(MANIFEST.replace('path = "run"', 'path = "run"\nrig = "own.rig.toml"'))
    (other / "run").mkdir()
    (other / "own.rig.toml").write_text('name = "../tags.csv"\n')
    (other / "hall.world.toml").write_text("")
    assert set(RecordedSource(str(moved)).files()) == {"hall.toml", "own.rig.toml", "hall.world.toml"}
