"""Motion during the exposure, and the rolling shutter.

Time is measured in exposures. Row y of the image is exposed from ``t - 0.5`` to ``t + 0.5`` with
``t = start + y * row_time``. A global shutter has ``start = row_time = 0``. The given pose is the pose at time 0.

A *moving map* takes points of shape (N, 2) and their times, shape (N,), and returns the image points, shape (N, 2), px.
With a rolling shutter, a point appears at the row y where its image at the time of row y lies. This is one equation in
y per point. The time grows continuously with y, also within a row. A sensor exposes all of a row at once; its edges lie
elsewhere by at most half of the shift per row, and motion blur averages this difference to zero.

Truth is the pose at the middle of the exposure of the row on which the centre falls.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kpbench.camera.paper import Bow
from kpbench.errors import DataError
from kpbench.geometry.camera import Camera
from kpbench.geometry.coverage import Box, bounding_box, rasterise_edges
from kpbench.geometry.homography import project
from kpbench.geometry.warp import (
    TOLERANCE_PX,
    PointMap,
    bend_homography,
    join_polygons,
    linearise,
    remember_last,
    subdivide,
)
from kpbench.portable import cos_sin, exp, matmul
from kpbench.types import Float

MovingMap = Callable[[Float, Float], Float]
"""A map from points (N, 2) and times (N,), in exposures, to image points (N, 2), px."""
NODES = 0.5 * np.array([-0.9510565162951535, -0.5877852522924731, 0.0, 0.5877852522924731, 0.9510565162951535])
"""Chebyshev nodes of the exposure. The path of each point is the polynomial of degree 4 through its places at these
times. For a turn by 20 degrees per exposure, its error is below 1e-6 of the distance from the axis; for a turn by 90
degrees, it is below 2e-4."""
SUB_EXPOSURES_PER_PX = 2.0
"""Number of instants per px of the longest path during an exposure."""
MOST_SUB_EXPOSURES = 1024
ROW_ERROR_PX = 1e-10
"""Error of the row on which a point appears, px."""
DRAWN_ROW_ERROR_PX = 1e-5
"""The same for the vertices of outlines that are drawn, px."""
STEEPEST_SLOPE = -0.05
"""Where an image moves along the columns at more than 0.95 of the speed of the rolling shutter, rows are not found."""
ROW_STEPS = 50
"""Largest number of steps to find a row. Two to five steps suffice."""


@dataclass(frozen=True)
class Shutter:
    """When each row of the image is exposed.

    Attributes
    ----------
    row_time : float
        Time from the exposure of a row to the exposure of the next row, in exposures. 0 for a global shutter. Of a
        sensor that reads a row in 20 µs and is exposed for 10 ms, it is 0.002.
    start : float
        Time at the middle of the exposure of row 0, in exposures.

    Examples
    --------
    >>> from kpbench.camera.shutter import Shutter
    >>> Shutter.rolling(row_time=0.002, height_px=481).time(240.0)
    0.0
    """

    row_time: float = 0.0
    start: float = 0.0

    @classmethod
    def rolling(cls, row_time: float, height_px: int) -> Shutter:
        """Make a rolling shutter whose time 0 is the middle of the exposure of the image's middle row."""
        return cls(row_time, -row_time * (height_px - 1) / 2)

    def time(self, y: float) -> float:
        """Return the time at the middle of the exposure of row y, in exposures."""
        return self.start + self.row_time * y

    def expose(
        self, moving_map: MovingMap, points: Float, instants: ArrayLike = 0.0, error_px: float = ROW_ERROR_PX
    ) -> Float:
        """Return where points appear in the image.

        The row of each point solves ``y = Y(point, time(y) + instant)``. The method is the secant method, starting from
        row 0 and one step of the fixed-point iteration.

        Parameters
        ----------
        moving_map : callable
        points : ndarray of shape (N, 2)
        instants : float or ndarray of shape (N,)
            Instants within the exposure, from -0.5 to 0.5.
        error_px : float
            Largest error of the row, px.

        Returns
        -------
        ndarray of shape (N, 2)
            Image points, px.

        Raises
        ------
        DataError
            If the rows of some points are not found, because the image moves as fast as the shutter.
        """
        instant = np.broadcast_to(np.asarray(instants, np.float64), (len(points),))
        image = moving_map(points, instant + self.start)
        if self.row_time == 0:
            return image
        y0, error0 = np.zeros(len(points)), image[:, 1]
        y = image[:, 1]
        for _ in range(ROW_STEPS):
            image = moving_map(points, instant + self.start + self.row_time * y)
            error = image[:, 1] - y
            moves = np.abs(error) > error_px
            if not moves.any():
                return image
            slope = np.divide(error - error0, y - y0, out=np.full(len(y), -1.0), where=moves & (y != y0))
            step = np.where(moves, -error / np.minimum(slope, STEEPEST_SLOPE), 0.0)  # settled points rest
            y0, error0, y = np.where(moves, y, y0), np.where(moves, error, error0), y + step
        raise DataError(f"{moves.sum()} points move along the image's columns as fast as the rolling shutter")


