"""``kpbench detect``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from kpbench.cli.messages import echo, print_warning
from kpbench.cli.options import FINITE, PATCHES, WORKERS

if TYPE_CHECKING:
    from kpbench.boards.images import PoseRecord
    from kpbench.detectors.interface import LoadedDetector
    from kpbench.detectors.prediction import Sink
    from kpbench.patches.design import Patch
    from kpbench.types import Predictions

SHIPPED_DESIGNS_ONLY = ("template", "superpoint", "superpoint-small")
"""Detectors that look for the shipped designs only. With --patches, template looks for the given designs instead."""


@click.command()
@click.argument("sources", metavar="SOURCE...", nargs=-1, required=True)
@click.option(
    "--detector",
    default="template",
    show_default=True,
    help="A shipped detector, FILE.onnx, MODULE:ATTR or program:COMMAND.",
)
@click.option(
    "--out",
    type=click.Path(dir_okay=False, path_type=Path, allow_dash=True),
    default=Path("preds.json"),
    show_default=True,
    help="Predictions file to write; - writes JSON lines to stdout, each as soon as its image is done.",
)
@click.option(
    "--threshold",
    type=FINITE,
    help="Least score of a detection. Default: set by the detector.",
)
@click.option(
    "--overlay",
    type=click.Path(path_type=Path),
    help="Draw the detections into a folder, into a video (.mp4), or for a single image into a .png file.",
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
    detector: str,
    out: Path,
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

    The command writes a predictions file (.json, .jsonl, .csv, .parquet, .h5) for `kpbench score`. Images and the
    frames of a video are numbered from 0, in order.

    \b
    Examples:
      kpbench detect kpbench-data --detector template --out preds.json
      kpbench detect photos --detector my_module:MyDetector --overlay drawn
      kpbench detect photos --detector template --patches my-patch.toml
      kpbench detect film.mp4 --detector my-weights.onnx --overlay drawn.mp4
      kpbench detect camera:0 --detector superpoint-small --out -
      kpbench detect film.mp4 --board patches-print/grid.json --camera camera.yaml --poses poses.csv
      kpbench detect photos --board patches-print/grid.json --second-look
    """
    from kpbench.cli.progress import progress_bar
    from kpbench.detectors.interface import load_detector
    from kpbench.detectors.prediction import predict, record_cost
    from kpbench.detectors.sources import has_other_designs, open_source
    from kpbench.images import ImageSource
    from kpbench.patches.design import load_patches
    from kpbench.predictions.files import require_predictions_path, write_predictions

    if patches and detector != "template":
        raise click.UsageError(f"--patches is for the template detector; {detector} does not take designs")
    if (not board_names and (camera or poses or second_look)) or (poses and not camera):
        raise click.UsageError("--poses needs --board and --camera; --camera and --second-look need --board")
    is_streamed = str(out) == "-"
    if not is_streamed:
        require_predictions_path(out)
    designs = load_patches(patches) if patches else None
    finder = BoardFinder(board_names, camera, poses, designs)
    images = open_source(*sources, overlay=overlay)
    if detector in SHIPPED_DESIGNS_ONLY and not patches and has_other_designs(images):
        print_warning(
            f"{sources[0]} holds other designs than {detector} looks for; use template with `patches`, "
            "or weights trained on the other designs"
        )
    loaded = load_detector(detector, threshold, designs) if designs or second_look else detector
    loaded = finder.look_twice(loaded) if second_look else loaded
    try:
        with progress_bar(images.length if isinstance(images, ImageSource) else len(images), "detect") as progress:
            options: dict[str, Any] = {
                "threshold": threshold,
                "workers": workers,
                "overlay": overlay,
                "progress": progress,
            }
            run = predict(images, loaded, sink=finder.pass_to(_print_lines if is_streamed else None), **options)
    except KeyboardInterrupt:
        text = () if is_streamed else (f"{out} is not written; the same command starts anew",)
        raise KeyboardInterrupt(*text) from None
    if not is_streamed:
        located = finder.locate(run.predictions)
        write_predictions(out, record_cost(located) if cost else located)
    finder.write()
    name = "stdout" if is_streamed else out
    echo(f"{name}: {len(run.predictions.xy)} detections in {len(run.predictions)} images", err=is_streamed)
    if run.failures:
        pairs = [f"{label}: {problem}" for label, problem in run.failures]
        _fail(images.describe_failures(run.failures) if isinstance(images, ImageSource) else pairs, len(run.failures))


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
