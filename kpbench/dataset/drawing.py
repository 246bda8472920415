"""Pictures for people: images with true keypoints and detections drawn on them, and contact sheets."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from kpbench.types import Detections, Float, UInt8

PATCH_COLOURS = ((230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (213, 94, 0), (204, 121, 167))
"""RGB colours of the patch IDs, distinct to colour-blind eyes (Okabe and Ito, *Color universal design*, 2008)."""
NO_ID_COLOUR = (255, 70, 70)
"""RGB colour of a detection without an ID."""
OUTERMOST_PX = 1e6
"""Largest coordinate that is drawn, px. Larger values can overflow: OpenCV has 32 bits for a coordinate in 1/16 px."""
UNKNOWN_RADIUS_PX = 9.0
"""Radius of the ring around a detection without an affine frame, px."""
TRUE_RADII = 0.1
"""Largest distance of a detection from the keypoint that it explains, in semi-major axes."""
SHARPEST_PX = 1600
"""Images are enlarged by a whole number for drawing, as long as no side becomes longer, px."""
LARGEST_SCALE = 4
"""Largest enlargement of an image for drawing."""


@dataclass(frozen=True)
class _Mark:
    """A patch in a picture. ``A`` maps its unit disc to px; ``texts`` are its labels, the longest first."""

    x: float
    y: float
    A: Float
    colour: tuple[int, int, int]
    texts: tuple[str, ...]
    dashed: bool = False
    turn: bool = False

    @property
    def half_size(self) -> tuple[float, float]:
        """Half the width and height of the ellipse, px."""
        return float(np.hypot(*self.A[0])), float(np.hypot(*self.A[1]))


def enlarge_for_drawing(image: UInt8) -> int:
    """Return by how much an image is enlarged for drawing, so that marks do not hide small patches.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.dataset import enlarge_for_drawing
    >>> [enlarge_for_drawing(np.zeros(size, np.uint8)) for size in ((480, 640), (1240, 1624))]
    [2, 1]
    """
    return int(np.clip(SHARPEST_PX // max(image.shape[:2]), 1, LARGEST_SCALE))


def draw_keypoints(
    image: UInt8,
    keypoints: NDArray[Any],
    scale: float = 1.0,
    names: Mapping[int, str] | None = None,
    labels: bool = True,
) -> UInt8:
    """Draw the ellipse and the ID of every true keypoint on a scaled copy of an image.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
        Grey or RGB; not changed.
    keypoints : ndarray of shape (n,), KEYPOINT_DTYPE
    scale : float
        Pixels of the result per pixel of the image.
    names : mapping of int to str, optional
        Name of each patch ID, for the labels.
    labels : bool
        Whether to write the ID beside each patch, where there is room.

    Returns
    -------
    ndarray of shape (H * scale, W * scale, 3), uint8
        RGB.

    Examples
    --------
    >>> from kpbench import open_dataset
    >>> from kpbench.dataset import draw_keypoints
    >>> draw_keypoints(*open_dataset("kpbench-data")[0], scale=0.5).shape
    (240, 320, 3)
    """
    canvas = _enlarge(image, scale)
    ids = [k["patch_id"] for k in keypoints]
    texts = [(_name_id(patch_id, names), str(patch_id)) if labels else () for patch_id in ids]
    marks = [_mark_of_keypoint(k, text, False) for k, text in zip(keypoints, texts, strict=True)]
    return _draw_marks(canvas, marks, scale)


def draw_detections(
    image: UInt8,
    detections: Detections,
    names: Mapping[int, str] | None = None,
    truth: NDArray[Any] | None = None,
    scale: int = 1,
    labels: bool = True,
    draw_below: Callable[[UInt8], None] | None = None,
) -> UInt8:
    """Draw the ellipse, the ID and the score of every detection on a copy of an image.

    A short line outside of an ellipse shows how the patch is turned. With ``truth``, each label also tells the distance
    from the true keypoint, or that there is none; a keypoint that no detection explains gets a dashed ellipse.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
        Grey or RGB; not changed.
    detections : Detections
        Without affine frames, the ellipses are circles of 9 px.
    names : mapping of int to str, optional
        Name of each patch ID, for the labels.
    truth : ndarray of shape (n,), KEYPOINT_DTYPE, optional
        The true keypoints of the image. A detection explains a keypoint within a tenth of its semi-major axis.
    scale : int
        Pixels of the result per pixel of the image, see :func:`enlarge_for_drawing`.
    labels : bool
        Whether to write the labels.
    draw_below : callable, optional
        Draws more into the picture, RGB, before the detections are drawn: such as a board.

    Returns
    -------
    ndarray of shape (H * scale, W * scale, 3), uint8
        RGB.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench import Detections
    >>> from kpbench.dataset import draw_detections
    >>> draw_detections(np.zeros((48, 64), np.uint8), Detections([[20, 30]], [0.9], [2]), {2: "wheel"}).shape
    (48, 64, 3)
    """
    canvas, marks = _enlarge(image, scale), list[_Mark]()
    if draw_below is not None:
        draw_below(canvas)
    errors_px, missed = ([""] * len(detections), []) if truth is None else _compare(detections, truth)
    for n, (x, y) in enumerate(detections.xy.tolist()):
        if abs(x) > OUTERMOST_PX or abs(y) > OUTERMOST_PX:
            continue
        patch_id = None if detections.patch_id is None else int(detections.patch_id[n])
        colour = NO_ID_COLOUR if patch_id is None else PATCH_COLOURS[patch_id % len(PATCH_COLOURS)]
        known = detections.A_patch2image is not None
        A = detections.A_patch2image[n] if known else UNKNOWN_RADIUS_PX / scale * np.eye(2)  # type: ignore[index]
        short = "" if patch_id is None else str(patch_id)
        long = " ".join(filter(None, (_name_id(patch_id, names), f"{detections.score[n]:.2f}", errors_px[n])))
        texts = tuple(filter(None, (long, short))) if labels else ()
        marks.append(_Mark(x, y, A, colour, texts, turn=known))
    for k in missed:
        marks.append(_mark_of_keypoint(k, (f"missed {_name_id(k['patch_id'], names)}", "missed"), True))
    return _draw_marks(canvas, marks, scale)


def _name_id(patch_id: Any, names: Mapping[int, str] | None) -> str:
    """Return an ID and its name, such as ``1 trefoil``; "" for no ID."""
    name = "" if names is None or patch_id is None else names.get(int(patch_id), "")
    return " ".join(filter(None, ("" if patch_id is None else str(patch_id), name)))


def _mark_of_keypoint(keypoint: Any, texts: tuple[str, ...], dashed: bool) -> _Mark:
    angle = np.radians(float(keypoint["axis_angle"]))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    A = turn * [float(keypoint["radius_major"]), float(keypoint["radius_minor"])]
    colour = PATCH_COLOURS[int(keypoint["patch_id"]) % len(PATCH_COLOURS)]
    return _Mark(float(keypoint["x"]), float(keypoint["y"]), A, colour, texts, dashed)


def _compare(detections: Detections, truth: NDArray[Any]) -> tuple[list[str], list[Any]]:
    """Return for each detection its error as text, or "false"; and the keypoints that no detection explains."""
    texts, missed = ["false"] * len(detections), []
    for k in truth:
        distance = np.hypot(*(detections.xy - (k["x"], k["y"])).T)
        explained = np.flatnonzero(distance <= TRUE_RADII * k["radius_major"])
        for n in explained:
            texts[n] = f"off by {distance[n]:.3f} px"
        if not len(explained):
            missed.append(k)
    return texts, missed


def _enlarge(image: UInt8, scale: float) -> UInt8:
    """Return a scaled copy of an image as RGB."""
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST
    canvas = image.copy() if scale == 1 else cv2.resize(image, None, fx=scale, fy=scale, interpolation=interpolation)
    return np.asarray(cv2.cvtColor(canvas, cv2.COLOR_GRAY2RGB) if canvas.ndim == 2 else canvas, np.uint8)


def _draw_marks(canvas: UInt8, marks: Sequence[_Mark], scale: float) -> UInt8:
    """Draw the ellipses, then the labels. ``scale`` : px of the canvas per px of the marks."""
    # scaling keeps the corner of the image in place, half a pixel left of and above the centre of pixel (0, 0)
    placed = [
        _Mark((m.x + 0.5) * scale - 0.5, (m.y + 0.5) * scale - 0.5, m.A * scale, m.colour, m.texts, m.dashed, m.turn)
        for m in marks
    ]
    unit = max(1, round(max(canvas.shape) / 800))
    for mark in placed:
        _draw_ellipse(canvas, mark, unit)
    return _draw_labels(canvas, placed, unit)


def _draw_ellipse(canvas: UInt8, mark: _Mark, unit: int) -> None:
    """Draw an ellipse around a patch, and within a large patch a cross that leaves its centre free."""
    U, (major, minor), _ = np.linalg.svd(mark.A)
    width = round(float(np.clip(minor / 8, min(unit, 2), 1 + unit)))
    away = 3 + width / 2  # the dark outline begins just outside of the patch
    size = _sixteenths(min(major + away, OUTERMOST_PX), min(minor + away, OUTERMOST_PX))
    angle_deg = float(np.degrees(np.arctan2(U[1, 0], U[0, 0])))
    centre = _sixteenths(mark.x, mark.y)
    arcs = [(a, a + 20) for a in range(0, 360, 40)] if mark.dashed else [(0, 360)]
    arm = min(0.3 * minor, 12.0 * unit) if minor >= 10 * unit else 0.0
    cross = [((arm / 3 * dx, arm / 3 * dy), (arm * dx, arm * dy)) for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    lines = [(*ends, 1 + unit // 3) for ends in cross] if arm and not mark.dashed else []
    length = float(np.hypot(*mark.A[:, 0]))
    if mark.turn and length > 0:
        start, end = 1 + away / length, 1 + (away + float(np.clip(0.25 * minor, 4, 12)) * unit) / length
        lines.append((tuple(start * mark.A[:, 0]), tuple(end * mark.A[:, 0]), width))
    for colour, more in (((0, 0, 0), 2), (mark.colour, 0)):  # first a dark outline
        for first, last in arcs:
            cv2.ellipse(canvas, centre, size, angle_deg, first, last, colour, width + more, cv2.LINE_AA, 4)
        for (x0, y0), (x1, y1), thickness in lines:
            ends = _sixteenths(mark.x + x0, mark.y + y0), _sixteenths(mark.x + x1, mark.y + y1)
            cv2.line(canvas, *ends, colour, thickness + more, cv2.LINE_AA, 4)


def _sixteenths(*lengths_px: float) -> tuple[int, ...]:
    """Convert px to 1/16 px, the unit of OpenCV's drawing functions."""
    return tuple(round(length * 16) for length in lengths_px)


