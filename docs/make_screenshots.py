"""Make the screenshots of docs/howto/ui.md: docs/images/ui-*.png, of designs and simulated images alone.

    python docs/make_screenshots.py [FOLDER]

Needs Playwright and Chromium. With FOLDER, it writes there, of each page also dark and narrow, to look at.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
from make_images import IMAGES, save
from playwright.sync_api import Page, sync_playwright

import kpbench
from kpbench.geometry import Camera, write_camera
from kpbench.render import Appearance, Pose, render_board

LOOKS = {"": (1280, 860, "light"), "-dark": (1280, 860, "dark"), "-narrow": (390, 844, "light")}
"""End of the name → width and height of the window, and its colours."""
WAIT_MS = 60_000


def make_photograph(folder: Path) -> None:
    """Write a simulated photograph of a hexagon board, the board's sidecar and the camera."""
    camera, board = Camera(640, 480, 600.0), kpbench.hexagon_board(kpbench.shipped_patches()[1], 187.5)
    turn = cv2.Rodrigues(np.radians([30.0, -25.0, 12.0]))[0]
    ground = np.linspace(90, 140, 640, dtype=np.uint8)[None].repeat(480, axis=0)
    pose = Pose(np.asarray(turn, np.float64), np.array([5.0, -5.0, 330.0]))
    image = render_board(ground, camera, pose, board, Appearance(35, 215)).image
    noisy = image + np.random.default_rng(0).normal(0, 3, image.shape)
    cv2.imwrite(str(folder / "photo.png"), noisy.clip(0, 255).astype(np.uint8))
    kpbench.print_boards([board], folder, formats=["svg"])
    write_camera(folder / "camera.yaml", camera)


def show_design(page: Page) -> None:
    """Wait until all of the page is there."""
    page.wait_for_selector("img.kp-sheet", timeout=WAIT_MS)
    page.wait_for_selector("[data-kp=measures] :text('mushroom')", timeout=WAIT_MS)


def show_photograph(page: Page) -> None:
    """Wait until the board is found."""
    page.wait_for_selector("[data-kp=pose]:has-text('seen')", timeout=WAIT_MS)
    page.wait_for_timeout(500)


def main() -> None:
    """Write the screenshots."""
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else None
    with tempfile.TemporaryDirectory() as place, sync_playwright() as playwright:
        folder = Path(place)
        make_photograph(folder)
        words = ["live", folder / "photo.png", "--board", folder / "hexagon-trefoil.json"]
        words += ["--camera", folder / "camera.yaml", "--port", 0, "--no-browser"]
        command = [sys.executable, "-m", "kpbench", *map(str, words)]
        server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert server.stdout is not None
        address = server.stdout.readline().strip().removesuffix("/detect")
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        for end, (width, height, colours) in LOOKS.items() if target else [("", LOOKS[""])]:
            context = browser.new_context(viewport={"width": width, "height": height})
            page = context.new_page()
            page.emulate_media(color_scheme="dark" if colours == "dark" else "light")
            for name, path, show in (("ui-design", "/", show_design), ("ui-detect", "/detect", show_photograph)):
                page.goto(address + path)
                show(page)
                shot = folder / f"{name}{end}.png"
                page.screenshot(path=shot, full_page=True)
                if target:
                    shutil.copy(shot, target)
                else:
                    save(name, str(shot))
                    print(
                        f"{os.path.relpath(IMAGES / name)}.png: {(IMAGES / f'{name}.png').stat().st_size / 1000:.0f} kB"
                    )
            context.close()
        browser.close()
        server.terminate()
        server.wait()


if __name__ == "__main__":
    main()
