"""Patch fields beside ChArUco boards and AprilGrids: the same area on paper, the same scenes, parts of them covered.

Each board is a sheet of A4 at 300 dpi. The field is printed to PDF and rasterised by pdfium, the others are drawn by
OpenCV. A scene has one pose, one photograph as its background, one set of covers and one camera for all boards. Covers
are bars with round ends, cut from another photograph, that lie on the sheet until they cover a share of the area. The
light goes through ``kpbench.camera.photograph``. In the worn scenes, it is blurred first, and noise is added after it.

    python benchmarks/accuracy/fields_comparison.py --backgrounds photos/ [--scenes 20] [--seed 0] [--covered 0.6 0.8]
    python benchmarks/accuracy/fields_comparison.py --backgrounds photos/ --bent [--scenes 40] [--pictures DIR]
    python benchmarks/accuracy/fields_comparison.py --figure-of docs/results/fields.md

A point is right if it lies within 3 px of its true place, and has a wrong identity if it does not. Poses come from
points that fit one homography, by ``cv2.solvePnPGeneric`` (IPPE), for all boards. Good poses are off by up to 2 degrees
and 2 % of the distance. Errors are medians over all poses that were found. With ``--bent``, only the field is shown,
rolled onto cylinders.
"""

from __future__ import annotations

import argparse
import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pypdfium2

import kpbench
from kpbench.camera import CameraPreset, load_camera_preset, photograph, scene_light
from kpbench.camera.paper import Cylinder
from kpbench.detectors.tags import AprilTagDetector
from kpbench.printing import PageFormat, board_sheet, to_pdf
from kpbench.report.charts import CHART_STYLE, Series, line_chart

WIDTH, HEIGHT, FOCAL = 960, 720, 1100.0
K = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]])
PAPER_MM, DPI = (210.0, 297.0), 300
AREA_MM = np.array([168.0, 240.0])
"""Area of the field, which is covered in part."""
FINER = 2
"""The scene is drawn with this many samples per pixel in x and y."""
DISC_PX = (20.0, 45.0)
"""Least and largest width of the field's discs of 16 mm, seen from the front."""
RIGHT_PX = 3.0
GOOD_POSE = (2.0, 20.0)
"""Largest errors of a good pose: degrees, and mm per m of distance."""
COVERED = (0.0, 0.2, 0.4, 0.6, 0.8)
CHARUCO, SQUARE_MM, MARKER_MM = (8, 11), 21.0, 15.75
TAGS, TAG_MM = (4, 6), 29.6
TAG_PITCH_MM = 1.3 * TAG_MM  # as Kalibr's AprilGrid


