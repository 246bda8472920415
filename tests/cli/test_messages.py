import pytest
from helpers import command

from kpbench.cli import COMMANDS
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
