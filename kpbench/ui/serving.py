"""Start the application, and clean up after it."""

from __future__ import annotations

import os
import socket
import tempfile
from collections.abc import Callable
from pathlib import Path

from kpbench.errors import DataError, system_reason
from kpbench.geometry.camera_file import read_camera
from kpbench.images import open_images
from kpbench.patches.board_file import load_boards
from kpbench.ui.desk import FILE_BOARD, FILE_CAMERA, Desk

DEFAULT_PORT = 8000


def serve(
    host: str = "127.0.0.1",
    port: int = DEFAULT_PORT,
    *,
    open_browser: bool = True,
    source: str | None = None,
    board: str | Path | None = None,
    camera: str | Path | None = None,
    started: Callable[[str], None] = lambda url: None,
) -> None:
    """Serve the application until Ctrl-C. What browsers send is kept in a temporary folder, which goes at the end.

    Parameters
    ----------
    host : str
        Address to listen on. On "127.0.0.1", only this machine reaches the application.
    port : int
        0 for any free port.
    open_browser : bool
        Whether to open a browser.
    source : str, optional
        Film, image or ``camera:N`` to look at from the start.
    board, camera : str or Path, optional
        Board to look for, as for :func:`kpbench.patches.load_boards`, and calibration file.
    started : callable
        Called with the address of the first page as soon as it can be opened.

    Raises
    ------
    DataError
        If NiceGUI is not installed, the port is taken, or the source, the board or the camera cannot be read.

    Examples
    --------
    >>> import kpbench
    >>> kpbench.ui.serve(open_browser=False, source="film.mp4")  # doctest: +SKIP
    """
    port = _free_port(host, port)
    with tempfile.TemporaryDirectory(prefix="kpbench-ui-") as folder:
        desk = Desk(Path(folder))
        if board is not None:
            [found, *others] = load_boards(board)
            if others:
                raise DataError(f"{board}: names {len(others) + 1} boards, expected the file of one of them")
            desk.board, desk.board_name = found, FILE_BOARD
        if camera is not None:
            desk.camera, desk.camera_name = read_camera(camera), FILE_CAMERA
        if source is not None:
            if not source.startswith("camera:"):
                open_images(source)  # refuses what cannot be opened before the server starts
            desk.watch([(Path(source).name, source)])
        before, tempfile.tempdir = tempfile.tempdir, folder  # of parts of uploads
        os.environ["NICEGUI_STORAGE_PATH"] = folder
        try:
            try:
                from kpbench.ui.application import run_application
            except ModuleNotFoundError as error:
                raise DataError(f"the application needs NiceGUI: pip install 'kpbench[ui]' ({error})") from None
            run_application(desk, host, port, open_browser, "/" if source is None else "/detect", started)
        finally:
            tempfile.tempdir = before
            desk.watcher.close()


def _free_port(host: str, port: int) -> int:
    """Return the port, or a free one for 0."""
    try:
        with socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET) as server:
            return int(server.getsockname()[1])
    except (OSError, OverflowError) as error:
        reason = system_reason(error) or str(error)
        raise DataError(f"`port` {port} of `host` {host} cannot be opened ({reason}), expected a free one") from None
