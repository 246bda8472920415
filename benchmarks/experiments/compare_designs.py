"""The tables of docs/explanation/designs.md that `kpbench analyze-patches` does not print.

    python benchmarks/experiments/compare_designs.py

Tag corners at equal area, how the choice depends on the rule's limits, and the runner-up's files.
"""

import itertools
import json
from pathlib import Path

import cv2
import numpy as np

from kpbench import shipped_patches
from kpbench.analysis import (
    FAMILY_GRID,
    SIZES_PX,
    PolarGrid,
    attitudes,
    background_windows,
    basin,
    best_sets,
    code_of,
    correlation_and_distance,
    design_bound,
    enumerate_family,
    inks_of,
    natural_response,
    pixels_needed,
    point_bound,
    search_designs,
)

HERE = Path(__file__).parents[1] / "designs"


def tag_corner(dictionary, radius_px, tilt_deg):
    """Bound of a corner of tag 0's black border; the tag with one white module around it has the disc's area.

    Generous to the tag: all its bits and borders are known and help, and the surroundings are a known grey.
    """
    table = cv2.aruco.getPredefinedDictionary(dictionary)
    black = cv2.aruco.generateImageMarker(table, 0, table.markerSize + 2) == 0
    modules = np.pad(black, 1)
    side = radius_px * np.sqrt(np.pi) / len(modules)
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) - 1.0  # the black border's corner is the origin
    cells = [square + np.array([column, row]) for row, column in np.ndindex(modules.shape)]
    inks = modules.reshape(1, -1).astype(np.float32)
    return max(point_bound(cells, inks, side * view)[0][0] for view in attitudes(1, (tilt_deg,)))


def bounds_table():
    print("Bound in px, worst direction: frontal, then 60 degrees")
    grid = PolarGrid.of(shipped_patches())
    worst = {
        tilt: [design_bound(grid, grid.inks(shipped_patches()), r, tilt)[0] for r in SIZES_PX] for tilt in (0.0, 60.0)
    }
    for n, patch in enumerate(shipped_patches()):
        print(f"{patch.name:24}", *(f"{worst[tilt][k][n]:.4f}" for tilt in worst for k in range(len(SIZES_PX))))
    family, inks = FAMILY_GRID, list(crossings())[1]
    medians = [np.median(design_bound(family, inks, r, tilt)[0]) for tilt in worst for r in SIZES_PX]
    no_rim = np.median(design_bound(family, inks, SIZES_PX[0], rim=False)[0])
    print(f"{'family median':24}", *(f"{m:.4f}" for m in medians), f"and without the rim at 5 px {no_rim:.4f}")
    for name, tag in (("AprilTag 36h11 corner", "DICT_APRILTAG_36h11"), ("ArUco 4x4 corner", "DICT_4X4_50")):
        print(
            f"{name:24}", *(f"{tag_corner(getattr(cv2.aruco, tag), r, t):.4f}" for t in (0.0, 60.0) for r in SIZES_PX)
        )


def crossings():
    """Codes and inks of the family's designs whose centre is a crossing."""
    codes = enumerate_family().classes
    inks = inks_of(codes)
    edges = inks[:, :8] != np.roll(inks[:, :8], 1, axis=1)
    return (a[(edges[:, :4] | edges[:, 4:]).sum(1) >= 2] for a in (codes, inks))


def family_measures(windows):
    """Codes and measures of all designs that some limit below lets through."""
    codes, inks = crossings()
    grid = FAMILY_GRID
    pixels = pixels_needed(grid, inks)
    codes, inks, pixels = (a[pixels <= 5] for a in (codes, inks, pixels))
    bound_to_centre = basin(grid, inks)
    keep = bound_to_centre >= 0.06
    codes, inks, pixels, bound_to_centre = (a[keep] for a in (codes, inks, pixels, bound_to_centre))
    natural = natural_response(grid, inks, windows)[:, 0]
    blurred = natural_response(grid, inks, windows, 0.2)[:, 0]
    distance = correlation_and_distance(grid, inks)[1]
    return codes, pixels, bound_to_centre, natural, blurred, distance


def limits_table(windows):
    print("\nBest set under other limits (needs px, basin, natural, natural blurred): closest two, set")
    codes, pixels, bound_to_centre, natural, blurred, distance = family_measures(windows)
    names = {code_of(p): p.name for p in shipped_patches()}
    limits = [(4.0, 0.10, 1 / 500, 1.0)]
    limits += [(p, 0.10, 1 / 500, 1.0) for p in (3.7, 4.5, 5.0)]
    limits += [(4.0, b, 1 / 500, 1.0) for b in (0.06, 0.08, 0.09, 0.11, 0.12)]
    limits += [(4.0, 0.10, n, 1.0) for n in (1 / 2000, 1 / 1000, 1 / 100, 1.0)]
    limits += [(4.0, 0.10, 1 / 500, b) for b in (0.05, 0.02, 0.01)]
    for limit in limits:
        chosen = np.flatnonzero(
            (pixels <= limit[0]) & (bound_to_centre >= limit[1]) & (natural <= limit[2]) & (blurred <= limit[3])
        )
        sets = best_sets(distance[np.ix_(chosen, chosen)], 4, 1)
        if not sets:
            print(*(f"{v:.4g}" for v in limit), "none")
            continue
        members = chosen[list(sets[0])]
        closest = min(distance[a, b] for a, b in itertools.combinations(members, 2))
        print(
            *(f"{v:.4g}" for v in limit),
            f"{closest:.3f}",
            *(names.get(int(c), f"{int(c):08x}") for c in codes[members]),
        )


def write_runner_up(windows):
    found = search_designs(windows, shipped_patches())
    folder = HERE / "runner-up"
    for old in folder.glob("*.toml"):
        old.unlink()
    for patch in found.sets[1]:
        table = patch.to_dict()
        shapes = ",\n".join(
            "    { " + ", ".join(f"{k} = {json.dumps(v)}" for k, v in s.items()) + " }"
            for s in table.pop("semicircles")
        )
        head = "\n".join(f"{key} = {json.dumps(value)}" for key, value in table.items())
        (folder / f"{patch.name}.toml").write_text(f"{head}\nsemicircles = [\n{shapes},\n]\n", "utf-8")
    print("\nrunner-up:", ", ".join(p.name for p in found.sets[1]), found.distances[1].round(3))


if __name__ == "__main__":
    nature = background_windows()
    bounds_table()
    limits_table(nature)
    write_runner_up(nature)
