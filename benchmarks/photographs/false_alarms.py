"""False alarms in real photographs without patches, by kind of photograph, and a picture of the worst.

Every detection is a false alarm. The kind of a photograph is its folder below the given one; in the folder itself, the
letters at the start of its name, such as ``april`` of ``april_000.jpg``. The contact sheet shows the photographs with
the most false alarms of the first detector. Look at it: a real target is no false alarm. Never commit the sheet.

    python benchmarks/photographs/false_alarms.py photographs/clean --sheet worst.png
"""

from __future__ import annotations

import argparse
import re
from collections import defaultdict
from pathlib import Path

import cv2

import kpbench
from kpbench.dataset import draw_detections
from kpbench.dataset.drawing import contact_sheet
from kpbench.images import encode_png, open_images
from kpbench.types import Detections, UInt8
from kpbench.writing import write_file

TILE_PX = 400
"""Long side of a photograph on the contact sheet."""


def kind_of(name: str) -> str:
    """Return the kind of a photograph, from its path below the folder."""
    folder = Path(name).parent.as_posix()
    found = re.match(r"[^\W\d_]{3,}", Path(name).name)
    return folder if folder != "." else found[0] if found else "other"


def draw_tile(image: UInt8, detections: Detections) -> UInt8:
    """Draw detections on a photograph, smaller."""
    tile = draw_detections(image, detections)
    scale = TILE_PX / max(tile.shape[:2])
    return cv2.resize(tile, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)  # type: ignore[return-value]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--detector", action="append", help="repeatable; default: all three that find patches")
    parser.add_argument("--threshold", type=float, help="least score of a detection; default: the detector's")
    parser.add_argument("--sheet", type=Path, help="PNG to write, a contact sheet of the worst photographs")
    parser.add_argument("--worst", type=int, default=12, help="number of photographs on the contact sheet")
    options = parser.parse_args()
    names = options.detector or ["superpoint-small", "superpoint", "template"]
    detectors = {name: kpbench.load_detector(name, options.threshold) for name in names}
    counts: dict[str, dict[str, list[int]]] = defaultdict(lambda: {name: [] for name in names})
    worst: list[tuple[int, str, UInt8]] = []
    for folder in options.folders:
        for name, image in open_images(str(folder)).images:
            if image is None:
                continue
            found = {key: detector(image) for key, detector in detectors.items()}
            for key, detections in found.items():
                counts[kind_of(name)][key].append(len(detections))
            first = found[names[0]]
            if len(first):
                worst.append((len(first), name, draw_tile(image, first)))
                worst = sorted(worst, key=lambda entry: (-entry[0], entry[1]))[: options.worst]
    print("false alarms a photograph (share of photographs with any), photographs:\n")
    print(f"| kind | photographs | {' | '.join(names)} |\n|{'---|' * (2 + len(names))}")
    rows = sorted(counts.items())
    whole = {name: [n for _, of_kind in rows for n in of_kind[name]] for name in names}
    for kind, of_kind in [*rows, ("**all**", whole)]:
        cells = (f"{sum(v) / len(v):.3f} ({sum(n > 0 for n in v) / len(v):.0%})" for v in of_kind.values())
        print(f"| {kind} | {len(of_kind[names[0]])} | {' | '.join(cells)} |")
    print(f"\nthe worst of {names[0]}:", ", ".join(f"{name} ({count})" for count, name, _ in worst) or "none")
    if options.sheet and worst:
        write_file(options.sheet, encode_png(contact_sheet([tile for _, _, tile in worst], 4), "picture"))


if __name__ == "__main__":
    main()
