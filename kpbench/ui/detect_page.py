"""The page on which photographs, films and cameras are looked at."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from nicegui import ui
from nicegui.events import MultiUploadEventArguments

from kpbench.detectors.interface import DETECTORS
from kpbench.errors import KpbenchError
from kpbench.files import IMAGE_SUFFIXES
from kpbench.films import VIDEO_SUFFIXES
from kpbench.geometry.camera_file import CALIBRATION_SUFFIXES
from kpbench.patches.design import shipped_patches
from kpbench.ui.desk import OWN_DETECTOR, VIEW_CAMERA, Desk
from kpbench.ui.guards import MOST_UPLOAD_BYTES
from kpbench.ui.parts import in_worker
from kpbench.ui.watcher import MOST_PICTURES, SeenImage, describe_pose, point_rows, pose_numbers

PICTURE_PERIOD_S, TABLE_PERIOD_S = 0.04, 0.5
"""Times between two updates of the picture, and of the table and the plot."""
PLOTTED = 300
"""Number of the newest images whose poses are plotted."""
SEEN_SUFFIXES = (*IMAGE_SUFFIXES, *VIDEO_SUFFIXES)
SETTING_SUFFIXES = (*CALIBRATION_SUFFIXES, ".toml")
AXIS_NAMES = ("x", "y", "z")
AXIS_COLOURS = ("#d55e00", "#009e73", "#56b4e9")
POINT_COLUMNS = {"design": "design", "x": "x px", "y": "y px", "radii": "radii px", "score": "score"}


class DetectPage:
    """The page. It shows what the watcher of a desk sees."""

    def __init__(self, desk: Desk) -> None:
        self.desk, self.chosen, self.shown, self.figured, self.drawn_s = desk, -1, -1, (-1, -1), 0.0
        with ui.element("div").classes("kp-stack"):
            self._make_source()
            self._make_look()
        with ui.element("div").classes("kp-stack"):
            self._make_picture()
            with ui.element("section").classes("kp-card"):
                ui.html("<h2>Points</h2>", sanitize=False)
                columns = [
                    {"name": key, "label": label, "field": key, "align": "left"} for key, label in POINT_COLUMNS.items()
                ]
                self.table = ui.table(rows=[], columns=columns, row_key="n").classes("kp-full").props("dense flat")
                self.table.props('no-data-label="no points"')
            with ui.element("section").classes("kp-card") as self.plot_card:
                ui.html("<h2>Pose over time</h2>", sanitize=False)
                self.plot = (
                    ui.echart(_plot([]))
                    .style("height: 320px; width: 100%")
                    .props('aria-label="place and rotation over time"')
                )
        ui.timer(PICTURE_PERIOD_S, self.update)

    def _make_source(self) -> None:
        with ui.element("section").classes("kp-card"):
            ui.html("<h2>Source</h2>", sanitize=False)
            _make_upload("Drop photographs or a film here", SEEN_SUFFIXES, self.take_images, self.refuse)
            with ui.element("div").classes("kp-row"):
                camera = ui.number("Camera number", value=0, min=0, max=99, precision=0).style("width: 120px")
                ui.button("Open the camera", on_click=lambda: self.open_camera(camera.value)).props("outline")
            self.problem = ui.label().classes("kp-problem").props('role="alert"')

    def _make_look(self) -> None:
        desk = self.desk
        with ui.element("section").classes("kp-card"):
            ui.html("<h2>Look for</h2>", sanitize=False)
            detectors = [OWN_DETECTOR, *DETECTORS]
            self.detector = ui.select(detectors, label="Detector", value=desk.detector).classes("kp-full")
            self.detector.on_value_change(lambda e: self.look(detector=e.value))
            self.board = ui.select(desk.board_names(), label="Board", value=desk.board_name).classes("kp-full")
            self.board.on_value_change(lambda e: self.look(board_name=e.value))
            with ui.element("div").classes("kp-row"):
                self.camera = ui.select(desk.camera_names(), label="Camera", value=desk.camera_name).classes("kp-grow")
                self.camera.on_value_change(lambda e: self.look(camera_name=e.value))
                self.view = ui.number(
                    "Field of view, longer side (°)", value=desk.view_deg, min=5, max=150, step=1
                ).classes("kp-grow")
                self.view.on_value_change(lambda e: self.look(view_deg=e.value))
                self.view.bind_visibility_from(self.camera, "value", value=VIEW_CAMERA)
            text = "A board's file (.json, .toml), or a calibration"
            _make_upload(text, SETTING_SUFFIXES, self.take_settings, self.refuse)
            ui.label("A pose needs a board and a camera.").classes("kp-note")

    def _make_picture(self) -> None:
        with ui.element("section").classes("kp-card"):
            ui.html("<h2>Picture</h2>", sanitize=False)
            self.photos = ui.select({}, label="Photograph", on_change=lambda e: self.choose(e.value)).classes("kp-full")
            with (
                ui.element("div").classes("kp-picture").props('role="img" aria-label="the picture with what was found"')
            ):
                self.empty = ui.label("Nothing yet: drop a photograph of printed patches, or open a camera.").classes(
                    "kp-empty kp-full"
                )
                self.image = ui.interactive_image()
            self.trouble = ui.label().classes("kp-problem").props('role="alert"')
            self.status = ui.label().classes("kp-note").props('data-kp="status"')
            self.pose = ui.label().props('data-kp="pose"').style("font-variant-numeric: tabular-nums")
            with ui.element("div").classes("kp-row"):
                self.freeze = ui.button("Freeze", icon="pause", on_click=self.switch_freeze).props("outline")
                ui.button("Look again", icon="replay", on_click=lambda: self.look()).props("outline")
                ui.button("Save picture", icon="image", on_click=self.save_picture).props("outline")
                ui.button("Save predictions", icon="data_object", on_click=self.save_predictions).props("outline")
                ui.button("Save poses", icon="timeline", on_click=self.save_poses).props("outline")

    async def take_images(self, event: MultiUploadEventArguments) -> None:
        """Look at what the browser sent."""
        with _Shown(self):
            files = event.files[:MOST_PICTURES]
            places = [(file.name, self.desk.place_for(file.name, SEEN_SUFFIXES)) for file in files]
            for file, (_, path) in zip(files, places, strict=True):
                await file.save(path)
            await in_worker(self.desk.drop, places)
            if len(event.files) > MOST_PICTURES:
                self.problem.text = f"{len(event.files)} files, of which the first {MOST_PICTURES} are shown"
        self.chosen = -1

    async def take_settings(self, event: MultiUploadEventArguments) -> None:
        """Take a board or a camera."""
        with _Shown(self):
            for file in event.files:
                path = self.desk.place_for(file.name, SETTING_SUFFIXES)
                await file.save(path)
                self.desk.take(file.name, path)
            self.board.set_options(self.desk.board_names(), value=self.desk.board_name)
            self.camera.set_options(self.desk.camera_names(), value=self.desk.camera_name)
            await in_worker(self.desk.watch)

    def refuse(self) -> None:
        """Tell why a file was not sent."""
        self.problem.text = f"refused: over {MOST_UPLOAD_BYTES // 2**20} MiB, or no file for this place"

    async def open_camera(self, number: float | None) -> None:
        """Look at a camera."""
        source = f"camera:{int(number or 0)}"
        with _Shown(self):
            await in_worker(self.desk.watch, [(source, source)])

    async def look(self, **settings: Any) -> None:
        """Look again, with other settings."""
        settings = {key: value for key, value in settings.items() if value is not None}
        if settings and all(getattr(self.desk, key) == value for key, value in settings.items()):
            return
        for key, value in settings.items():
            setattr(self.desk, key, value)
        with _Shown(self):
            await in_worker(self.desk.watch)
        self.chosen = -1

    def choose(self, number: int | None) -> None:
        """Show one of several photographs."""
        self.chosen, self.drawn_s = -1 if number is None else number, 0.0

    def switch_freeze(self) -> None:
        """Freeze a film, or let it go on."""
        self.desk.watcher.is_frozen = not self.desk.watcher.is_frozen

    def save_picture(self) -> None:
        """Send the shown picture to the browser."""
        if sight := self.desk.watcher.sight(self.chosen):
            name = f"{Path(sight.record.file.replace(':', '-')).stem}-overlay.jpg"
            ui.download.from_url(self.desk.offer(name, sight.picture), name)

    async def save_predictions(self) -> None:
        """Send the predictions of the images to the browser."""
        with _Shown(self):
            content = await in_worker(self.desk.watcher.predictions_file)
            ui.download.from_url(self.desk.offer("predictions.json", content), "predictions.json")

    async def save_poses(self) -> None:
        """Send the poses of the board to the browser."""
        with _Shown(self):
            content = await in_worker(self.desk.watcher.poses_file)
            ui.download.from_url(self.desk.offer("poses.csv", content), "poses.csv")

    def update(self) -> None:
        """Show what is new."""
        watcher = self.desk.watcher
        sight = watcher.sight(self.chosen)
        number = -1 if sight is None else sight.number
        if number != self.shown:
            self.shown = number
            self.image.set_source("" if sight is None else f"/picture/{number}")
            self.empty.visible = sight is None
        self.trouble.text = "; ".join(watcher.problems[:3])
        newest = (number, len(watcher.kept))
        if newest != self.figured and time.monotonic() - self.drawn_s > TABLE_PERIOD_S:
            self.figured, self.drawn_s = newest, time.monotonic()
            self.show_figures(sight)
        self.freeze.visible = watcher.is_film and watcher.is_running
        self.freeze.text, self.freeze.icon = ("Go on", "play_arrow") if watcher.is_frozen else ("Freeze", "pause")
        self.status.text = self.describe(sight)

    def show_figures(self, sight: SeenImage | None) -> None:
        """Show the table, the pose, the plot and the names of the photographs."""
        kept = list(self.desk.watcher.kept)
        own = self.desk.design
        names = {patch.patch_id: patch.name for patch in (own, *shipped_patches())}
        self.table.rows = [] if sight is None else point_rows(sight, names)
        self.pose.text = "" if sight is None else describe_pose(sight.record)
        is_film = self.desk.watcher.is_film
        self.plot_card.visible = is_film and any(other.record.pose for other in kept[-PLOTTED:])
        if self.plot_card.visible:
            self.plot.options.update(_plot(kept[-PLOTTED:]))
            self.plot.update()
        self.photos.visible = not is_film and len(kept) > 1
        if self.photos.visible and sight is not None:
            self.photos.set_options(
                {other.number: other.record.file for other in kept[-MOST_PICTURES:]}, value=sight.number
            )

    def describe(self, sight: SeenImage | None) -> str:
        """Return what is going on, in a line."""
        watcher = self.desk.watcher
        if sight is None:
            return "looking …" if watcher.is_running else ""
        frame = "" if sight.record.frame_index is None else f", frame {sight.record.frame_index}"
        rate = f", {watcher.frames_per_s:.1f} frames/s" if watcher.is_film and watcher.is_running else ""
        end = "" if watcher.is_running else ", at its end" if watcher.is_film else ""
        size = f"{sight.size_px[0]} x {sight.size_px[1]} px"
        return f"{sight.record.file}{frame}, {size}: {len(sight.detections)} points in {sight.ms:.0f} ms{rate}{end}"


class _Shown:
    """Shows the error of a block on the page, or that there is none."""

    def __init__(self, page: DetectPage) -> None:
        self.page = page

    def __enter__(self) -> None:
        self.page.problem.text = ""

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> bool:
        if isinstance(error, KpbenchError):
            self.page.problem.text = str(error)
            return True
        return False


def _make_upload(text: str, suffixes: tuple[str, ...], take: Any, refuse: Any) -> None:
    """Make a place to drop files, and a button that the keyboard reaches."""
    upload = ui.upload(
        multiple=True,
        auto_upload=True,
        max_file_size=MOST_UPLOAD_BYTES,
        max_total_size=MOST_UPLOAD_BYTES,
        label=text,
        on_multi_upload=take,
        on_rejected=refuse,
    )
    upload.classes("kp-full").props(f'flat bordered accept="{",".join(suffixes)}"')
    # After the event: a reset within it aborts the request before the browser ends it, and the page would show for ever
    # that it loads.
    for event in ("uploaded", "failed"):
        upload.on(event, js_handler=f"() => setTimeout(() => runMethod({upload.id}, 'reset', []))")
    upload.on("failed", refuse, args=[])
    button = ui.button("Choose files", icon="folder_open").props("outline").props(f'aria-label="choose files: {text}"')
    button.on("click", js_handler=f"() => runMethod({upload.id}, 'pickFiles', [])")


def _plot(sights: list[SeenImage]) -> dict[str, Any]:
    """Return the plot of the poses, for ECharts: place above, rotation below."""
    poses = [pose_numbers(sight.record) for sight in sights]
    times = [_time_of(sight) for sight in sights]
    style = {"color": "#888"}

    def axis(name: str, row: int) -> dict[str, Any]:
        return {
            "gridIndex": row,
            "name": name,
            "scale": True,
            "axisLabel": style,
            "nameTextStyle": style,
            "splitNumber": 3,
        }

    series = [
        {
            "name": name if row == 0 else f"{name} ",
            "type": "line",
            "xAxisIndex": row,
            "yAxisIndex": row,
            "showSymbol": False,
            "color": colour,
            "data": [
                [at, None if pose is None else round(pose[row][n], 3)] for at, pose in zip(times, poses, strict=True)
            ],
        }
        for row in (0, 1)
        for n, (name, colour) in enumerate(zip(AXIS_NAMES, AXIS_COLOURS, strict=True))
    ]
    return {
        "animation": False,
        "textStyle": style,
        "legend": {"data": [*AXIS_NAMES], "textStyle": style, "top": 0},
        "tooltip": {"trigger": "axis"},
        "grid": [
            {"top": 44, "height": 90, "left": 60, "right": 16},
            {"top": 190, "height": 90, "left": 60, "right": 16},
        ],
        "xAxis": [
            {"type": "value", "gridIndex": row, "min": "dataMin", "max": "dataMax", "axisLabel": style}
            for row in (0, 1)
        ],
        "yAxis": [axis("place, mm", 0), axis("rotation, °", 1)],
        "series": series,
    }


def _time_of(sight: SeenImage) -> float:
    """Return the time of a frame, s, or its number if the film has no times."""
    return sight.number if sight.record.time_s is None else round(sight.record.time_s, 3)
