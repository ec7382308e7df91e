"""What a user can get wrong ends in one line that names it, exit code 2, and no traceback."""

import pytest

from factorgraph_loc.cli.options import parse_settings
from factorgraph_loc.errors import FglocError, InputError
from factorgraph_loc.model.scoring import parse_seeds


@pytest.mark.parametrize(
    ("args", "fragments"),
    [
        (["-e", "efk"], ["'efk'", "did you mean ekf?"]),
        (["-e", "ekf", "--set", "ekf.max_dely=1"], ["max_dely", "did you mean max_delay?"]),
        (["-e", "ekf", "--set", "ekf.max_delay=soon"], ["max_delay", "'soon'", "number"]),
        (["-e", "ekf", "--set", "smother.lag=1"], ["'smother'", "did you mean smoother?"]),
        (["-e", "ekf", "--set", "smoother.lag=1"], ["smoother.lag=1", "smoother is not run here"]),
        (["-e", "ekf", "--set", "lag=1"], ["lag=1", "NAME.key=value"]),
        (["-e", "ekf", "--set", "ekf.max_delay"], ["--set", "KEY=VALUE"]),
        (["-e", "ekf", "--prior", "1"], ["'1'", "X,Y or X,Y,HEADING"]),
        (["-e", "dead_reckoning", "--prior", "1,2"], ["dead_reckoning cannot find an unknown heading", "X,Y,HEADING"]),
        (["-e", "ekf", "--sensors", "odometri"], ["odometri", "odometry"]),
        (["-e", "ekf", "--rig", "nowhere.rig.toml"], ["nowhere.rig.toml"]),
        (["-e", "ekf", "--world", "nowhere.world.toml"], ["nowhere.world.toml"]),
        (["-e", "ekf", "--reader", "mrclam", "--reader-option", "robt=1"], ["robt", "did you mean robot?"]),
    ],
)
def test_options_of_run(refused, short_log, tmp_path, args, fragments):
    said = refused("run", short_log, "-o", tmp_path / "out", *args)
    assert all(fragment in said for fragment in fragments)
    assert not (tmp_path / "out").exists()


def test_a_log_that_does_not_exist(refused):
    said = refused("info", "plaza3")
    assert "plaza3" in said
    assert "plaza2" in said


def test_typers_own_usage_errors_have_exit_code_2(fgloc, short_log):
    assert fgloc("run", short_log).exit_code == 2
    assert "Did you mean" in fgloc("inof").stderr
    assert fgloc("run", short_log, "-e", "ekf", "-o", "x", "--seed", "many").exit_code == 2


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