@dataclass(frozen=True)
class PatchMotion:
    """Motion of a single patch in the image plane.

    Attributes
    ----------
    velocity_px : (float, float)
        Shift of the patch to the right and downwards, px per exposure.
    turn_deg : float
        Rotation about the patch's centre from +x towards +y, degrees per exposure.
    growth : float
        Logarithm of the factor by which the patch grows about its centre per exposure.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.camera.shutter import PatchMotion
    >>> H_patch2image = np.array([[20.0, 0, 50], [0, 20, 40], [0, 0, 1]])
    >>> move = PatchMotion(velocity_px=(6.0, 0.0)).of_patch(H_patch2image)
    >>> move(np.zeros((2, 2)), np.array([-0.5, 0.5])).tolist()
    [[47.0, 40.0], [53.0, 40.0]]
    """

    velocity_px: tuple[float, float] = (0.0, 0.0)
    turn_deg: float = 0.0
    growth: float = 0.0

    def of_patch(self, H_patch2image: Float, warp: PointMap | None = None) -> MovingMap:
        """Return the moving map from the patch's unit disc to px.

        Parameters
        ----------
        H_patch2image : ndarray of shape (3, 3)
            The pose at time 0.
        warp : callable, optional
            Map from px to px that follows the motion, such as the distortion of the lens.
        """
        centre = H_patch2image[:2, 2] / H_patch2image[2, 2]
        offsets = remember_last(lambda points: project(H_patch2image, points) - centre)

        def move(points: Float, times: Float) -> Float:
            x, y = offsets(points).T
            if self.turn_deg or self.growth:
                c, s = cos_sin(np.radians(self.turn_deg) * times)
                if self.growth:
                    scale = exp(self.growth * times)
                    c, s = scale * c, scale * s
                x, y = c * x - s * y, s * x + c * y
            vx, vy = self.velocity_px
            moved = np.array([centre[0] + x + vx * times, centre[1] + y + vy * times]).T
            return moved if warp is None else warp(moved)

        return move


