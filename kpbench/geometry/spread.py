"""The parallel body of a region: the region and all points up to a distance from it, as exact lines and arcs.

The boundary of the parallel body lies on *candidates*: the segments of the region moved along their normals, and
circles about the region's corners. The algorithm:

1. Divide all candidates where they meet.
2. Keep the pieces whose middle lies outside the region and no nearer to the region than the distance.
3. Chain the pieces to contours.

A test of distances decides about each piece alone. Offsets that overlap therefore need no special case.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from kpbench.geometry.outline import Arc, Contour, Line, Region, circle, flatten
from kpbench.portable import arctan2
from kpbench.types import Float

Segment = Line | Arc
POINT_ERROR = 1e-9
"""Two points are one point if they are nearer than this, in units of the region's extent."""
LONGEST_GAP = 1e-6
"""Largest distance between the end of a piece and the start of the next piece, in units of the region's extent."""


def spread(region: Region, distance: float, within: float = math.inf) -> Region:
    """Return the Minkowski sum of a region and a disc of radius ``distance``.

    Parameters
    ----------
    region : Region
    distance : float
        If negative, the result is the erosion of the region: all points farther from the region's outside than
        ``-distance``. If 0, the result is the region.
    within : float
        Radius of a disc about the origin to which the result is cut. A distance of 0 cuts nothing.

    Returns
    -------
    Region
        Points of the result have the winding number 1.

    Raises
    ------
    ArithmeticError
        If the pieces of the boundary do not join.
    """
    parts = [part for contour in region for part in contour]
    if not parts or distance == 0:
        return region
    points = np.concatenate(flatten(region, abs(distance) / 8))
    extent = float(np.sqrt((points * points).sum(axis=1).max())) + abs(distance)
    candidates = _candidates(parts, distance)
    cut: list[Segment] = [*circle(0.0, 0.0, within)[0]] if within < extent else []
    if not candidates:
        return ()
    pieces, owner = _divide([*candidates, *cut], POINT_ERROR * extent)
    middles = np.array([_point(piece, 0.5) for piece in pieces])
    # positive outside of the result, 0 on its boundary
    depth = _signed_distance(region, parts, middles, abs(distance)) - distance
    beyond = np.sqrt((middles * middles).sum(axis=1)) - within
    near = 0.1 * POINT_ERROR * extent
    keep = np.where(owner < len(candidates), (np.abs(depth) < near) & (beyond < -near), depth < near)
    kept = [piece for piece, is_kept in zip(pieces, keep.tolist(), strict=True) if is_kept]
    return _chain(kept, LONGEST_GAP * extent)


def _candidates(parts: list[Segment], distance: float) -> list[Segment]:
    """Return curves on which the boundary of the parallel body lies, in the direction of this boundary."""
    moved: list[Segment] = []
    corners: dict[tuple[float, float], tuple[float, float]] = {}
    for part in parts:
        if isinstance(part, Line):
            dx, dy = part.x1 - part.x0, part.y1 - part.y0
            x, y = (distance / math.sqrt(dx * dx + dy * dy) * step for step in (dy, -dx))
            moved.append(Line(part.x0 + x, part.y0 + y, part.x1 + x, part.y1 + y))
        else:  # the region lies on the side of the centre if the arc runs from +x towards +y
            radius = part.radius + (distance if part.sweep_deg > 0 else -distance)
            if radius > 0:
                moved.append(Arc(part.x, part.y, radius, part.start_deg, part.sweep_deg))
        if isinstance(part, Line) or abs(part.sweep_deg) < 360:
            x, y = _point(part, 0.0)
            corners[round(x, 9), round(y, 9)] = (x, y)
    turn = math.copysign(360.0, distance)
    return [*moved, *(Arc(x, y, abs(distance), 0.0, turn) for x, y in corners.values())]


def _point(part: Segment, fraction: float) -> tuple[float, float]:
    if isinstance(part, Arc):
        return part.point(fraction)
    return part.x0 + fraction * (part.x1 - part.x0), part.y0 + fraction * (part.y1 - part.y0)


