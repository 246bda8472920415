"""The web application: its routes, its pages and its start."""

from __future__ import annotations

import asyncio
import mimetypes
from collections.abc import Callable
from urllib.parse import quote

from fastapi import Response
from nicegui import app, background_tasks, core, ui
from nicegui.server import Server

from kpbench.ui.design_page import DesignPage
from kpbench.ui.desk import Desk
from kpbench.ui.detect_page import DetectPage
from kpbench.ui.guards import Guard
from kpbench.ui.parts import page_frame

GONE = Response("kpbench: it is gone; reload the page\n", 404, media_type="text/plain")

RECONNECT_S = 30.0
"""Time for which a browser may be silent, s: a machine that detects may be slow to answer."""


def run_application(
    desk: Desk, host: str, port: int, open_browser: bool, first_page: str, started: Callable[[str], None]
) -> None:
    """Serve the pages until the process is told to end. Arguments as for :func:`kpbench.ui.serve`."""
    core.sio.eio.cors_allowed_origins = None  # pages of this server alone
    app.add_middleware(Guard, host=host)

    @app.get("/picture/{number}")
    def send_picture(number: int) -> Response:
        sight = desk.watcher.sight(number)
        if sight is None:  # another source was opened meanwhile
            return Response(status_code=204)
        return Response(sight.picture, media_type="image/jpeg", headers={"cache-control": "no-store"})

    @app.get("/download/{key}")
    def send_download(key: str) -> Response:
        found = desk.fetch(key)
        if found is None:
            return GONE
        name, content = found
        kind = mimetypes.guess_type(name)[0] or "application/octet-stream"
        headers = {"content-disposition": f"inline; filename*=UTF-8''{quote(name)}"}
        return Response(content, media_type=kind, headers=headers)

    @ui.page("/")
    def show_design() -> None:
        with page_frame(desk, "/"):
            DesignPage(desk)

    @ui.page("/detect")
    def show_detect() -> None:
        with page_frame(desk, "/detect"):
            DetectPage(desk)

    async def announce() -> None:
        while not Server.instance.started:
            await asyncio.sleep(0.02)
        started(f"http://{f'[{host}]' if ':' in host else host}:{port}{first_page}")

    app.on_startup(lambda: background_tasks.create(announce()))
    ui.run(
        host=host,
        port=port,
        title="kpbench",
        favicon="◑",
        dark=None,
        language="en-US",
        show=first_page if open_browser else False,
        reload=False,
        tailwind=False,
        show_welcome_message=False,
        message_history_length=100,
        reconnect_timeout=RECONNECT_S,
        uvicorn_logging_level="error",
    )