def _draw_labels(canvas: UInt8, marks: Sequence[_Mark], unit: int) -> UInt8:
    """Write each label beside its patch, where it covers no other patch and no other label, or not at all."""
    if not marks:
        return canvas
    picture = Image.fromarray(canvas)
    pen = ImageDraw.Draw(picture)
    size_px = max(11.0, max(canvas.shape) / 75)
    font = ImageFont.load_default(size_px)
    halves = np.array([mark.half_size for mark in marks])
    centres = np.array([(mark.x, mark.y) for mark in marks])
    taken = np.hstack([centres - halves - 3 * unit, centres + halves + 3 * unit])
    for n, mark in enumerate(marks):
        for box, text in _places(mark, halves[n] + 4 * unit, font, size_px):
            inside = min(box[:2]) >= 0 and box[2] <= canvas.shape[1] and box[3] <= canvas.shape[0]
            left, top, right, bottom = np.delete(taken, n, axis=0).T
            apart = (left > box[2]) | (right < box[0]) | (top > box[3]) | (bottom < box[1])
            if inside and apart.all():
                pen.rectangle(box, (0, 0, 0))
                pen.text((box[0] + 0.25 * size_px, box[3] - 0.35 * size_px), text, mark.colour, font, "ls")
                taken = np.vstack([taken, box])
                break
    return np.array(picture, np.uint8)