@dataclass(frozen=True)
class BoardMotion:
    """Motion of a board in front of a camera, with constant velocities in the camera frame.

    At time t, the board's pose is ``R(t) = exp(t [w]) R``, with the matrix [w] of the cross product, and
    ``t_camera(t) = t_camera + t v``. The board turns about its own centre.

    Attributes
    ----------
    velocity_mm : (float, float, float)
        Velocity v of the board's centre in the camera frame, mm per exposure.
    turn_deg : (float, float, float)
        Angular velocity w in the camera frame, degrees per exposure.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.camera.shutter import BoardMotion
    >>> from kpbench.geometry import Camera
    >>> camera = Camera(640, 480, 500.0)
    >>> move = BoardMotion(velocity_mm=(4.0, 0.0, 0.0)).of_board(camera, np.eye(3), np.array([0.0, 0.0, 500.0]))
    >>> move(np.zeros((2, 2)), np.array([-0.5, 0.5])).tolist()
    [[317.5, 239.5], [321.5, 239.5]]
    """

    velocity_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def of_board(self, camera: Camera, R_board2camera: Float, t_camera: ArrayLike, bow: Bow | None = None) -> MovingMap:
        """Return the moving map from points (x, y) of the flat board, mm, to px, through bow, motion and lens.

        Parameters
        ----------
        camera : Camera
        R_board2camera : ndarray of shape (3, 3)
            Rotation at time 0.
        t_camera : array_like of shape (3,)
            The board's centre in the camera frame at time 0, mm.
        bow : Cylinder or Saddle, optional
            None: the board is flat.
        """
        place, rate = np.asarray(t_camera, np.float64), np.radians(self.turn_deg)
        speed = float(np.sqrt((rate * rate).sum()))
        axis = rate / speed if speed else rate

        def turn(points: Float) -> Float:
            if bow is None:
                return matmul(points, R_board2camera[:, :2].T)
            return matmul(bow.bend(points), R_board2camera.T)

        turned_once = remember_last(turn)

        def move(points: Float, times: Float) -> Float:
            turned = turned_once(points)
            if speed:
                turned = _turn(turned, axis, speed * times)
            return camera.project(turned + place + times[:, None] * np.array(self.velocity_mm))

        return move


def _turn(points: Float, axis: Float, angle_rad: Float) -> Float:
    """Turn points of shape (N, 3) about a unit axis through the origin, by Rodrigues' formula."""
    c, s = (value[:, None] for value in cos_sin(angle_rad))
    (x, y, z), (a, b, d) = points.T, axis
    cross = np.column_stack([b * z - d * y, d * x - a * z, a * y - b * x])
    along = (a * x + b * y + d * z)[:, None]
    return np.asarray(points * c + cross * s + axis * along * (1 - c))


def sub_exposures(moving_map: MovingMap, points: Float, shutter: Shutter) -> Float:
    """Return the instants whose mean is the exposure: at least two per px of the longest path, equally spaced.

    Parameters
    ----------
    moving_map : callable
    points : ndarray of shape (N, 2)
        Points that reach as far as what moves, such as the vertices of its outline.
    shutter : Shutter

    Returns
    -------
    ndarray of shape (K,)
        From more than -0.5 to less than 0.5, the middles of K equal parts of the exposure; ``[0.0]`` without motion.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.camera.shutter import PatchMotion, Shutter, sub_exposures
    >>> move = PatchMotion(velocity_px=(2.0, 0.0)).of_patch(np.diag([20.0, 20.0, 1.0]))
    >>> sub_exposures(move, np.zeros((1, 2)), Shutter()).tolist()
    [-0.375, -0.125, 0.125, 0.375]
    """
    return _instants(_places_at_nodes(moving_map, points, shutter))


def _places_at_nodes(moving_map: MovingMap, points: Float, shutter: Shutter) -> Float:
    """Return the image points, shape (5, N, 2), of points at ``NODES``."""
    times = np.repeat(NODES, len(points))
    return shutter.expose(moving_map, np.tile(points, (5, 1)), times, DRAWN_ROW_ERROR_PX).reshape(5, -1, 2)


def _instants(places: Float) -> Float:
    """Return the instants for image points at ``NODES``, shape (5, N, 2)."""
    step = np.diff(places, axis=0)
    between = float(np.sqrt((step * step).sum(axis=2)).sum(axis=0).max(initial=0.0))
    path_px = between / (NODES[-1] - NODES[0])
    # rounding must not add an instant to a path of a whole number of half px
    count = min(max(1, int(np.ceil(SUB_EXPOSURES_PER_PX * path_px - 1e-4))), MOST_SUB_EXPOSURES)
    return (np.arange(count) + 0.5) / count - 0.5


def _interpolate(places: Float, instants: Float) -> Float:
    """Return places at instants, shape (K, N, 2), from places at ``NODES``, by Lagrange's formula."""
    weights = np.ones((len(instants), 5))
    for i, j in itertools.permutations(range(5), 2):
        weights[:, i] *= (instants - NODES[j]) / (NODES[i] - NODES[j])
    return matmul(weights, places.reshape(5, -1)).reshape(len(instants), *places.shape[1:])


