"""The command line: parse, call one function of the library, print. Nothing imports it."""

from __future__ import annotations

import contextlib
import importlib
import os
import sys

import click

from kpbench import __version__
from kpbench.cli.messages import name_options
from kpbench.errors import KpbenchError

# Each command lives in a module that is imported only when the command is used: `kpbench --help`
# must not wait for OpenCV, HDF5 or torch. The second entry is its line in the list of commands.
COMMANDS = {
    "render-patches": ("print:render_patches", "Print the patches or a board, true to scale."),
    "analyze-patches": ("analyze:analyze_patches", "Measure how well designs can be located and told apart."),
    "synth": ("synth:synth", "Write a synthetic labelled dataset."),
    "merge": ("synth:merge", "Make one dataset of shards that several runs made."),
    "suite": ("suite:suite", "Write the images of a benchmark suite: paper-v1, extended-v1."),
    "degrade": ("degrade:degrade", "Degrade images of your own: blur, noise, rain, ..."),
    "inspect": ("dataset:inspect", "Print what a dataset holds."),
    "verify": ("dataset:verify", "Compare every byte of a dataset with its manifest."),
    "preview": ("dataset:preview", "Draw a contact sheet with the true keypoints."),
    "export": ("dataset:export", "Write a dataset as COCO, YOLO-pose or WebDataset."),
    "detect": ("detecting:detect", "Run a detector over a dataset or image files."),
    "score": ("score:score", "Score a predictions file with the paper's metrics."),
    "compare": ("compare:compare", "Compare detectors on the same images, pair by pair."),
    "bench": ("benchmark:bench", "Make suites, run detectors, score them beside the paper."),
    "train": ("training:train", "Train the detector; needs kpbench[train]."),
    "export-model": ("training:export_model", "Write trained weights as an ONNX file."),
    "demo": ("demo:demo", "Run the whole chain with few images, in about a minute."),
}


class LazyGroup(click.Group):
    """A group that imports a command's module when the command is run, and turns errors into exit codes."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module, attribute = COMMANDS[cmd_name][0].split(":")
        command: click.Command = getattr(importlib.import_module(f"kpbench.cli.{module}"), attribute)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, line) for name, (_, line) in COMMANDS.items()])

    def invoke(self, ctx: click.Context) -> object:
        try:
            return super().invoke(ctx)
        except KpbenchError as error:
            click.echo(f"kpbench: {self._translate(ctx, error)}", err=True)
            sys.exit(1)
        except OSError as error:  # of standard output, mostly: what we write ourselves is a KpbenchError
            if not isinstance(error, BrokenPipeError):  # who closes a pipe early knows it
                click.echo(f"kpbench: {error.strerror or error}", err=True)
            with contextlib.suppress(OSError, ValueError):  # or Python tries once more at its end, and exits with 120
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            sys.exit(1)
        except (KeyboardInterrupt, click.Abort) as stop:
            click.echo(f"kpbench: interrupted{f': {self._translate(ctx, stop)}' if str(stop) else ''}", err=True)
            sys.exit(130)

    def _translate(self, ctx: click.Context, problem: BaseException) -> str:
        """Write a problem in the words of the command that met it."""
        return name_options(str(problem), self.get_command(ctx, ctx.invoked_subcommand or ""))


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(__version__, prog_name="kpbench")
def main() -> None:
    """Keypoint patches: print them, synthesise labelled images, score any detector.

    \b
    Start here:
      kpbench demo
    """
