"""What a user may name, and the data sets that ship."""

import hashlib
import shutil
from pathlib import Path

import pytest

from factorgraph_loc import InputError, load, read_rig
from factorgraph_loc.files import shipped
from factorgraph_loc.files.models import parse_model
from factorgraph_loc.files.shipped import manifests, readers, rigs
from factorgraph_loc.io.readers import describe, read_manifest, reader, verify

MANIFEST = 'title = "t"\nreader = "mrclam"\npath = "set"\nlicence = "none"\norigin = "here"\n'


@pytest.fixture
def manifest(mrclam):
    """Writes a manifest for the small MRCLAM folder, with more lines."""
    folder = mrclam.parent / "manifests"
    folder.mkdir()

    def write(more: str = "[options]\nrobot = 1\n", text: str = MANIFEST) -> Path:
        (folder / "small.toml").write_text(text + more)
        return folder / "small.toml"

    return write


@pytest.mark.parametrize("name", manifests())
def test_shipped_manifests_are_right(name):
    """Reader, options and rig are known, whether the data is there or not; without a rig the reader has its own."""
    manifest = read_manifest(manifests()[name])
    parse_model(reader(manifest.reader).Options, manifest.options, name)
    rig = read_rig(manifests()[name].parent / manifest.rig)
    assert all(getattr(rig, sensor) is not None for sensor in rig.sensors if sensor not in {"rssi", "phase"})
    assert all(file.startswith(manifest.path) for file in manifest.checksums)


def test_describe_and_verify_with_data(data_root):
    assert all(d.present for d in describe(data_root))
    for file in manifests().values():
        assert verify(read_manifest(file), data_root) == []


def test_a_manifest(manifest, tmp_path):
    file = manifest(
        'rig = "cart.rig.toml"\n[options]\nrobot = 1\n'
        "[start]\nx = 1\ny = 2\nheading = 0\nsigma_position = 0.1\nsigma_heading = 0.1\n"
    )
    (file.parent / "cart.rig.toml").write_text('name = "cart"\n')
    (log,) = load(str(file), data_root=tmp_path)
    assert (log.name, log.rig.name, log.metadata["licence"]) == ("small", "cart", "none")
    assert (log.start.t, log.start.pose.tolist()) == (0.0, [1.0, 2.0, 0.0])


def test_the_data_root_from_the_environment(manifest, tmp_path, monkeypatch, refused):
    monkeypatch.setenv("FGLOC_DATA", str(tmp_path))
    assert load(str(manifest()))[0].name == "small"
    monkeypatch.delenv("FGLOC_DATA")
    refused(manifest(), "--data-root", "FGLOC_DATA")
    refused(manifest(), "does not exist", data_root=tmp_path / "nowhere")


def test_a_list_makes_several_logs(manifest, mrclam, tmp_path):
    for name in ("Odometry", "Measurement", "Groundtruth"):
        (mrclam / f"Robot3_{name}.dat").write_text((mrclam / f"Robot1_{name}.dat").read_text())
    file = manifest("[options]\nrobot = [1, 3]\n")
    names = [log.name for log in load(str(file), data_root=str(tmp_path))]
    assert names == ["small-robot1", "small-robot3"]
    # text with commas is the command line's list
    names = [log.name for log in load(str(mrclam), reader="mrclam", options={"robot": "1, 3"})]
    assert names == ["set-robot1", "set-robot3"]


def test_rig_and_world_replace_those_of_the_log(native, tmp_path):
    (tmp_path / "o.rig.toml").write_text('name = "other"\n')
    (tmp_path / "o.world.toml").write_text('name = "other"\n[landmarks.A]\nx = 0\ny = 0\n')
    (log,) = load(str(native), rig=tmp_path / "o.rig.toml", world=tmp_path / "o.world.toml")
    assert (log.rig.name, log.world.name) == ("other", "other")
    # checked against the map that is used
    (warning,) = log.warnings
    assert str(warning) == "bearing_range: 1 rows name landmarks that the map lacks: B"


BAD_MANIFESTS = {
    "path outside": (MANIFEST.replace('"set"', '"../../etc"'), "", "path '../../etc' leaves its folder"),
    "rig outside": (
        MANIFEST,
        'rig = "../../x.rig.toml"\n',
        "leaves its folder",
        "or below the data folder (--data-root, FGLOC_DATA); or `--rig FILE` in its place",
    ),
    "no data": (MANIFEST.replace('"set"', '"sat"'), "", "small.toml: its data", "does not exist"),
    "no title": (MANIFEST.replace("title", "titel"), "", "unknown key titel", "did you mean title?"),
    "no reader": (MANIFEST.replace('"mrclam"', '"mrclan"'), "", "no reader 'mrclan'", "did you mean mrclam?"),
    "option misspelt": (MANIFEST, "[options]\nrobt = 1\n", "unknown key robt", "did you mean robot?"),
    "empty list": (MANIFEST, "[options]\nrobot = []\n", "option robot is an empty list"),
}