def rasterise_moving(
    regions: Sequence[Sequence[Float]],
    moving_map: MovingMap,
    shutter: Shutter | None = None,
    *,
    same_box: bool = False,
    tolerance_px: float = TOLERANCE_PX,
) -> list[tuple[Box, Float]]:
    """Return the fraction of each pixel that regions cover, as a mean over the exposure.

    The result is the mean of the exact coverages at the instants of :func:`sub_exposures`. At each instant, each point
    lies where the shutter shows it. Straight edges are divided, so that chords follow their bent images.

    Parameters
    ----------
    regions : sequence of sequences of ndarray of shape (N, 2)
        Polygons of each region in the plane that moves. Holes run in the direction opposite to outer polygons.
    moving_map : callable
    shutter : Shutter, optional
        None: a global shutter.
    same_box : bool
        Whether all regions get the same box, which contains all of them.
    tolerance_px : float
        Largest distance between chords and bent edges.

    Returns
    -------
    list of (Box, ndarray of shape (height, width))
        Box and covered fractions of each region.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.camera.shutter import PatchMotion, rasterise_moving
    >>> square = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 1.0], [0.0, 1.0]]) - 0.5
    >>> [(box, cover)] = rasterise_moving([[square]], PatchMotion((2.0, 0.0)).of_patch(np.eye(3)))
    >>> cover.sum(axis=0).round(6).tolist()
    [0.0, 0.25, 0.75, 1.0, 1.0, 0.75, 0.25, 0.0]
    """
    shutter = shutter or Shutter()
    points, next_vertex = join_polygons([polygon for region in regions for polygon in region])
    owner = np.repeat(np.arange(len(regions)), [sum(map(len, region)) for region in regions])
    finer, following, edge = subdivide(
        points, next_vertex, lambda p: shutter.expose(moving_map, p, 0.0, DRAWN_ROW_ERROR_PX), tolerance_px
    )
    at_nodes = _places_at_nodes(moving_map, finer, shutter)
    places = _interpolate(at_nodes, _instants(at_nodes))
    count, owner = len(places), owner.take(edge)
    low, high = places.min(axis=0), places.max(axis=0)
    if same_box:
        boxes = [bounding_box([low, high])] * len(regions)
    else:
        boxes = [bounding_box([low[owner == n], high[owner == n]]) for n in range(len(regions))]
    ends = places.take(following, axis=1)
    start, end = (np.ascontiguousarray(corner.reshape(-1, 2).T) for corner in (places, ends))
    covers = rasterise_edges(start, end, np.tile(owner, count), boxes, [count] * len(boxes))
    return list(zip(boxes, covers, strict=True))


def true_homography(moving_map: MovingMap, H: Float, shutter: Shutter | None = None) -> Float:
    """Return the true pose of a patch that moves: at the middle of the exposure of its centre's row.

    The result maps the patch's centre (0, 0) to its true image. Near the centre, it equals to first order the image at
    the middle of the exposure, with the skew of the rolling shutter, bow and lens distortion included.

    Parameters
    ----------
    moving_map : callable
        From the patch's unit disc to px.
    H : ndarray of shape (3, 3)
        A homography from the unit disc to px without motion, bow and distortion. The result keeps its horizon.
    shutter : Shutter, optional
        None: a global shutter.

    Returns
    -------
    ndarray of shape (3, 3)
        H_patch2image; its last entry is 1.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.camera.shutter import PatchMotion, Shutter, true_homography
    >>> H = np.array([[20.0, 0, 50], [0, 20, 40], [0, 0, 1]])
    >>> move = PatchMotion(velocity_px=(10.0, 0.0)).of_patch(H)
    >>> true_homography(move, H, Shutter(row_time=0.01)).round(6).tolist()
    [[20.0, 2.0, 54.0], [0.0, 20.0, 40.0], [0.0, 0.0, 1.0]]
    """
    shutter = shutter or Shutter()
    image, J = linearise(lambda points: shutter.expose(moving_map, points), (0.0, 0.0))
    return bend_homography(H, (0.0, 0.0), image, J)