def _divide(parts: list[Segment], near: float) -> tuple[list[Segment], NDArray[np.int64]]:
    """Divide segments at their ends and where they meet. Return the pieces, and the index of each piece's segment."""
    ends = [_point(part, fraction) for part in parts for fraction in (0.0, 1.0)]
    points = np.vstack([np.array(ends), _meetings(parts, near)])
    pieces: list[Segment] = []
    owner: list[int] = []
    for n, part in enumerate(parts):
        cuts, length = _places(part, points, near)
        is_circle = isinstance(part, Arc) and abs(part.sweep_deg) == 360
        if not is_circle:
            cuts = np.concatenate([[0.0], cuts[(cuts * length > near) & ((1 - cuts) * length > near)], [1.0]])
        cuts = cuts[np.append(True, np.diff(cuts) * length > near)] if len(cuts) else cuts
        if is_circle:
            cuts = np.append(cuts, cuts[0] + 1) if len(cuts) else np.array([0.0, 1.0])
            cuts = np.delete(cuts, -2) if len(cuts) > 2 and (cuts[-1] - cuts[-2]) * length < near else cuts
        for a, b in zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True):
            if isinstance(part, Line):
                pieces.append(Line(*_point(part, a), *_point(part, b)))
            else:
                start_deg = part.start_deg + a * part.sweep_deg
                pieces.append(Arc(part.x, part.y, part.radius, start_deg, (b - a) * part.sweep_deg))
            owner.append(n)
    return pieces, np.array(owner)


def _places(part: Segment, points: Float, near: float) -> tuple[Float, float]:
    """Return, in ascending order, the fractions of a segment at which points lie on it; and the segment's length."""
    if isinstance(part, Line):
        dx, dy = part.x1 - part.x0, part.y1 - part.y0
        length = math.sqrt(dx * dx + dy * dy)
        x, y = points[:, 0] - part.x0, points[:, 1] - part.y0
        is_near = np.abs(x * dy - y * dx) < near * length
        fractions = (x[is_near] * dx + y[is_near] * dy) / (length * length)
    else:
        length = math.radians(abs(part.sweep_deg)) * part.radius
        x, y = points[:, 0] - part.x, points[:, 1] - part.y
        is_near = np.abs(np.sqrt(x * x + y * y) - part.radius) < near
        angles = np.degrees(arctan2(y[is_near], x[is_near])) - part.start_deg
        fractions = math.copysign(1.0, part.sweep_deg) * angles % 360.0 / abs(part.sweep_deg)
    return np.sort(fractions[(fractions >= 0) & (fractions <= 1)]), length


def _meetings(parts: list[Segment], near: float) -> Float:
    """Return the points, shape (N, 2), where the straight lines and the full circles of segments meet."""
    lines = np.array([(p.x0, p.y0, p.x1 - p.x0, p.y1 - p.y0) for p in parts if isinstance(p, Line)]).reshape(-1, 4)
    circles = np.array([(p.x, p.y, p.radius) for p in parts if isinstance(p, Arc)]).reshape(-1, 3)
    found = [np.zeros((0, 2))]
    i, j = np.triu_indices(len(lines), 1)
    (x, y, dx, dy), (x2, y2, dx2, dy2) = lines[i].T, lines[j].T
    cross = dx * dy2 - dy * dx2
    crosses = np.abs(cross) > 1e-12 * np.sqrt((dx * dx + dy * dy) * (dx2 * dx2 + dy2 * dy2))
    t = np.divide((x2 - x) * dy2 - (y2 - y) * dx2, cross, out=np.zeros_like(cross), where=crosses)
    found.append(np.column_stack([x + t * dx, y + t * dy])[crosses])

    i, j = (index.ravel() for index in np.indices((len(lines), len(circles))))
    (x, y, dx, dy), (cx, cy, r) = lines[i].T, circles[j].T
    length = np.sqrt(dx * dx + dy * dy)
    ex, ey = dx / length, dy / length
    along, aside = (cx - x) * ex + (cy - y) * ey, (cx - x) * ey - (cy - y) * ex
    half = _half_chord(r, aside, np.abs(np.abs(aside) - r) < near)
    for sign in (-1, 1):
        t = along + sign * half
        found.append(np.column_stack([x + t * ex, y + t * ey])[np.abs(aside) < r + near])

    i, j = np.triu_indices(len(circles), 1)
    (x, y, r), (x2, y2, r2) = circles[i].T, circles[j].T
    apart = np.sqrt((x2 - x) ** 2 + (y2 - y) ** 2)
    safe = np.maximum(apart, near)
    along, ex, ey = (apart + (r - r2) * (r + r2) / safe) / 2, (x2 - x) / safe, (y2 - y) / safe
    touches = (np.abs(apart - (r + r2)) < near) | (np.abs(apart - np.abs(r - r2)) < near)
    half = _half_chord(r, along, touches)
    meets = (apart > near) & (apart < r + r2 + near) & (apart > np.abs(r - r2) - near)
    for sign in (-1, 1):
        found.append(np.column_stack([x + along * ex - sign * half * ey, y + along * ey + sign * half * ex])[meets])
    return np.vstack(found)


