"""What a user can get wrong ends in one line that names it, exit code 2, and no traceback."""

import shutil

import pytest

from factorgraph_loc.cli.options import parse_settings
from factorgraph_loc.errors import FglocError, InputError
from factorgraph_loc.experiments.seeds import parse_seeds


def assert_refused(result, *fragments):
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert "Traceback" not in result.stderr
    (line,) = result.stderr.splitlines()
    for fragment in ("error: ", *fragments):
        assert str(fragment) in line


@pytest.mark.parametrize(
    ("args", "fragments"),
    [
        (["-e", "efk"], ["'efk'", "did you mean ekf?"]),
        (["-e", "ekf", "--set", "ekf.max_dely=1"], ["max_dely", "did you mean max_delay?"]),
        (["-e", "ekf", "--set", "ekf.max_delay=soon"], ["max_delay", "'soon'", "number"]),
        (["-e", "ekf", "--set", "ekf.max_delay=-1"], ["max_delay", "-1"]),
        (["-e", "ekf", "--set", "smother.lag=1"], ["'smother'", "did you mean smoother?"]),
        (["-e", "ekf", "--set", "smoother.lag=1"], ["smoother.lag=1", "smoother is not run here"]),
        (["-e", "ekf", "--set", "lag=1"], ["lag=1", "NAME.key=value"]),
        (["-e", "ekf", "--set", "ekf.max_delay"], ["--set", "KEY=VALUE"]),
        (["-e", "ekf", "--prior", "1"], ["'1'", "X,Y or X,Y,HEADING"]),
        (["-e", "dead_reckoning", "--prior", "1,2"], ["dead_reckoning cannot find an unknown heading", "X,Y,HEADING"]),
        (["-e", "ekf", "--prior", "nan,0,0"], ["nan"]),
        (["-e", "ekf", "--prior", "unknown"], ["unknown"]),
        (["-e", "ekf", "--sensors", "odometri"], ["odometri", "odometry"]),
        (["-e", "ekf", "--rig", "nowhere.rig.toml"], ["nowhere.rig.toml"]),
        (["-e", "ekf", "--world", "nowhere.world.toml"], ["nowhere.world.toml"]),
        (["-e", "ekf", "--reader", "nativ"], ["'nativ'", "did you mean native?"]),
        (["-e", "ekf", "--reader", "mrclam", "--reader-option", "robt=1"], ["robt", "did you mean robot?"]),
    ],
)
def test_options_of_run(fgloc, short_log, tmp_path, args, fragments):
    assert_refused(fgloc("run", short_log, "-o", tmp_path / "out", *args), *fragments)
    assert not (tmp_path / "out").exists()


def test_a_log_that_does_not_exist(fgloc):
    assert_refused(fgloc("info", "plaza3"), "plaza3", "plaza2")


def test_compare_checks_names_and_seeds_before_it_runs(fgloc, short_log, tmp_path):
    out = tmp_path / "out"
    assert_refused(fgloc("compare", short_log, "-e", "ekf,smother", "-o", out), "'smother'", "did you mean smoother?")
    assert_refused(fgloc("compare", short_log, "-e", "ekf", "-o", out, "--seeds", "5:5"), "--seeds", "'5:5'")
    for option, text, named in (
        ("--prior", "1", "'1'"),
        ("--sensors", "odometri", "did you mean odometry?"),
        ("--set", "ekf.max_dely=1", "did you mean max_delay?"),
    ):
        assert_refused(fgloc("compare", short_log, "-e", "ekf", "-o", out, option, text), named)
    assert not out.exists()


def test_typers_own_usage_errors_have_exit_code_2(fgloc, short_log):
    assert fgloc("run", short_log).exit_code == 2
    assert "Did you mean" in fgloc("inof").stderr
    assert fgloc("run", short_log, "-e", "ekf", "-o", "x", "--seed", "many").exit_code == 2


def replace_row(path, row, text):
    lines = path.read_text().splitlines()
    lines[row] = text
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(
    ("spoil", "fragments"),
    [
        (lambda f: replace_row(f / "odometry.csv", 5, "nan,nan,nan,nan"), ["odometry.csv:6"]),
        (lambda f: replace_row(f / "odometry.csv", 5, "1"), ["odometry.csv:6"]),
        (lambda f: replace_row(f / "odometry.csv", 0, "a,b,c,d"), ["odometry.csv"]),
        (lambda f: (f / "odometry.csv").write_text(""), ["odometry.csv"]),
        (lambda f: replace_row(f / "reference.tum", 3, "1 2 3"), ["reference.tum", "8 values"]),
        (lambda f: (f / "run.toml").write_text("name = "), ["run.toml", "not TOML"]),
        (lambda f: (f / "run.toml").unlink(), [""]),
    ],
)
def test_files_of_a_log(fgloc, short_log, tmp_path, spoil, fragments):
    folder = tmp_path / "log"
    shutil.copytree(short_log, folder)
    spoil(folder)
    assert_refused(fgloc("info", folder), *fragments)


def test_a_rig_in_degrees_and_a_misspelt_key(fgloc, short_log, tmp_path):
    rig = tmp_path / "robot.rig.toml"
    rig.write_text("[bearing_range]\nrange_sigma = 0.1\nbearing_sigma = 5.0\n")
    assert_refused(fgloc("info", short_log, "--rig", rig), "robot.rig.toml", "bearing_range.bearing_sigma", "5.0")
    rig.write_text("[odometri]\n")
    assert_refused(fgloc("info", short_log, "--rig", rig), "robot.rig.toml", "odometri", "did you mean odometry?")


def test_a_manifest_that_leaves_its_root(fgloc, tmp_path):
    manifest = tmp_path / "bad.toml"
    manifest.write_text('title = "x"\nreader = "native"\npath = "../../etc"\nlicence = "none"\norigin = "none"\n')
    assert_refused(fgloc("info", manifest, "--data-root", tmp_path), "../../etc")


def test_debug_shows_the_error_itself(fgloc):
    assert isinstance(fgloc("info", "plaza3", "--debug").exception, FglocError)
    assert isinstance(fgloc("--debug", "info", "plaza3").exception, FglocError)


def test_texts_of_options():
    assert parse_seeds("0:10") == range(10)
    assert list(parse_seeds("7")) == [7]
    for text in ("", "a", "3:1", "-2", "1:2:3"):
        with pytest.raises(InputError, match="--seeds"):
            parse_seeds(text)
    texts = ["smoother.lag=10", "smoother.loss=cauchy", "ekf.smooth=false", "smoother.gate.scale=1e-3"]
    assert parse_settings(texts, ["smoother", "ekf"]) == {
        "smoother": {"lag": 10, "loss": "cauchy", "gate": {"scale": 1e-3}},
        "ekf": {"smooth": False},
    }
    with pytest.raises(InputError, match=r"no key smoother.lag.x, as smoother.lag is 10"):
        parse_settings(["smoother.lag=10", "smoother.lag.x=1"], ["smoother"])
