"""Sabotaged sets of simulated photographs: does `label` notice each, with a reason? And does it keep clean sets?

    python benchmarks/accuracy/label_sabotage.py --clean 5

Each set has 22 photographs of 960 x 720 px by a simple camera. A sabotage is caught if the command fails, warns,
rejects the sabotaged photographs with a reason, or does not label the sabotaged patches.
"""

import argparse
import dataclasses
import shutil
import sys
import tempfile
import warnings
from pathlib import Path

import cv2
import numpy as np

import kpbench

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
import board_photos

BOARD, CAMERA, PHOTOS = board_photos.BOARD, board_photos.CAMERA, 22
BAD = ("18.png", "19.png", "20.png")
"""The photographs that a sabotage of single photographs changes."""


def change(folder, edit, names=BAD):
    for name in names:
        cv2.imwrite(str(folder / name), edit(cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE)))


def replace_photos(folder, names, **settings):
    for name in names:
        cv2.imwrite(str(folder / name), board_photos.photograph(int(name[:2]), **settings)[0])


def warp(matrix):
    return lambda image: cv2.warpPerspective(image, matrix, (960, 720), flags=cv2.INTER_CUBIC)


def zoom(scale, shift=0.0):
    return warp(np.array([[scale, 0, 480 * (1 - scale) + shift], [0, scale, 360 * (1 - scale)], [0, 0, 1.0]]))


def hide_marks(image):
    for x in range(0, 960, 60):
        cv2.line(image, (x, 0), (x - 200, 720), 128, 34)
    return image


def two_boards(image):
    small = cv2.resize(image, (480, 360), interpolation=cv2.INTER_AREA)
    return np.vstack([np.hstack([small, small]), np.full((360, 960), 128, np.uint8)])


def glare(image):
    y, x = np.mgrid[:720, :960]
    blob = 400 * np.exp(-((x - 480) ** 2 + (y - 360) ** 2) / (2 * 90**2))
    return np.clip(image + blob, 0, 255).astype(np.uint8)


def motion(image):
    return cv2.filter2D(image, -1, np.full((1, 25), 1 / 25))


def breathing(folder):
    for n in range(PHOTOS):
        camera = dataclasses.replace(CAMERA, focal_px=830 * (1 + 0.004 * n), focal_y_px=831 * (1 + 0.004 * n))
        replace_photos(folder, [f"{n:02d}.png"], camera=camera)


def printed(sx, sy):
    marks = [
        dataclasses.replace(m, x_mm=m.x_mm * sx, y_mm=m.y_mm * sy, width_mm=m.width_mm * sx, height_mm=m.height_mm * sy)
        for m in BOARD.references
    ]
    points = [dataclasses.replace(k, x_mm=k.x_mm * sx, y_mm=k.y_mm * sy) for k in BOARD.keypoints]
    return dataclasses.replace(BOARD, references=tuple(marks), keypoints=tuple(points))


HALF = [f"{n:02d}.png" for n in range(PHOTOS // 2, PHOTOS)]
OTHER = dataclasses.replace(CAMERA, focal_px=870.0, focal_y_px=871.0, distortion=(-0.03, 0.0, 0.0, 0.0, 0.0))
RING = kpbench.with_reference(kpbench.grid_board(kpbench.shipped_patches(), 3, 3, 40.0, 60.0))
SWAPPED = kpbench.truth_board(kpbench.shipped_patches()[::-1])
SABOTAGES = {
    "x printed at 97 % of y": (
        lambda f: replace_photos(f, [f"{n:02d}.png" for n in range(PHOTOS)], board=printed(0.97, 1.0)),
        BOARD,
    ),
    "board file of another board": (lambda f: None, RING),
    "board file with other designs": (lambda f: None, SWAPPED),
    "mirrored": (lambda f: change(f, lambda i: i[:, ::-1]), BOARD),
    "photographs of another board": (lambda f: replace_photos(f, BAD, board=RING), BOARD),
    "most marks covered": (lambda f: change(f, hide_marks), BOARD),
    "glare": (lambda f: change(f, glare), BOARD),
    "motion blur of 25 px": (lambda f: change(f, motion), BOARD),
    "two boards in view": (lambda f: change(f, two_boards), BOARD),
    "resized": (lambda f: change(f, lambda i: cv2.resize(i, (720, 540), interpolation=cv2.INTER_AREA)), BOARD),
    "turned by 90 degrees": (lambda f: change(f, lambda i: cv2.rotate(i, cv2.ROTATE_90_CLOCKWISE)), BOARD),
    "turned by 180 degrees": (lambda f: change(f, lambda i: cv2.rotate(i, cv2.ROTATE_180)), BOARD),
    "zoomed by 1.15": (lambda f: change(f, zoom(1.15)), BOARD),
    "shifted by 60 px (cropped)": (lambda f: change(f, zoom(1.0, 60.0)), BOARD),
    "squeezed by 3 %": (lambda f: change(f, warp(np.diag([0.97, 1.0, 1.0]))), BOARD),
    "half of the photographs by another camera": (lambda f: replace_photos(f, HALF, camera=OTHER), BOARD),
    "focus breathing by 8 %": (breathing, BOARD),
    "broken files": (lambda f: [(f / n).write_bytes((f / n).read_bytes()[:5000]) for n in BAD], BOARD),
    "darkness": (lambda f: change(f, lambda i: (i * 0.02).astype(np.uint8)), BOARD),
    "other pictures": (lambda f: change(f, lambda i: cv2.GaussianBlur(i, (0, 0), 25)), BOARD),
}


def run(folder, board, scratch):
    """Return what the command told, and how many photographs it kept."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            result = kpbench.label(folder, board, scratch / "out", overwrite=True)
        except kpbench.KpbenchError as error:
            return [f"fails: {str(error)[-150:]}"], 0
    words = [f"warns: {str(w.message)[-90:]}" for w in told]
    words += [f"{o.photo.name} {o.reason}" for o in result.observed if o.reason]
    for photo in result.dataset.config["photos"]:
        if photo["unlabelled"].get("covered"):
            words.append(f"{photo['name']} {photo['unlabelled']['covered']} covered")
    return words, len(result.dataset)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clean", type=int, default=5, help="number of clean sets")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        scratch = Path(place)
        board_photos.write_photos(scratch / "base", PHOTOS)
        for name, (sabotage, board) in SABOTAGES.items():
            shutil.rmtree(scratch / "photos", ignore_errors=True)
            shutil.copytree(scratch / "base", scratch / "photos")
            sabotage(scratch / "photos")
            words, kept = run(scratch / "photos", board, scratch)
            print(f"{'caught' if words else 'MISSED'}  {name}: {kept} kept; {'; '.join(words[:4])}", flush=True)
        for n in range(args.clean):
            shutil.rmtree(scratch / "photos", ignore_errors=True)
            (scratch / "photos").mkdir()
            for k in range(PHOTOS):
                cv2.imwrite(str(scratch / "photos" / f"{k:02d}.png"), board_photos.photograph(1000 + 100 * n + k)[0])
            words, kept = run(scratch / "photos", BOARD, scratch)
            print(f"clean set {n}: {kept} of {PHOTOS} kept {'; '.join(words[:4])}", flush=True)


if __name__ == "__main__":
    main()