@pytest.mark.parametrize(
    ("text", "more", "fragments"), [(t, m, f) for t, m, *f in BAD_MANIFESTS.values()], ids=list(BAD_MANIFESTS)
)
def test_bad_manifests(manifest, tmp_path, refused, text, more, fragments):
    refused(manifest(more, text), *fragments, data_root=tmp_path)


@pytest.fixture
def away(tmp_path):
    """A folder with a rig and a map, which is no folder of a manifest."""
    folder = tmp_path / "away"
    folder.mkdir()
    (folder / "cart.rig.toml").write_text('name = "away"\n')
    (folder / "hall.world.toml").write_text('name = "away"\n')
    return folder


@pytest.mark.parametrize("start", ["{away}", "../away"])
def test_a_manifest_leads_to_its_own_folder_or_below_the_data_folder(
    manifest, mrclam, away, one, refused, start, tmp_path
):
    start = start.format(away=away)
    rest = f'rig = "{start}/cart.rig.toml"\nworld = "{start}/hall.world.toml"\n[options]\nrobot = 1\n'
    file = manifest(rest, MANIFEST.replace('"set"', f'"{mrclam}"'))
    log = one(file, data_root=tmp_path)
    assert (log.rig.name, log.world.name) == ("away", "away")
    refused(file, "small.toml: path '", "below it, or below the data folder", data_root=away)
    shutil.copytree(mrclam, file.parent / "set")
    file = manifest(rest)
    refused(file, "small.toml: path '", "; or `--rig FILE` in its place")
    given = {"rig": away / "cart.rig.toml"}
    refused(file, "small.toml: path '", "; or `--world FILE` in its place", **given)
    assert one(file, **given, world=away / "hall.world.toml").rig.name == "away"
    refused(file.rename(file.with_name("run.toml")), "run.toml: path '", "; or `--rig FILE` in its place")


def test_a_link_that_leaves_the_data_root(manifest, mrclam, tmp_path, refused):
    root = tmp_path / "root"
    root.mkdir()
    (root / "set").symlink_to(mrclam)
    refused(manifest(), "leaves its folder", data_root=root)


def test_verify(manifest, mrclam, tmp_path):
    right = hashlib.sha256((mrclam / "Barcodes.dat").read_bytes()).hexdigest()
    lines = {"Barcodes.dat": right, "Robot1_Odometry.dat": "0" * 64, "Robot9_Odometry.dat": right}
    found = read_manifest(manifest("[checksums]\n" + "".join(f'"set/{n}" = "{s}"\n' for n, s in lines.items())))
    changed, missing = verify(found, tmp_path)
    assert "Robot1_Odometry.dat: is not the file" in changed
    assert "Robot9_Odometry.dat: is missing" in missing
    with pytest.raises(InputError, match="does not exist"):
        verify(found, tmp_path / "nowhere")


def test_the_data_sets_of_an_installed_package_lie_in_it(tmp_path, monkeypatch):
    (tmp_path / "datasets").mkdir()
    for name in ("hall.toml", "hall.rig.toml", "hall.reader.toml"):
        (tmp_path / "datasets" / name).touch()
    monkeypatch.setattr(shipped.resources, "files", lambda _: tmp_path)
    for files, name in ((manifests(), "hall.toml"), (rigs(), "hall.rig.toml"), (readers(), "hall.reader.toml")):
        assert files == {"hall": tmp_path / "datasets" / name}


def test_files_that_are_no_logs(tmp_path, refused):
    poses = tmp_path / "a.tum"
    poses.write_text("1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    refused(poses, "a.tum: is a file of poses, expected a log", "fgloc score")
    (tmp_path / "a.csv").write_text("t,x,y,z,qx,qy,qz,qw\n1,0,0,0,0,0,0,1\n")
    refused(tmp_path / "a.csv", "is a table: describe its columns in a manifest")
    (tmp_path / "a.txt").write_text("hello\n")
    refused(tmp_path / "a.txt", "is not a manifest (.toml): name the reader of its format")
