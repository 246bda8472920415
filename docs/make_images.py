"""Make the pictures of README.md and docs: docs/images/*.png, of designs and simulated images alone.

    python docs/make_images.py

The commands are those that the pages show.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageOps

import kpbench
from kpbench.cli import main as command_line

IMAGES = Path(__file__).parent / "images"
TESTS = Path(__file__).parents[1] / "tests"
ORIENTATION = 274
"""EXIF tag of how a photograph is turned."""
PATCH_PX, MARGIN_PX, LABEL_PX = 160, 24, 36
SAMPLES = 8
"""Samples per pixel and axis of the drawn patches."""
GREY_STEP, COLOUR_STEP = 4, 32
"""Levels between the levels of a saved picture, of grey pixels and of coloured ones: at most 256 colours in all."""
README_SCENE = 19
"""The first scene of seed 0 that holds all four designs."""
BOARD_IMAGE = 13
"""Of the tutorial's photographs: trefoil at a pitch of 30 degrees."""


def kpbench_command(line: str) -> None:
    """Run a command line in this process, without its output."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        command_line.main(line.split()[1:], standalone_mode=False)


def draw_patches() -> Image.Image:
    """Return the shipped designs side by side, each with its name and ID below."""
    side = PATCH_PX + 2 * MARGIN_PX
    step = 2 / (PATCH_PX * SAMPLES)
    axis = np.arange(-side * SAMPLES / 2, side * SAMPLES / 2) * step + step / 2
    points = np.stack(np.meshgrid(axis, axis), axis=-1)
    tiles = []
    for patch in kpbench.shipped_patches():
        black = patch.is_black(points) | (np.abs(np.hypot(points[..., 0], points[..., 1]) - 1) < 1.5 / PATCH_PX)
        grey = 255 * (1 - black.reshape(side, SAMPLES, side, SAMPLES).mean(axis=(1, 3)))
        tile = np.full((side + LABEL_PX, side), 255, np.uint8)
        tile[:side] = grey.round()
        label = f"{patch.name} ({patch.patch_id})"
        (width, _), _ = cv2.getTextSize(label, cv2.FONT_HERSHEY_SIMPLEX, 0.55, 1)
        place = ((side - width) // 2, side + 12)
        cv2.putText(tile, label, place, cv2.FONT_HERSHEY_SIMPLEX, 0.55, 60, 1, cv2.LINE_AA)
        tiles.append(tile)
    return Image.fromarray(np.hstack(tiles))


def save(name: str, source: Image.Image | str) -> None:
    """Write a picture, or a picture file again, with few levels: a third of the size."""
    image = np.asarray((source if isinstance(source, Image.Image) else Image.open(source)).convert("RGB")).astype(int)
    step = np.where(np.ptp(image, axis=2, keepdims=True) < GREY_STEP, GREY_STEP, COLOUR_STEP)
    few = np.minimum((image + step // 2) // step * step, 255).astype(np.uint8)
    Image.fromarray(few).quantize(256, dither=Image.Dither.NONE).save(IMAGES / f"{name}.png", optimize=True)


def photograph_truth_board() -> None:
    """Write simulated photographs of the truth board, JPEG with EXIF, into the folder ``photos``."""
    sys.path.insert(0, str(TESTS))
    import board_photos

    Path("photos").mkdir()
    for n in range(4):
        exif = Image.Exif()
        exif[ORIENTATION] = 6 if n == 1 else 1
        pixels, _ = board_photos.photograph(n)
        Image.fromarray(pixels).save(f"photos/IMG_{n:04d}.jpg", quality=92, exif=exif)


def draw_labels() -> None:
    """Write the pictures of docs/howto/photographs-and-tables.md."""
    photograph_truth_board()
    kpbench_command("kpbench render-patches --board truth --png --dpi 60")
    save("truth-board", ImageOps.expand(Image.open("patches-print/truth.png"), border=1, fill=160))
    kpbench_command("kpbench label photos --board patches-print/truth.json --out labelled --simulated")
    kpbench_command("kpbench preview labelled --count 4 --columns 2 --tile-width 480 --out labelled.png")
    save("labelled", "labelled.png")
    kpbench_command("kpbench degrade labelled --suite paper-v1 --out degraded")
    kpbench_command("kpbench preview degraded --count 8 --columns 4 --tile-width 240 --out degraded.png")
    save("degraded", "degraded.png")


def main() -> None:
    """Write every picture."""
    IMAGES.mkdir(exist_ok=True)
    save("patches", draw_patches())
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        kpbench_command("kpbench render-patches --board hexagon --patch trefoil --png --dpi 60")
        save("page", ImageOps.expand(Image.open("patches-print/hexagon-trefoil.png"), border=1, fill=160))

        kpbench_command("kpbench synth --n 20 --deteriorate none")
        kpbench_command("kpbench detect kpbench-data --overlay found")
        save("found", f"found/{README_SCENE:08d}.png")

        kpbench_command("kpbench suite paper-v1 --images 1 --size 640x480 --only pitch,noise --out photographs")
        kpbench_command("kpbench export photographs --format coco")
        photo = f"photographs-coco/images/{BOARD_IMAGE:08d}.png"
        kpbench_command(f"kpbench detect {photo}")
        save("photo", photo)
        save("found-board", f"{BOARD_IMAGE:08d}-found.png")
        kpbench_command("kpbench suite paper-v1 --images 1 --size 640x480 --out suite")
        kpbench_command("kpbench preview suite --tile-width 160 --out rungs.png")
        save("rungs", "rungs.png")
        draw_labels()
    for path in sorted(IMAGES.glob("*.png")):
        print(f"{os.path.relpath(path)}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