def _places(mark: _Mark, half_size: Float, font: Any, size_px: float) -> Iterator[tuple[tuple[float, ...], str]]:
    """Yield boxes (left, top, right, bottom) for the labels of a mark, with their texts, the best first."""
    (ex, ey), (x, y) = half_size, (mark.x, mark.y)
    for text in mark.texts:
        width, height = font.getlength(text) + 0.5 * size_px, 1.3 * size_px
        above, middle, below = y - 0.7 * ey - height, y - height / 2, y + 0.7 * ey
        corners = [(x + ex, middle), (x + 0.7 * ex, above), (x + 0.7 * ex, below), (x - width / 2, y - ey - height)]
        corners += [(x - width / 2, y + ey), (x - ex - width, middle), (x - 0.7 * ex - width, above)]
        corners += [(x - 0.7 * ex - width, below)]
        if min(ex, ey) > 4 * height:  # within a patch that fills the picture
            corners.append((x - width / 2, y + 0.4 * ey))
        yield from (((left, top, left + width, top + height), text) for left, top in corners)


def contact_sheet(tiles: Sequence[UInt8], columns: int, gap_px: int = 4, titles: Sequence[str] = ()) -> UInt8:
    """Arrange tiles in rows on a white sheet. Each cell of the sheet has the size of the largest tile.

    Parameters
    ----------
    tiles : sequence of ndarray of shape (H, W, 3), uint8
        RGB. A tile of no pixels leaves its cell white.
    columns : int
        Tiles per row.
    gap_px : int
        Width of the white gaps.
    titles : sequence of str
        A line of text above each tile; empty for none.

    Returns
    -------
    ndarray of shape (H_sheet, W_sheet, 3), uint8
        RGB.
    """
    height, width = (max(tile.shape[axis] for tile in tiles) for axis in (0, 1))
    size_px = max(11.0, width / 22) if titles else 0.0
    step_y, step_x = height + gap_px + round(1.6 * size_px), width + gap_px
    rows = -(-len(tiles) // columns)
    picture = Image.new("RGB", (columns * step_x + gap_px, rows * step_y + gap_px), "white")
    pen = ImageDraw.Draw(picture)
    for n, tile in enumerate(tiles):
        x, y = gap_px + n % columns * step_x, gap_px + n // columns * step_y + round(1.6 * size_px)
        if tile.size:
            picture.paste(Image.fromarray(tile), (x, y))
        if titles:
            pen.text((x, y - 0.3 * size_px), titles[n], (0, 0, 0), ImageFont.load_default(size_px), "ls")
    return np.array(picture, np.uint8)
