"""``kpbench ui`` and ``kpbench live``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from kpbench.cli.messages import echo, print_warning


def serving_options(function: Callable[..., None]) -> Callable[..., None]:
    """Add the options that both commands have."""
    for option in (
        click.option("--no-browser", is_flag=True, help="Print the address, and open no browser."),
        click.option(
            "--port", type=click.IntRange(0, 65535), default=8000, show_default=True, help="Port; 0 for any free one."
        ),
        click.option(
            "--host",
            default="127.0.0.1",
            show_default=True,
            help="Address to listen on. By default, only this machine reaches the application.",
        ),
    ):
        function = option(function)
    return function


@click.command()
@serving_options
def ui(host: str, port: int, no_browser: bool) -> None:
    """Open the application in a browser: design and print patches, look at photographs, films and cameras.

    The application runs on this machine and loads nothing from elsewhere. It needs kpbench[ui]. Ctrl-C ends it.

    \b
    Examples:
      kpbench ui
      kpbench ui --port 8080 --no-browser
    """
    _serve(host, port, no_browser)


@click.command()
@click.argument("source")
@click.option(
    "--board",
    metavar="FILE",
    help="Board to follow: the JSON sidecar of its print, its TOML file, or grid, truth or field.",
)
@click.option(
    "--camera", type=click.Path(path_type=Path), help="Calibration of OpenCV, ROS or Kalibr (.yaml, .json), for poses."
)
@serving_options
def live(source: str, board: str | None, camera: Path | None, host: str, port: int, no_browser: bool) -> None:
    """Watch a SOURCE in a browser: camera:0, a film, or an image.

    The command opens the page "Detect and live" of `kpbench ui`. Ctrl-C ends it.

    \b
    Examples:
      kpbench live camera:0
      kpbench live film.mp4 --board patches-print/hexagon-trefoil.json --camera camera.yaml
    """
    _serve(host, port, no_browser, source=source, board=board, camera=camera)


def _serve(host: str, port: int, no_browser: bool, **settings: Any) -> None:
    """Serve until Ctrl-C, which is the usual end."""
    from kpbench.ui.guards import is_loopback
    from kpbench.ui.serving import serve

    if not is_loopback(host):
        print_warning(f"every machine that reaches {host} can use the application, see its pictures and its camera")
    try:
        serve(host, port, open_browser=not no_browser, started=echo, **settings)
    except KeyboardInterrupt:
        echo("kpbench: ended", err=True)
