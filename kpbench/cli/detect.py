"""``kpbench detect``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from kpbench.cli.found import print_found
from kpbench.cli.messages import echo, print_warning
from kpbench.cli.options import FINITE, PATCHES, WORKERS

if TYPE_CHECKING:
    from kpbench.boards.images import PoseRecord
    from kpbench.detectors.interface import LoadedDetector
    from kpbench.detectors.prediction import Sink
    from kpbench.patches.design import Patch
    from kpbench.types import Detections, Predictions, UInt8

SHIPPED_DESIGNS_ONLY = ("template", "superpoint", "superpoint-small")
"""Detectors that look for the shipped designs only. With --patches, template looks for the given designs instead."""

OTHER_DESIGNS = "use template with `patches`, or weights trained on the other designs"


@click.command()
@click.argument("sources", metavar="SOURCE...", nargs=-1, required=True)
@click.option(
    "--detector",
    metavar="NAME",
    help="A detector of the list above, or one of your own. Default: superpoint-small; with --patches: template.",
)
@click.option(
    "--out",
    type=click.Path(dir_okay=False, path_type=Path, allow_dash=True),
    help="Predictions file to write; - writes JSON lines to stdout, each as soon as its image is done. "
    "Default: preds.json; for a single image: none.",
)
@click.option(
    "--threshold",
    type=FINITE,
    help="Least score of a detection. Default: set by the detector.",
)
@click.option(
    "--overlay",
    type=click.Path(path_type=Path),
    help="Draw the detections into a folder, into a video (.mp4), or for a single image into a .png file. Default: "
    "nothing is drawn; for a single image without --out: IMAGE-found.png.",
)
@click.option(
    "--board",
    "board_names",
    metavar="hexagon|grid|field|FILE",
    multiple=True,
    help="Board to find: a name, the JSON sidecar of its print, or its TOML file; repeatable.",
)
@click.option(
    "--camera",
    type=click.Path(path_type=Path),
    help="Calibration of OpenCV, ROS or Kalibr (.yaml, .json), for the poses of the boards.",
)
@click.option(
    "--poses",
    type=click.Path(dir_okay=False, path_type=Path),
    help="File of poses to write (.csv, .jsonl): a line per image and board. Needs --board and --camera.",
)
@click.option(
    "--second-look",
    is_flag=True,
    help="Look for patches that the detector missed, where their board says that they must be. Runs in one process.",
)
@click.option("--cost", is_flag=True, help="Record time, peak memory and the machine in the file, for reports.")
@PATCHES
@WORKERS
def detect(
    sources: tuple[str, ...],
    detector: str | None,
    out: Path | None,
    threshold: float | None,
    overlay: Path | None,
    board_names: tuple[str, ...],
    camera: Path | None,
    poses: Path | None,
    second_look: bool,
    cost: bool,
    patches: tuple[Path, ...],
    workers: int | None,
) -> None:
    """Run a detector over a SOURCE: a dataset, an image, a folder of images, a video, or camera:0.

    Several SOURCEs are images and folders of images. A quoted pattern such as "photos/**/*.png" stands for all files
    that it fits.

    Of a single image, the command prints a table of what it found, and draws IMAGE-found.png into the current folder.
    Of everything else, and wherever --out is given, it writes a predictions file (.json, .jsonl, .csv, .parquet, .h5)
    for `kpbench score`. Images and the frames of a video are numbered from 0, in order.

    \b
    Detectors:
      superpoint-small    small network, the default
      superpoint          large network
      template            no network; with --patches, designs of your own
      orb, sift           points without IDs
      aruco, apriltag, charuco, napa, locus    tags, for comparison
      FILE.onnx           weights of your own, from kpbench export-model
      MODULE:ATTR         a function or class in Python
      program:COMMAND     a program in any language

    \b
    Examples:
      kpbench detect photo.jpg
      kpbench detect kpbench-data --out preds.json
      kpbench detect photos --detector my_module:MyDetector --overlay drawn
      kpbench detect photos --patches my-patch.toml
      kpbench detect film.mp4 --detector my-weights.onnx --overlay drawn.mp4
      kpbench detect camera:0 --out -
      kpbench detect film.mp4 --board patches-print/grid.json --camera camera.yaml --poses poses.csv
      kpbench detect photos --board patches-print/grid.json --second-look
    """
    from kpbench.cli.progress import progress_bar
    from kpbench.detectors.interface import load_detector
    from kpbench.detectors.prediction import predict, record_cost
    from kpbench.detectors.sources import has_other_designs, open_source
    from kpbench.images import ImageSource
    from kpbench.patches.design import load_patches
    from kpbench.predictions.files import require_predictions_path

    detector = _choose_detector(detector, patches)
    if (not board_names and (camera or poses or second_look)) or (poses and not camera):
        raise click.UsageError("--poses needs --board and --camera; --camera and --second-look need --board")
    is_streamed = str(out) == "-"
    designs = load_patches(patches) if patches else None
    finder = BoardFinder(board_names, camera, poses, designs)
    images = open_source(*sources, overlay=overlay)
    hint = "; --overlay FOLDER draws them" if (out, overlay) == (None, None) and isinstance(images, ImageSource) else ""
    is_shown = out is None and isinstance(images, ImageSource) and images.length == 1 and Path(sources[0]).is_file()
    overlay = Path(f"{Path(sources[0]).stem}-found.png") if is_shown and overlay is None else overlay
    out = out or Path("preds.json")
    if not (is_streamed or is_shown):
        require_predictions_path(out)
    elif cost:
        raise click.UsageError("--cost needs a predictions file; give --out FILE")
    if detector in SHIPPED_DESIGNS_ONLY and not patches and has_other_designs(images):
        print_warning(f"{sources[0]} holds other designs than {detector} looks for; {OTHER_DESIGNS}")
    # a dataset may be looked at by several processes, which load the detector by its name
    is_loaded = isinstance(images, ImageSource) or designs or second_look
    loaded = load_detector(detector, threshold, designs) if is_loaded else detector
    loaded = finder.look_twice(loaded) if second_look else loaded
    options: dict[str, Any] = {"threshold": threshold, "workers": workers, "overlay": overlay, "decorate": finder.draw}
    options["sink"] = finder.pass_to(_print_lines if is_streamed else None)
    try:
        with progress_bar(images.length if isinstance(images, ImageSource) else len(images), "detect") as progress:
            run = predict(images, loaded, progress=progress, **options)
    except KeyboardInterrupt:
        text = () if is_streamed else (f"{overlay if is_shown else out} is not written; the same command starts anew",)
        raise KeyboardInterrupt(*text) from None
    if isinstance(loaded, str) or not is_shown:
        _write(record_cost(run.predictions) if cost else run.predictions, out, finder, hint)
    else:
        print_found(finder.locate(run.predictions), finder.records, loaded.patches)
        finder.write()
        echo(overlay)
    if run.failures:
        pairs = [f"{label}: {problem}" for label, problem in run.failures]
        _fail(images.describe_failures(run.failures) if isinstance(images, ImageSource) else pairs, len(run.failures))


def _choose_detector(name: str | None, patches: Sequence[Path]) -> str:
    """Return the name of the detector that is given, or the default."""
    from kpbench.detectors.interface import DEFAULT_DETECTOR

    if patches and name not in (None, "template"):
        raise click.UsageError(f"--patches is for the template detector; {name} does not take designs")
    return name or ("template" if patches else DEFAULT_DETECTOR)


def _write(predictions: Predictions, out: Path, finder: BoardFinder, hint: str) -> None:
    """Write predictions and poses, and print how many detections there are."""
    from kpbench.predictions.files import write_predictions

    is_streamed = str(out) == "-"
    if not is_streamed:
        write_predictions(out, finder.locate(predictions))
    finder.write()
    name = "stdout" if is_streamed else out
    echo(f"{name}: {len(predictions.xy)} detections in {len(predictions)} images{hint}", err=is_streamed)


def _fail(lines: Sequence[str], count: int) -> None:
    """Print the first lines about images that failed, and exit."""
    for line in lines[:5]:
        print_warning(line)
    print_warning(f"{count} images failed and count as images without detections")
    raise SystemExit(1)


class BoardFinder:
    """Finds the boards of the options in predictions, if there are any boards, and keeps their poses."""

    def __init__(
        self, names: Sequence[str], camera: Path | None, poses: Path | None, patches: Sequence[Patch] | None
    ) -> None:
        from kpbench.boards.pose_files import require_poses_path
        from kpbench.geometry.camera_file import read_camera
        from kpbench.patches.board_file import load_boards

        self.poses = None if poses is None else require_poses_path(poses)
        self.boards = [board for name in names for board in load_boards(name, patches)]
        self.camera = None if camera is None else read_camera(camera)
        self.records: list[PoseRecord] = []

    def look_twice(self, detector: str | LoadedDetector) -> LoadedDetector:
        """Return a detector that also finds the patches that it missed on the boards."""
        from kpbench.detectors.interface import load_detector
        from kpbench.tracking.second_look import look_twice

        loaded = load_detector(detector) if isinstance(detector, str) else detector
        return look_twice(loaded, self.boards, self.camera)

    def locate(self, predictions: Predictions) -> Predictions:
        """Return predictions with the points of the boards."""
        from kpbench.boards.images import locate_boards

        if not self.boards:
            return predictions
        located, records = locate_boards(predictions, self.boards, self.camera)
        self.records += records
        return located

    def draw(self, detections: Detections, size_px: tuple[int, int], canvas: UInt8) -> None:
        """Draw the boards whose poses are known into the picture of an image."""
        from kpbench.boards.drawing import draw_board
        from kpbench.boards.images import find_boards
        from kpbench.boards.pose import estimate_pose
        from kpbench.errors import DataError

        if self.camera is None:
            return
        camera = self.camera.at_size(*size_px)
        for board, matches in zip(self.boards, find_boards(detections, self.boards, camera), strict=True):
            for match in matches:
                with suppress(DataError):  # too few points for a pose
                    draw_board(canvas, board, estimate_pose(match, camera), camera)

    def pass_to(self, sink: Sink | None) -> Sink | None:
        """Return a function that gives predictions with the points of the boards to ``sink``.

        Without ``sink``, it refuses images whose size is not the camera's, before all images are looked at.
        """
        from kpbench.boards.images import require_camera_size

        if sink is not None:
            return lambda predictions: sink(self.locate(predictions))
        return None if self.camera is None else lambda predictions: require_camera_size(predictions, self.camera)

    def write(self) -> None:
        """Write the file of poses, if it is asked for, and print how many images have a pose."""
        from kpbench.boards.pose_files import write_poses

        if self.poses is None:
            return
        write_poses(self.poses, sorted(self.records, key=lambda record: record.image_id))
        seen = {record.image_id for record in self.records if record.pose is not None}
        unsure = sum(record.pose is not None and record.pose.ambiguous for record in self.records)
        images = len({record.image_id for record in self.records})
        echo(f"{self.poses}: {len(seen)} of {images} images have a pose; {unsure} poses are ambiguous", err=True)


def _print_lines(predictions: Predictions) -> None:
    """Print predictions as JSON lines; those of no image as the header."""
    from kpbench.predictions.json_files import encode_lines

    for line in encode_lines(predictions, with_header=not len(predictions)):
        echo(json.dumps(json.loads(line)))  # in ASCII, so that echo has nothing to escape
