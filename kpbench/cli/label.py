"""``kpbench label``."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import click

from kpbench.cli.messages import echo, print_warning
from kpbench.cli.options import load_one_board


@click.command()
@click.argument("photos", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--board", required=True, help="Board in the photographs: the sidecar (.json) of its print.")
@click.option(
    "--camera",
    type=click.Path(path_type=Path),
    help="Camera file. Default: a lens with 5 coefficients is solved along.",
)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of the dataset.")
@click.option("--simulated", is_flag=True, help="The photographs are simulated; reports say so.")
@click.option(
    "--condition",
    type=click.Choice(["folders", "scale", "pitch"]),
    default="folders",
    show_default=True,
    help="Condition and rung: from folders such as blur/7, or from the board's share of the image or its tilt.",
)
@click.option(
    "--tripod",
    multiple=True,
    metavar="FOLDER",
    help="Folder below PHOTOS with photographs of one fixed scene ('.' for all): the easy ones give truth to the hard "
    "ones; repeatable.",
)
@click.option("--force", is_flag=True, help="Keep a dataset whose two halves do not agree.")
@click.option("--overwrite", is_flag=True, help="Delete the dataset in the folder first.")
def label(
    photos: tuple[Path, ...],
    board: str,
    camera: Path | None,
    out: Path,
    simulated: bool,
    condition: Literal["folders", "scale", "pitch"],
    tripod: tuple[str, ...],
    force: bool,
    overwrite: bool,
) -> None:
    """Make a labelled dataset from photographs of a board with reference marks.

    PHOTOS are a folder of photographs or files, all of one camera. The truth comes from the marks around the patches,
    never from a detector. Folders such as photos/blur/7 give condition and rung.

    \b
    Examples:
      kpbench label photos/ --board patches-print/truth.json --out labelled
      kpbench label photos/ --board patches-print/truth.json --camera camera.yaml --out labelled
      kpbench label photos/ --board patches-print/truth.json --tripod desk --out labelled
    """
    from kpbench.calibration.camera_solution import FEW_PHOTOS
    from kpbench.calibration.label_dataset import label as make_labels
    from kpbench.calibration.label_dataset import summarise_unlabelled
    from kpbench.calibration.observe import REJECTIONS
    from kpbench.calibration.photos import list_photos
    from kpbench.cli.progress import progress_bar
    from kpbench.geometry.camera_file import read_camera

    shown = load_one_board(board)
    source: Any = photos[0] if len(photos) == 1 else list(photos)
    with progress_bar(2 * len(list_photos(source, exclude=out)), "photos") as progress:
        result = make_labels(
            source,
            shown,
            out,
            camera=None if camera is None else read_camera(camera),
            source="simulated photographs" if simulated else "photographs",
            condition=condition,
            tripod=tripod,
            force=force,
            overwrite=overwrite,
            progress=progress,
        )
    for o in result.observed:
        if o.reason:
            print_warning(f"{o.photo.name}: rejected, {o.reason} ({REJECTIONS[o.reason]})")
    config = result.dataset.config
    if len(result.dataset) < FEW_PHOTOS:
        few = f"{len(result.dataset)} photographs; with fewer than {FEW_PHOTOS}, two halves tell little about the truth"
        print_warning(few)
    if turned := sum(photo["exif_turn"] != 1 for photo in config["photos"]):
        print_warning(
            f"{turned} photographs are turned by their EXIF data; the dataset holds them as the sensor saw them"
        )
    if rolling := [photo["name"] for photo in config["photos"] if photo["rolling_px"]]:
        print_warning(f"{len(rolling)} photographs moved while the shutter rolled, such as {rolling[0]}")
    unlabelled = ", ".join(f"{count} {reason}" for reason, count in summarise_unlabelled(config).items())
    keypoints = len(result.dataset.truth.keypoints)
    echo(f"{out}: {keypoints} keypoints in {len(result.dataset)} of {len(result.observed)} {config['source']}")
    echo(f"not labelled: {unlabelled or 'none'}")
    if (ignored := result.dataset.truth.ignored) is not None:
        echo(f"{len(ignored)} of these lie in the images, and scores ignore detections there")
    echo(
        f"error of the truth: {result.error_px:.4f} px a coordinate, by leaving out each mark "
        f"(marks: {result.leave_one_out_px:.4f} px)"
    )
