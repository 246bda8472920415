"""``kpbench calibrate``."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import click

from kpbench.cli.messages import echo, print_warning
from kpbench.cli.options import load_one_board


@click.command()
@click.argument("photos", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--board", required=True, help="Board in the photographs: its sidecar (.json), or as in render-patches.")
@click.option("--model", type=click.Choice(["brown", "fisheye"]), default="brown", show_default=True, help="Lens.")
@click.option(
    "--coefficients",
    type=click.Choice(["0", "4", "5", "8"]),
    default="5",
    show_default=True,
    help="Coefficients of the lens for brown; fisheye always has 4.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    default=Path("camera.yaml"),
    show_default=True,
    help="Camera file to write.",
)
@click.option(
    "--format",
    "form",
    type=click.Choice(["opencv", "ros", "kalibr"]),
    default="opencv",
    show_default=True,
    help="Format of the camera file.",
)
@click.option("--report", type=click.Path(path_type=Path, dir_okay=False), help="HTML page to write.")
@click.option(
    "--detector", default="superpoint-small", show_default=True, help="Finds the patches of a board without marks."
)
def calibrate(
    photos: tuple[Path, ...],
    board: str,
    model: Literal["brown", "fisheye"],
    coefficients: str,
    out: Path,
    form: Literal["opencv", "ros", "kalibr"],
    report: Path | None,
    detector: str,
) -> None:
    """Calibrate a camera from photographs of a printed board.

    PHOTOS are a folder of photographs or files, all of one camera with fixed zoom and focus. The command writes a
    camera file that other commands take as --camera.

    \b
    Examples:
      kpbench calibrate photos/ --board patches-print/truth.json
      kpbench calibrate photos/ --board patches-print/truth.json --report camera.html --out camera.yaml
      kpbench calibrate photos/ --board patches-print/grid.json --model fisheye --format kalibr
    """
    import numpy as np

    from kpbench.calibration.camera_solution import FEW_PHOTOS
    from kpbench.calibration.camera_solution import calibrate as solve
    from kpbench.calibration.observe import REJECTIONS
    from kpbench.calibration.page import write_calibration_page
    from kpbench.calibration.photos import list_photos
    from kpbench.cli.progress import progress_bar
    from kpbench.geometry.camera_file import write_camera
    from kpbench.writing import require_writable

    require_writable(out, "calibration")
    if report is not None:
        require_writable(report, "calibration-page")
    shown = load_one_board(board)
    source: Any = photos[0] if len(photos) == 1 else list(photos)
    with progress_bar(len(list_photos(source)), "photos") as progress:
        result = solve(
            source,
            shown,
            model=model,
            coefficients=int(coefficients),
            detector=detector,
            progress=progress,
        )
    write_camera(out, result.camera, form)
    for o in result.observed:
        if o.reason:
            print_warning(f"{o.photo.name}: rejected, {o.reason} ({REJECTIONS[o.reason]})")
    used, halves = len(result.used), result.halves
    if used < FEW_PHOTOS:
        print_warning(f"{used} photographs; with fewer than {FEW_PHOTOS}, the stated uncertainty is itself uncertain")
    if halves is not None and halves.p < 0.001:
        print_warning(
            f"two halves of the photographs, solved apart, do not agree (p = {halves.p:.1g}): did zoom or focus change?"
        )
    K, rms = result.camera.K, float(np.nanmedian(result.bundle.rms_px()))
    echo(f"{out}: {used} of {len(result.observed)} photographs, residuals {rms:.3f} px (median)")
    values = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    echo(", ".join(f"{n} {v:.2f} ± {s:.2g}" for v, (n, s) in zip(values, result.sigma.items(), strict=False)) + " px")
    if report is not None:
        write_calibration_page(report, result)
        echo(report)