def _half_chord(radius: Float, distance: Float, touches: NDArray[np.bool_]) -> Float:
    """Return half of the chord of a circle on a line at a distance from the centre; 0 if the line only touches."""
    return np.where(touches, 0.0, np.sqrt(np.maximum((radius - distance) * (radius + distance), 0.0)))


def _signed_distance(region: Region, parts: list[Segment], points: Float, distance: float) -> Float:
    """Return the distances of points from the outline of a region, negative inside the region.

    The sign of points nearer than half of ``distance`` may be wrong.
    """
    squares = np.full(len(points), np.inf)
    for part in parts:
        for end in (0.0, 1.0):
            x, y = (points - _point(part, end)).T
            squares = np.minimum(squares, x * x + y * y)
        if isinstance(part, Line):
            dx, dy = part.x1 - part.x0, part.y1 - part.y0
            square = dx * dx + dy * dy
            x, y = points[:, 0] - part.x0, points[:, 1] - part.y0
            along = x * dx + y * dy
            beside = (along > 0) & (along < square)
            aside = (x * dy - y * dx) ** 2 / square
        else:
            x, y = points[:, 0] - part.x, points[:, 1] - part.y
            angle = np.degrees(arctan2(y, x)) - part.start_deg
            beside = math.copysign(1.0, part.sweep_deg) * angle % 360.0 <= abs(part.sweep_deg)
            aside = (np.sqrt(x * x + y * y) - part.radius) ** 2
        squares = np.where(beside, np.minimum(squares, aside), squares)
    return np.asarray(np.sqrt(squares) * np.where(_is_inside(flatten(region, distance / 8), points), -1, 1))


def _is_inside(polygons: list[Float], points: Float) -> NDArray[np.bool_]:
    """Return whether the winding number of polygons about each point is not 0."""
    winding = np.zeros(len(points), np.int64)
    for polygon in polygons:
        x0, y0 = polygon.T[:, :, None]
        x1, y1 = np.roll(polygon, -1, axis=0).T[:, :, None]
        x, y = points.T
        side = (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0)
        winding += ((y0 <= y) & (y1 > y) & (side > 0)).sum(axis=0) - ((y0 > y) & (y1 <= y) & (side < 0)).sum(axis=0)
    return np.asarray(winding != 0)


def _chain(pieces: list[Segment], longest_gap: float) -> Region:
    """Join pieces to closed contours. Each piece starts where the piece before it ends."""
    left = list(range(len(pieces)))
    starts = np.array([_point(piece, 0.0) for piece in pieces]).reshape(-1, 2)
    contours: list[Contour] = []
    while left:
        chain = [left.pop(0)]
        while True:
            x, y = _point(pieces[chain[-1]], 1.0)
            choices = [chain[0], *left]
            gaps = ((starts[choices] - (x, y)) ** 2).sum(axis=1)
            nth = int(gaps.argmin())
            if gaps[nth] > longest_gap**2:
                raise ArithmeticError(f"the outline of spread ink does not close at ({x:.6g}, {y:.6g})")
            if nth == 0:
                break
            chain.append(left.pop(nth - 1))
        contours.append(_merge([pieces[n] for n in chain]))
    return tuple(contours)


def _merge(chain: list[Segment]) -> Contour:
    """Join successive arcs of one circle, and successive pieces of one straight line."""
    for _ in range(len(chain) - 1):  # rotate the chain until its first piece does not continue its last piece
        if _joined(chain[-1], chain[0]):
            chain = chain[1:] + chain[:1]
    merged = chain[:1]
    for part in chain[1:]:
        both = _joined(merged[-1], part)
        merged[-1:] = [both] if both else [merged[-1], part]
    return tuple(merged)


def _joined(before: Segment, after: Segment) -> Segment | None:
    """Return two segments as one segment; None if they are not parts of one line or circle."""
    if isinstance(before, Arc) and isinstance(after, Arc):
        same = (before.x, before.y, before.radius) == (after.x, after.y, after.radius)
        if same and before.sweep_deg * after.sweep_deg > 0:
            return Arc(before.x, before.y, before.radius, before.start_deg, before.sweep_deg + after.sweep_deg)
    if isinstance(before, Line) and isinstance(after, Line):
        dx, dy = before.x1 - before.x0, before.y1 - before.y0
        dx2, dy2 = after.x1 - after.x0, after.y1 - after.y0
        if abs(dx * dy2 - dy * dx2) < 1e-12 * (abs(dx) + abs(dy)) * (abs(dx2) + abs(dy2)):
            return Line(before.x0, before.y0, after.x1, after.y1)
    return None
