import re

import click
import pytest
from helpers import command, kpbench

from kpbench.cli import COMMANDS


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_a_command_shows_examples(name):
    text = kpbench(name, "--help").stdout
    examples = re.search(r"^  Examples:\n((?:    .*\n)+)", text, re.MULTILINE)
    assert examples, "no paragraph of examples that keeps its lines"
    assert f"kpbench {name}" in examples[1]


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_of_a_command_is_explained(name):
    options = [param for param in command(name).params if isinstance(param, click.Option)]
    assert not [option.opts for option in options if not option.help or option.help[-1] not in ".)"]


@pytest.mark.parametrize("name", COMMANDS)
def test_a_default_is_shown(name):
    """By click, or in the help where the default is not a value: such as a folder named after an argument."""
    for option in command(name).params:
        if isinstance(option, click.Option) and not option.is_flag:
            default = option.to_info_dict()["default"]
            assert default in (None, (), "") or option.show_default or "Default: " in option.help, option.opts


def test_the_list_of_commands_tells_what_each_does():
    text = " ".join(kpbench("--help").stdout.split())
    for name, (_, line) in COMMANDS.items():
        assert f"{name} {line}" in text