@dataclass(frozen=True)
class Target:
    """A sheet, its points in mm from the sheet's middle (N, 3), and a function from an image to (indices, xy)."""

    sheet: np.ndarray
    points_mm: np.ndarray
    find: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def make_field() -> Target:
    board = kpbench.field_board(kpbench.shipped_patches())
    page = pypdfium2.PdfDocument(io.BytesIO(to_pdf(board_sheet(board, PageFormat(*PAPER_MM)).pages)))[0]
    picture = page.render(scale=DPI / 72, grayscale=True)
    sheet = np.ascontiguousarray(picture.to_numpy().reshape(picture.height, -1)[:, : picture.width])
    places = board_sheet(board, PageFormat(*PAPER_MM)).sidecar["keypoints"]
    points = np.array([[k["page_x_mm"], k["page_y_mm"], 0.0] for k in places]) - [*np.divide(PAPER_MM, 2), 0.0]
    detector = kpbench.load_detector("superpoint-small")

    def find(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        sure = [m for m in kpbench.find_board(detector(image), board) if not m.ambiguous]
        if not sure:
            return np.zeros(0, int), np.zeros((0, 2))
        return np.concatenate([m.points for m in sure]), np.concatenate([m.detections.xy for m in sure])

    return Target(sheet, points, find)


def paste(sheet: np.ndarray, picture: np.ndarray, left_mm: float, top_mm: float) -> None:
    x, y = (round(v * DPI / 25.4) for v in (left_mm, top_mm))
    sheet[y : y + picture.shape[0], x : x + picture.shape[1]] = picture


def blank() -> np.ndarray:
    return np.full([round(side * DPI / 25.4) for side in PAPER_MM[::-1]], 255, np.uint8)


def to_px(mm: float) -> int:
    return round(mm * DPI / 25.4)


def make_charuco() -> Target:
    board = cv2.aruco.CharucoBoard(
        CHARUCO, SQUARE_MM, MARKER_MM, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    )
    size = np.array(CHARUCO) * SQUARE_MM
    sheet, corner = blank(), (np.array(PAPER_MM) - size) / 2
    paste(sheet, board.generateImage((to_px(size[0]), to_px(size[1]))), *corner)
    points = np.asarray(board.getChessboardCorners(), np.float64) - [*size / 2, 0.0]
    parameters = cv2.aruco.CharucoParameters()
    parameters.tryRefineMarkers = True
    detector = cv2.aruco.CharucoDetector(board, parameters)

    def find(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        xy, ids, _, _ = detector.detectBoard(image)
        return (np.zeros(0, int), np.zeros((0, 2))) if ids is None else (ids.ravel(), xy.reshape(-1, 2))

    return Target(sheet, points, find)


def make_aprilgrid() -> Target:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    size = (np.array(TAGS) - 1) * TAG_PITCH_MM + TAG_MM
    sheet, corners = blank(), []
    for n in range(TAGS[0] * TAGS[1]):
        corner = np.array([n % TAGS[0], n // TAGS[0]]) * TAG_PITCH_MM - size / 2
        paste(sheet, cv2.aruco.generateImageMarker(dictionary, n, to_px(TAG_MM)), *(corner + np.divide(PAPER_MM, 2)))
        corners += [[*(corner + TAG_MM * np.array(place)), 0.0] for place in ((0, 0), (1, 0), (1, 1), (0, 1))]
    detector = AprilTagDetector()

    def find(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found = detector.detect(image)
        assert found.patch_id is not None
        return found.patch_id, found.xy

    return Target(sheet, np.array(corners), find)


@dataclass(frozen=True)
class View:
    """A pose (R, t), a bow or None, and where on the sheet each sample of the image lies, mm (nan: beside it)."""

    R: np.ndarray
    t: np.ndarray
    bow: Cylinder | None
    on_sheet: np.ndarray

    def project(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the image of points of the flat sheet, px."""
        bent = points_mm if self.bow is None else self.bow.bend(points_mm[:, :2])
        rays = (bent @ self.R.T + self.t) @ K.T
        return rays[:, :2] / rays[:, 2:]


def random_view(rng: np.random.Generator, bent: bool) -> View:
    tilt, around, turn = np.radians(55) * np.sqrt(rng.uniform()), *rng.uniform(0, 2 * np.pi, 2)
    R = (
        cv2.Rodrigues(tilt * np.array([np.cos(around), np.sin(around), 0.0]))[0]
        @ cv2.Rodrigues(np.array([0, 0, turn]))[0]
    )
    z = FOCAL * 16.0 / np.exp(rng.uniform(*np.log(DISC_PX)))
    t = np.array([*rng.uniform(-0.15, 0.15, 2) * z * np.array([WIDTH, HEIGHT]) / FOCAL, z])
    bow = None
    if bent:
        sagitta_mm = rng.uniform(5, 30) * rng.choice([-1, 1])
        bow = Cylinder.of_sagitta(sagitta_mm, float(np.hypot(*PAPER_MM)), rng.uniform(0, 180))
    x, y = np.meshgrid(*((np.arange(FINER * side) + 0.5) / FINER - 0.5 for side in (WIDTH, HEIGHT)))
    rays = np.stack([(x - K[0, 2]) / FOCAL, (y - K[1, 2]) / FOCAL, np.ones_like(x)], axis=-1) @ R
    origin = -R.T @ t
    return View(R, t, bow, flat_places(origin, rays) if bow is None else bent_places(origin, rays, bow))


def flat_places(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    with np.errstate(all="ignore"):
        reach = -origin[2] / rays[..., 2]
    return np.where((reach > 0)[..., None], origin[:2] + reach[..., None] * rays[..., :2], np.nan)


def bent_places(origin: np.ndarray, rays: np.ndarray, bow: Cylinder) -> np.ndarray:
    """Intersect rays with the cylinder ``s² + (z - R)² = R²``, and unroll it; the first hit of the sheet counts."""
    axis, R = np.radians(bow.axis_deg), bow.radius_mm
    along, across = np.array([np.cos(axis), np.sin(axis)]), np.array([-np.sin(axis), np.cos(axis)])
    s0, z0, s1, z1 = origin[:2] @ across, origin[2] - R, rays[..., :2] @ across, rays[..., 2]
    a, b, c = s1 * s1 + z1 * z1, s0 * s1 + z0 * z1, s0 * s0 + z0 * z0 - R * R
    found = np.full((*rays.shape[:2], 2), np.nan)
    with np.errstate(all="ignore"):
        root = np.sqrt(b * b - a * c)
        for reach in ((-b + root) / a, (-b - root) / a):  # the nearer one last
            s = R * np.arctan2((s0 + reach * s1) * np.sign(R), -(z0 + reach * z1) * np.sign(R))
            place = (origin[:2] @ along + reach * (rays[..., :2] @ along))[..., None] * along + s[..., None] * across
            is_hit = (reach > 0) & (np.abs(place) <= np.divide(PAPER_MM, 2)).all(axis=-1)
            found = np.where(is_hit[..., None], place, found)
    return found


def random_covers(rng: np.random.Generator, share: float) -> np.ndarray:
    """Return a mask of the sheet, 1 px per mm, whose bars cover a share of the area of the boards."""
    mask = np.zeros([round(side) for side in PAPER_MM[::-1]], np.uint8)
    low = np.rint((np.array(PAPER_MM) - AREA_MM) / 2).astype(int)
    area = mask[low[1] : low[1] + round(AREA_MM[1]), low[0] : low[0] + round(AREA_MM[0])]
    while area.mean() < share:
        before, angle, length = mask.copy(), rng.uniform(0, np.pi), rng.uniform(20, 120)
        middle, away = rng.uniform(0, PAPER_MM), length / 2 * np.array([np.cos(angle), np.sin(angle)])
        ends = [tuple(np.rint(p).astype(int).tolist()) for p in (middle - away, middle + away)]
        cv2.line(mask, *ends, 1, thickness=int(rng.integers(15, 30)))
        if area.mean() > share + 0.03:
            mask[:] = before
    return mask


def sample(picture: np.ndarray, on_sheet: np.ndarray, px_per_mm: float, interpolation: int) -> np.ndarray:
    at = ((on_sheet + np.divide(PAPER_MM, 2)) * px_per_mm - 0.5).astype(np.float32)
    at[np.isnan(at)] = -1e6
    return cv2.remap(
        picture,
        at[..., 0],
        at[..., 1],
        interpolation,
        None,
        cv2.BORDER_REPLICATE if interpolation else cv2.BORDER_CONSTANT,
    )


def draw(
    target: Target, view: View, around: np.ndarray, is_covered: np.ndarray, inks: tuple[float, float]
) -> np.ndarray:
    """Return the linear light of a scene, float32 (HEIGHT, WIDTH), from what is around the sheet and on top of it."""
    scale = FINER * FOCAL / view.t[2]  # samples per mm
    small = cv2.resize(target.sheet, None, fx=scale / DPI * 25.4, fy=scale / DPI * 25.4, interpolation=cv2.INTER_AREA)
    black, white = inks
    inked = np.rint(small / 255.0 * (white - black) + black).astype(np.uint8)
    levels = np.where(is_covered, around, sample(inked, view.on_sheet, small.shape[1] / PAPER_MM[0], cv2.INTER_LINEAR))
    return cv2.resize(scene_light(levels), (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


def surround(
    view: View, background: np.ndarray, cover: np.ndarray, covers: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return what lies around the sheet and on top of it, uint8, and where it hides the sheet."""
    size = (FINER * WIDTH, FINER * HEIGHT)
    behind, above = (cv2.resize(photo, size, interpolation=cv2.INTER_LINEAR) for photo in (background, cover))
    is_above = sample(covers, view.on_sheet, 1.0, cv2.INTER_NEAREST) > 0
    is_paper = (np.abs(view.on_sheet) <= np.divide(PAPER_MM, 2)).all(axis=-1)
    return np.where(is_above, above, behind), is_above | ~is_paper


def take(light: np.ndarray, seed: list[int], camera: CameraPreset, worn: bool) -> np.ndarray:
    rng = np.random.default_rng(seed)
    record = camera.draw(rng)
    if worn:
        light = cv2.GaussianBlur(light, (0, 0), rng.uniform(1.0, 2.5))
    image = photograph(light, rng, record)
    if worn:
        noisy = image + rng.normal(0, rng.uniform(5, 20), image.shape)
        image = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    return image


def judge(target: Target, view: View, image: np.ndarray) -> list[float]:
    """Return points right, wrong identities, whether the pose is good, and its errors: degrees, and mm per m."""
    index, xy = target.find(image)
    known = index < len(target.points_mm)
    true = view.project(target.points_mm)
    right = np.zeros(len(index), bool)
    right[known] = np.hypot(*(xy[known] - true[index[known]]).T) <= RIGHT_PX
    result = [float(right.sum()), float((~right).sum())]
    index, xy = index[known], xy[known]
    if len(index) < 4:
        return [*result, 0.0, np.nan, np.nan]
    fitting = cv2.findHomography(target.points_mm[index, :2], xy, cv2.RANSAC, RIGHT_PX)[1].ravel() > 0
    if fitting.sum() < 4:
        return [*result, 0.0, np.nan, np.nan]
    points, xy = target.points_mm[index][fitting], xy[fitting]
    _, turns, shifts, _ = cv2.solvePnPGeneric(points, xy, K, None, flags=cv2.SOLVEPNP_IPPE)  # the best one first
    if not turns:
        return [*result, 0.0, np.nan, np.nan]
    turn, shift = cv2.solvePnPRefineLM(points, xy, K, None, turns[0], shifts[0])
    angle = np.degrees(np.linalg.norm(cv2.Rodrigues(cv2.Rodrigues(turn)[0] @ view.R.T)[0]))
    errors = float(angle), float(1e3 * np.linalg.norm(shift.ravel() - view.t) / view.t[2])
    return [*result, float(all(e <= most for e, most in zip(errors, GOOD_POSE, strict=True))), *errors]


def photo(rng: np.random.Generator, photos: list[Path]) -> np.ndarray:
    while True:
        image = cv2.imread(str(photos[rng.integers(len(photos))]), cv2.IMREAD_GRAYSCALE)
        if image is not None:
            return image


def run(args: argparse.Namespace) -> None:
    photos, camera = sorted(p for p in args.backgrounds.rglob("*") if p.is_file()), load_camera_preset("industrial")
    makers = {"field": make_field, "ChArUco": make_charuco, "AprilGrid": make_aprilgrid}
    targets = {name: make() for name, make in makers.items() if name == "field" or not args.bent}
    print(
        "| scenes | covered | board | points | right per image | wrong identities | good poses | rotation, ° | mm/m |"
    )
    print("|" + "---|" * 9)
    for worn in (False, True):
        for covered in (0.0,) if args.bent else args.covered or COVERED:
            results: dict[str, list[list[float]]] = {name: [] for name in targets}
            for n in range(args.scenes):
                rng = np.random.default_rng([args.seed, n])
                view, covers = random_view(rng, args.bent), random_covers(rng, covered)
                around = surround(view, photo(rng, photos), photo(rng, photos), covers)
                inks = rng.uniform(20, 80), rng.uniform(150, 230)
                for name, target in targets.items():
                    light = draw(target, view, *around, inks)
                    image = take(light, [args.seed, n, 1], camera, worn)
                    results[name].append(judge(target, view, image))
                    if args.pictures and n < 6:
                        kind = f"{'worn' if worn else 'clear'}-{covered:.0%}"
                        cv2.imwrite(str(args.pictures / f"{kind}-{n}-{name}.png"), image)
            for name, rows in results.items():
                table = np.array(rows)
                angle, place = (np.nanmedian(c) if np.isfinite(c).any() else np.nan for c in table[:, 3:].T)
                print(
                    f"| {'worn' if worn else 'clear'} | {covered:.0%} | {name} | {len(targets[name].points_mm)} | "
                    f"{table[:, 0].mean():.1f} | {table[:, 1].sum():.0f} | {table[:, 2].sum():.0f} of {args.scenes} | "
                    f"{angle:.2f} | {place:.1f} |",
                    flush=True,
                )


def draw_figure(page: Path) -> None:
    """Write the figure of a page with the table: points right per image over the covered share."""
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.read_text().splitlines()]
    rows = [row for row in cells if row and row[0] in ("clear", "worn") and row[1].endswith("%") and len(row) == 9]
    series = []
    for kind, dashed in (("clear", False), ("worn", True)):
        for style, name in enumerate(dict.fromkeys(row[2] for row in rows)):
            points = [(float(row[1][:-1]), float(row[4])) for row in rows if row[0] == kind and row[2] == name]
            x, y = zip(*sorted(points), strict=True)
            series.append(Series(f"{name}, {kind}", x, y, style=style, dashed=dashed))
    chart = re.sub(r"^<svg[^>]*>|</svg>$", "", line_chart(series, "covered, %", "points right per image"))
    legend = "".join(
        f'<g class="chart"><line class="s{s.style}{" dashed" if s.dashed else ""}" x1="490" x2="520" '
        f'y1="{30 + 22 * n}" y2="{30 + 22 * n}" stroke-width="2"/><text x="528" y="{34 + 22 * n}">{s.name}</text></g>'
        for n, s in enumerate(series)
    )
    head = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 660 300" width="660" height="300">'
    own = "svg{font:12px system-ui,sans-serif;color:#222}@media (prefers-color-scheme:dark){svg{color:#ddd}}"
    parts = f'{head}<style>{own}{CHART_STYLE}</style><g class="chart">{chart}</g>{legend}</svg>\n'
    page.with_suffix(".svg").write_text(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backgrounds", type=Path, help="Folder of photographs.")
    parser.add_argument("--figure-of", type=Path, help="Page with the table; write the figure beside it, and stop.")
    parser.add_argument("--scenes", type=int, default=20, help="Scenes per rung.")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--covered", type=float, nargs="+", help="Shares of the area that are covered.")
    parser.add_argument("--bent", action="store_true", help="Show the field alone, on bent sheets.")
    parser.add_argument("--pictures", type=Path, help="Folder for the images of the first six scenes of each rung.")
    args = parser.parse_args()
    if args.pictures:
        args.pictures.mkdir(parents=True, exist_ok=True)
    if args.figure_of:
        draw_figure(args.figure_of)
    elif args.backgrounds is None:
        parser.error("expected --backgrounds")
    else:
        run(args)


if __name__ == "__main__":
    main()
