"""Designs as templates: what an image shows of them, in every rotation.

Poses are affine: ``x_px = xy + A @ u``. :mod:`kpbench.fitting` compares them with an image in three steps, each for
many candidates at once:

* :func:`rotate_within_ellipse` finds the rotation where the ellipse is known;
* :func:`align` moves a pose onto the image, by the whole design or by its innermost sectors;
* :func:`rectify` shows the image in the frame of the patch.

Where not even the ellipse is known, ``sector_search`` finds it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.patches.design import Patch
from kpbench.types import Float, Float32, Int

ANGLES = 24
_turn = np.arange(ANGLES) * (2 * np.pi / ANGLES)
_circle = np.column_stack([np.cos(_turn), np.sin(_turn)])


@dataclass(frozen=True)
class Templates:
    """D designs sampled at M points on circles.

    Attributes
    ----------
    points : (M, 2)
    ink : (D, M) zero mean, unit norm.
    solve : (D, 6, M) from a difference of templates to a step in (x, y, a11, a12, a21, a22).
    sized : (D,) whether the pattern has a size of its own, which sectors have not.
    turned : (R, M) all rotations of all inks, without those that look alike.
    turned_which, turned_angle : (R,) the design and the rotation in radians of each.
    """

    points: Float
    ink: Float32
    solve: Float32
    sized: NDArray[np.bool_]
    turned: Float32
    turned_which: Int
    turned_angle: Float


@dataclass(frozen=True)
class Bank:
    """What the coarse stages need of a set of designs.

    Attributes
    ----------
    patches : the designs.
    core : the innermost sectors, over the unit disc; they look the same at every size.
    whole : the whole design, over the unit disc.
    picture : (D, VIEW_PX²) the designs as :func:`rectify` shows them, white 1 and black -1.
    """

    patches: tuple[Patch, ...]
    core: Templates
    whole: Templates
    picture: Float32


def bank(patches: Sequence[Patch]) -> Bank:
    """Templates of some designs."""
    return _bank(tuple(patches))


@lru_cache(maxsize=8)
def _bank(patches: tuple[Patch, ...]) -> Bank:
    core = _templates(patches, (0.4, 0.7, 1.0), whole=False)
    whole = _templates(patches, (0.25, 0.45, 0.65, 0.85), whole=True)
    picture = np.array([look_up(soft_ink(patch, True), view_points()) for patch in patches], np.float32)
    return Bank(patches, core, whole, picture)


def _templates(patches: Sequence[Patch], rings: Sequence[float], whole: bool) -> Templates:
    points = np.concatenate([r * _circle for r in rings])
    pairs = [_template(soft_ink(patch, whole), points) for patch in patches]
    ink, solve = (np.array(part, np.float32) for part in zip(*pairs, strict=True))
    turned, which, angle, turns = [], [], [], TURNS if whole else ANGLES
    for n, patch in enumerate(patches):
        image = soft_ink(patch, whole)
        seen: list[Float32] = []
        for turn in np.arange(turns) * (2 * np.pi / turns):
            c, s = np.cos(turn), np.sin(turn)
            grey = look_up(image, points @ np.array([[c, -s], [s, c]]))
            one = ((grey - grey.mean()) / np.linalg.norm(grey - grey.mean())).astype(np.float32)
            if all(one @ other < 0.998 for other in seen):
                seen.append(one)
                which.append(n)
                angle.append(turn)
        turned += seen
    sized = np.array([whole and len(patch.cells[0]) > 2 for patch in patches])
    return Templates(points, ink, solve, sized, np.array(turned), np.array(which, np.int64), np.array(angle))


def _template(image: Float32, points: Float) -> tuple[Float, Float]:
    """Normalised template and its Gauss-Newton solver."""
    step = 0.05
    ink = look_up(image, points)
    du, dv = ((look_up(image, points + s) - look_up(image, points - s)) / (2 * step) for s in np.eye(2) * step)
    u, v = points.T
    jacobian = np.column_stack([du, dv, du * u, du * v, dv * u, dv * v])
    ink = ink - ink.mean()
    jacobian /= np.linalg.norm(ink)
    ink /= np.linalg.norm(ink)
    jacobian -= jacobian.mean(axis=0)  # grey offset and contrast are free
    jacobian -= np.outer(ink, ink @ jacobian)
    normal = jacobian.T @ jacobian
    # stretch along two edges leaves sectors as they are: damping keeps it where it was
    return ink, np.linalg.solve(normal + np.eye(6) * 0.02 * np.trace(normal) / 6, jacobian.T)


LOOKUP_HALF, LOOKUP_SIZE = 1.7, 273
SOFT_CORE, SOFT_WHOLE = 0.2, 0.12
"""Blur of the templates, in radii of the circle: what remains after the pyramid's smoothing."""


@lru_cache(maxsize=64)
def soft_ink(patch: Patch, whole: bool) -> Float32:
    """Ink, white 1 and black -1, over [-1.7, 1.7]²: the design, or its innermost sectors without end; blurred."""
    fine = 3
    ticks = ((np.arange(LOOKUP_SIZE * fine) + 0.5) / (LOOKUP_SIZE * fine) * 2 - 1) * LOOKUP_HALF
    points = np.stack(np.meshgrid(ticks, ticks), axis=-1)
    # a point at radius r is seen at min(r, 0.999) of the design, or always near the centre
    reach = np.hypot(*np.moveaxis(points, -1, 0)) + 1e-9
    end = np.minimum(reach, 0.999) if whole else 0.5 * patch.cells[0][1]
    black = patch.is_black(points * (end / reach)[..., None])
    ink = np.where(black, -1.0, 1.0).reshape(LOOKUP_SIZE, fine, LOOKUP_SIZE, fine).mean(axis=(1, 3))
    blur = (SOFT_WHOLE if whole else SOFT_CORE) * LOOKUP_SIZE / (2 * LOOKUP_HALF)
    return np.asarray(cv2.GaussianBlur(ink.astype(np.float32), (0, 0), blur))


def look_up(image: Float32, points: Float) -> Float:
    """Ink (N,) of :func:`soft_ink` at points (N, 2)."""
    at = ((points + LOOKUP_HALF) / (2 * LOOKUP_HALF) * LOOKUP_SIZE - 0.5).astype(np.float32)
    return np.asarray(cv2.remap(image, at[:, :1], at[:, 1:], cv2.INTER_LINEAR), np.float64).ravel()


TURNS = 72
"""Rotations of the whole design that are tried: to within 2.5 degrees, where a fit can start."""


VIEW_PX = 32
"""Side of a view, which reaches from -1.7 to 1.7 in the patch frame: the disc and what surrounds it."""


@lru_cache(maxsize=1)
def view_points() -> Float:
    """Return the places of a view's pixels in the patch frame, (VIEW_PX², 2), row by row."""
    ticks = ((np.arange(VIEW_PX) + 0.5) / VIEW_PX * 2 - 1) * LOOKUP_HALF
    return np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
