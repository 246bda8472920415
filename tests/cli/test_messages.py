import re

import pytest
from click.testing import CliRunner
from helpers import command, kpbench

from kpbench import Detections, Predictions, write_predictions
from kpbench.cli import COMMANDS, main
from kpbench.cli.messages import OPTION_OF, name_options


@pytest.mark.parametrize(
    ("name", "message", "printed"),
    [
        ("synth", "`n` is 0", "--n is 0"),
        ("synth", "`size_px` is 3x3", "--size is 3x3"),
        ("synth", "`limits.radius_px` goes up to 9", "--radius-px goes up to 9"),
        ("synth", "add `resume=True` to finish it", "add --resume to finish it"),
        ("synth", "some transforms work with `channels=3` only", "some transforms work with --channels 3 only"),
        ("score", "as `matching='literal'` counts", "as --matching literal counts"),
        ("score", 'as `matching="literal"` counts', "as --matching literal counts"),
        ("merge", "name the `parts`", "name the PARTS"),
        ("score", "`kpbench suite` makes it", "`kpbench suite` makes it"),
        ("score", "`detection_score` is 0.3", "`detection_score` is 0.3"),
        ("merge", "`size_px` is no option here", "`size_px` is no option here"),
    ],
)
def test_parameters_become_options(name, message, printed):
    assert name_options(message, command(name)) == printed


def test_without_a_command_nothing_is_translated():
    assert name_options("`n` is 0", None) == "`n` is 0"


def test_every_renamed_option_exists():
    options = {option for name in COMMANDS for param in command(name).params for option in param.opts}
    assert set(OPTION_OF.values()) <= options


def write_none(path, n):
    """Write predictions of n images without detections."""
    write_predictions(path, Predictions.from_detections([Detections.none()] * n, detector={"name": "none"}))


@pytest.fixture
def workplace(here, dataset):
    """The current folder: predictions that lack an image, a folder with a shard and no manifest, an empty folder."""
    write_none("few.json", 5)
    write_none("all.json", 6)
    (here / "part").mkdir()
    (here / "part" / "shard-00000.h5").write_bytes((dataset.path / "shard-00000.h5").read_bytes())
    (here / "empty").mkdir()
    return here


@pytest.mark.parametrize(
    ("arguments", "printed"),
    [
        (["render-patches", "--png", "--page", "5000x5000mm", "--dpi", 4800], "--dpi"),
        (["render-patches", "--board", "hexagon", "--patch", 0, "--diameter-mm", 60], "--tile"),
        (["synth", "--n", 0], "--n is 0"),
        (["synth", "--n", 1, "--seed", 0, "--size", "3x3"], "--size is 3x3"),
        (["synth", "--n", 1, "--channels", 2], "--channels is 2"),
        (["synth", "--n", 1, "--radius-px", "80:5"], "--radius-px is 80:5"),
        (["synth", "--n", 1, "--radius-px", "5:4000"], "--radius-px goes up to 4000"),
        (["synth", "--n", 1, "--shard-size", 0], "--shard-size is 0"),
        (["synth", "--n", 1, "--shard-range", "0:7"], "--shard-range is 0:7"),
        (["synth", "--n", 1, "--out", "part"], "--resume"),
        (["synth", "--n", 1, "--out", "part"], "--overwrite"),
        (["synth", "--n", 1, "--out", "part"], "--out"),
        (["suite", "paper-v1", "--images", 0], "--images is 0"),
        (["suite", "paper-v1", "--size", "1x1"], "--size is 1x1"),
        (["bench", "--images", 0], "--images is 0"),
        (["score", "few.json", "--gt", "DATASET"], "--allow-missing"),
        (["score", "all.json"], "--gt"),
        (["score", "all.json", "--gt", "DATASET", "--pose"], "--pose"),
        (["compare", "few.json", "all.json", "--gt", "DATASET"], "--allow-missing"),
        (["export", "DATASET", "--format", "coco", "--out", "part"], "--out"),
    ],
)
def test_a_message_of_the_library_names_options_of_the_command(workplace, dataset, arguments, printed):
    arguments = [dataset.path if argument == "DATASET" else argument for argument in arguments]
    message = kpbench(*arguments, code=1).stderr
    assert printed in message
    about = command(arguments[0])
    options = {option for param in about.params for option in param.opts}
    assert {*re.findall(r"(?<![\w-])--[a-z][\w-]*", message)} <= options
    assert name_options(message, about) == message, "a parameter is left in backticks"


@pytest.mark.parametrize(
    ("arguments", "code", "close"),
    [
        (["detct"], 2, "detect"),
        (["detect", "--detctor", "x"], 2, "--detector"),
        (["demo", "--detector", "suprpoint"], 1, "superpoint"),
        (["suite", "paper-v"], 1, "paper-v1"),
        (["suite", "paper-v1", "--camera", "webcm"], 1, "webcam"),
        (["suite", "paper-v1", "--only", "blurr"], 1, "blur"),
        (["render-patches", "--board", "hexagn"], 1, "hexagon"),
        (["render-patches", "--board", "hexagon", "--patch", "trefol"], 1, "trefoil"),
        (["train", "--config", "referenc"], 1, "reference"),
        (["score", "x.json", "--min", "detction_score=1"], 2, "detection_score"),
    ],
)
def test_a_mistyped_name_is_answered_with_the_closest(here, arguments, code, close):
    assert f"id you mean '{close}'?" in kpbench(*arguments, code=code).stderr


@pytest.mark.parametrize(
    ("shell", "begins"), [("bash", "_kpbench_completion"), ("zsh", "#compdef kpbench"), ("fish", "function _kpbench")]
)
def test_each_shell_gets_a_script_that_completes(shell, begins):
    script = CliRunner().invoke(main, env={"_KPBENCH_COMPLETE": f"{shell}_source"}, prog_name="kpbench").output
    assert script.lstrip().startswith(begins)
    asked = {
        "_KPBENCH_COMPLETE": f"{shell}_complete",
        "COMP_WORDS": "kpbench det",
        "COMP_CWORD": "det" if shell == "fish" else "1",
    }
    assert "detect" in CliRunner().invoke(main, env=asked, prog_name="kpbench").output
