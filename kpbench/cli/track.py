"""``kpbench track``."""

from __future__ import annotations

from pathlib import Path

import click

from kpbench.cli.messages import echo, print_warning
from kpbench.cli.options import load_one_board


@click.command()
@click.argument("source")
@click.option(
    "--board",
    metavar="FILE",
    help="Board to follow: the JSON sidecar of its print, its TOML file, or grid. Default: that of a dataset of films.",
)
@click.option(
    "--camera",
    type=click.Path(path_type=Path),
    help="Calibration of OpenCV, ROS or Kalibr (.yaml, .json). Default: that of a dataset of films.",
)
@click.option(
    "--poses",
    type=click.Path(dir_okay=False, path_type=Path),
    default=Path("poses.csv"),
    show_default=True,
    help="File of poses to write (.csv, .jsonl): a line per frame.",
)
@click.option(
    "--overlay", type=click.Path(path_type=Path), help="Draw the board into a folder, or into a video (.mp4)."
)
@click.option(
    "--detector",
    default="superpoint-small",
    show_default=True,
    help="Detector that looks at a whole frame when the board is lost; see kpbench detect.",
)
def track(
    source: str, board: str | None, camera: Path | None, poses: Path, overlay: Path | None, detector: str
) -> None:
    """Follow a board through a SOURCE: a film, camera:0, a folder of images in order, or a dataset of films.

    The command writes a file of poses. Each frame has the pose that was measured in it alone, and the filtered pose,
    which is a guess where the board was not found.

    \b
    Examples:
      kpbench track film.mp4 --board patches-print/hexagon-trefoil.json --camera camera.yaml
      kpbench track film.mp4 --board board.json --camera camera.yaml --poses poses.jsonl --overlay drawn.mp4
      kpbench track kpbench-suite/video-v1 --poses poses.jsonl
    """
    from kpbench.boards.pose_files import require_poses_path, write_poses
    from kpbench.cli.progress import progress_bar
    from kpbench.dataset.folder import Dataset
    from kpbench.detectors.sources import open_source
    from kpbench.errors import DataError
    from kpbench.geometry.camera_file import read_camera
    from kpbench.predictions.coco import CocoDataset
    from kpbench.synth.suite_boards import film_board
    from kpbench.tracking.films import track_images
    from kpbench.tracking.tracker import Tracker

    require_poses_path(poses)
    images = open_source(source, overlay=overlay)
    if isinstance(images, CocoDataset):
        raise DataError(f"{source}: COCO annotations, expected a film, images, or a dataset of films")
    own = film_board(images.config) if isinstance(images, Dataset) else None
    for given, option in ((board, "--board"), (camera, "--camera")):
        if given is None and own is None:
            raise click.UsageError(f"{option} is missing: {source} does not tell it")
    followed = load_one_board(board) if board is not None else own[0]  # type: ignore[index]
    seen_by = read_camera(camera) if camera is not None else own[1]  # type: ignore[index]
    length = len(images) if isinstance(images, Dataset) else images.length
    with progress_bar(length, "track", "frame") as progress:
        run = track_images(images, Tracker(followed, seen_by, detector), overlay, progress)
    write_poses(poses, run.records)
    states = [record.state for record in run.records]
    counts = ", ".join(f"{states.count(state)} {state}" for state in ("seen", "tracked", "predicted"))
    measured = sum(record.pose is not None for record in run.records)
    echo(f"{poses}: {measured} of {len(states)} frames have a pose; {counts}")
    if run.failures:
        lines = images.describe_failures(run.failures) if not isinstance(images, Dataset) else []
        for line in lines[:5]:
            print_warning(line)
