"""The command line. A command parses its options, calls the library, and prints. The library never imports this."""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import click

from kpbench import __version__
from kpbench.errors import KpbenchError, KpbenchWarning, system_reason

# The module of a command is imported when the command is run: `kpbench --help` must not wait for OpenCV, HDF5 or torch.
# Each entry holds the module and function of a command, and the description of the command in `kpbench --help`.
COMMANDS = {
    "render-patches": ("print:render_patches", "Print the patches or a board, true to scale."),
    "analyze-patches": ("analyze:analyze_patches", "Measure how well designs can be located and told apart."),
    "synth": ("synth:synth", "Write a synthetic labelled dataset."),
    "merge": ("synth:merge", "Make one dataset from the shards of several runs."),
    "suite": ("suite:suite", "Write the images of a benchmark suite: paper-v1, extended-v2, ..."),
    "degrade": ("degrade:degrade", "Degrade images of your own: blur, noise, rain, ..."),
    "inspect": ("dataset:inspect", "Print what a dataset holds."),
    "verify": ("dataset:verify", "Compare every byte of a dataset with its manifest."),
    "preview": ("dataset:preview", "Draw a contact sheet with the true keypoints."),
    "diff": ("diff:diff", "Compare two datasets, or two versions of one."),
    "export": ("dataset:export", "Write a dataset as COCO, YOLO-pose, WebDataset or Parquet."),
    "detect": ("detect:detect", "Run a detector over a dataset or image files."),
    "track": ("track:track", "Follow a board through a film or a camera, and write its poses."),
    "calibrate": ("calibrate:calibrate", "Calibrate a camera from photographs of a board."),
    "print-check": ("print_check:print_check", "Measure a print in photographs, and correct its sidecar."),
    "label": ("label:label", "Make a labelled dataset from photographs of a board."),
    "score": ("score:score", "Score a predictions file with the paper's metrics."),
    "compare": ("compare:compare", "Compare detectors on the same images, pair by pair."),
    "plan": ("plan:plan", "Say how many scenes a measurement needs."),
    "bench": ("benchmark:bench", "Make suites, run and score detectors, compare with the paper."),
    "leaderboard": ("leaderboard:leaderboard", "Verify the scores of a submission by running its detectors again."),
    "train": ("train:train", "Train the detector, or its verifier; needs kpbench[train]."),
    "export-model": ("train:export_model", "Write trained weights as an ONNX file."),
    "ui": ("ui:ui", "Design, print and look, in a browser; needs kpbench[ui]."),
    "live": ("ui:live", "Watch a camera or a film in a browser; needs kpbench[ui]."),
    "demo": ("demo:demo", "Run the whole chain with few images, in about a minute."),
}


class LazyGroup(click.Group):
    """The group of all commands. Imports a command when the command is run. Turns errors into exit codes."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module, attribute = COMMANDS[cmd_name][0].split(":")
        command: click.Command = getattr(importlib.import_module(f"kpbench.cli.{module}"), attribute)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        try:
            return super().resolve_command(ctx, args)
        except click.NoSuchCommand as error:
            raise click.NoSuchCommand(error.command_name, possibilities=COMMANDS, ctx=ctx) from None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, line) for name, (_, line) in COMMANDS.items()])

    def invoke(self, ctx: click.Context) -> object:
        # imported here, because these modules would slow down `kpbench --help`
        from kpbench.cli.messages import clean_usage_error, echo
        from kpbench.cli.process import end_by_signals, exit_code
        from kpbench.files import protect_read_files

        try:
            with protect_read_files(), end_by_signals(), warnings.catch_warnings():
                warnings.simplefilter("default", KpbenchWarning)
                warnings.showwarning = partial(self._show_warning, ctx, warnings.showwarning)
                return super().invoke(ctx)
        except KpbenchError as error:
            echo(f"kpbench: {self._translate(ctx, error)}", err=True)
            sys.exit(1)
        except click.ClickException as error:
            raise clean_usage_error(error) from None
        except OSError as error:  # usually of standard output: an unwritable file raises KpbenchError
            if not isinstance(error, BrokenPipeError):  # the reader closed the pipe: no message needed
                place = f"{error.filename}: " if isinstance(error.filename, (str, Path)) else ""
                echo(f"kpbench: {place}{system_reason(error) or error}", err=True)
            # without a replacement, Python would write to the broken stdout at exit, and exit with code 120
            with contextlib.suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            sys.exit(1)
        except (KeyboardInterrupt, click.Abort) as stop:
            echo(f"kpbench: interrupted{f': {self._translate(ctx, stop)}' if str(stop) else ''}", err=True)
            sys.exit(exit_code())

    def _show_warning(self, ctx: click.Context, show: Callable[..., None], message: Warning, *more: Any) -> None:
        from kpbench.cli.messages import echo

        if isinstance(message, KpbenchWarning):
            echo(f"kpbench: {self._translate(ctx, message)}", err=True)
        else:
            show(message, *more)

    def _translate(self, ctx: click.Context, problem: BaseException) -> str:
        """Return the message of a problem, with parameters of the library named as options of the command."""
        from kpbench.cli.messages import name_options

        return name_options(str(problem), self.get_command(ctx, ctx.invoked_subcommand or ""))


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(__version__, prog_name="kpbench")
def main() -> None:
    """Keypoint patches: print them, synthesise labelled images, score any detector.

    \b
    Start here:
      kpbench demo
    """


def run() -> None:
    """Run the command line as a process of its own."""
    from kpbench.cli.process import open_standard_streams

    open_standard_streams()
    try:
        main(prog_name="kpbench")
    except OSError:  # of standard output, outside of the commands: for `kpbench --help >/dev/full`
        os._exit(1)
