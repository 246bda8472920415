"""Designs as templates: their inks at sample points, in every rotation.

An ink is a number, 1 for white and -1 for black. Two kinds of templates are compared with an image. The *core* is the
innermost sectors of a design, which look the same at every size. The *whole* is the design out to the edge of the disc.
A core is sampled within the core's circle, which may have any radius that the sectors fill.
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

CORE_ROTATIONS = 24
"""Number of rotations of the core that are tried, and number of samples on each circle of a template."""
WHOLE_ROTATIONS = 72
"""Number of rotations of the whole design that are tried: 5 degrees apart, which is close enough for a fit."""
CORE_RINGS, WHOLE_RINGS = (0.4, 0.7, 1.0), (0.25, 0.45, 0.65, 0.85)
"""Radii of the sampled circles. The unit is the radius of the core's circle for a core, and of the disc for a whole
design."""
CORE_BLUR, WHOLE_BLUR = 0.2, 0.12
"""Standard deviations of the blur of templates, in the units of the rings. They match the smoothing of the pyramid."""
SAME_NCC = 0.998
"""Two rotations of a design look the same if their templates correlate by at least this. Only the first is kept."""
VIEW_REACH = 1.7
"""Half the side of a view, in radii of the disc. A view shows the disc and the ground around the disc."""
VIEW_PX = 32
"""Side of a view, px."""
_INK_PX = 273
"""Side of an ink image, px. An ink image covers the same square as a view."""
_angles_rad = np.arange(CORE_ROTATIONS) * (2 * np.pi / CORE_ROTATIONS)
_circle = np.column_stack([np.cos(_angles_rad), np.sin(_angles_rad)])


@dataclass(frozen=True)
class Templates:
    """D designs, sampled at M points on circles.

    Attributes
    ----------
    points : ndarray of shape (M, 2)
        Sample points in the frame of the template.
    ink : ndarray of shape (D, M), float32
        Inks at the points, with zero mean and unit norm per design.
    solve : ndarray of shape (D, 6, M), float32
        Maps a residual to a Gauss-Newton step in (x, y, a11, a12, a21, a22).
    has_size : ndarray of shape (D,), bool
        Whether the template looks different at another size. False for sectors alone.
    rotated : ndarray of shape (R, M), float32
        Inks of all designs in all rotations, without rotations that look like an earlier rotation.
    rotated_design : ndarray of shape (R,), int64
        Index of the design in each row of ``rotated``.
    rotated_angle : ndarray of shape (R,)
        Rotation in each row of ``rotated``, rad.
    """

    points: Float
    ink: Float32
    solve: Float32
    has_size: NDArray[np.bool_]
    rotated: Float32
    rotated_design: Int
    rotated_angle: Float


@dataclass(frozen=True)
class DesignTemplates:
    """All templates of a set of D designs.

    Attributes
    ----------
    patches : tuple of Patch
        The designs.
    core, whole : Templates
        Templates of the cores, on the unit circle, and of the whole designs, on the unit disc.
    view : ndarray of shape (D, VIEW_PX²), float32
        Each design as :func:`kpbench.fitting.views.rectify` shows it: white 1, black -1.
    """

    patches: tuple[Patch, ...]
    core: Templates
    whole: Templates
    view: Float32


def build_templates(patches: Sequence[Patch]) -> DesignTemplates:
    """Return the templates of a set of designs; the last few sets are cached."""
    return _build_templates(tuple(patches))


@lru_cache(maxsize=8)
def _build_templates(patches: tuple[Patch, ...]) -> DesignTemplates:
    core = _sample_designs(patches, CORE_RINGS, whole=False)
    whole = _sample_designs(patches, WHOLE_RINGS, whole=True)
    view = np.array([look_up_ink(draw_ink(patch, True), view_points()) for patch in patches], np.float32)
    return DesignTemplates(patches, core, whole, view)


def _sample_designs(patches: Sequence[Patch], rings: Sequence[float], whole: bool) -> Templates:
    points = np.concatenate([r * _circle for r in rings])
    pairs = [_linearise(draw_ink(patch, whole), points) for patch in patches]
    ink, solve = (np.array(part, np.float32) for part in zip(*pairs, strict=True))
    rotated, design, angle, count = [], [], [], WHOLE_ROTATIONS if whole else CORE_ROTATIONS
    for n, patch in enumerate(patches):
        image = draw_ink(patch, whole)
        kept: list[Float32] = []
        for turn in np.arange(count) * (2 * np.pi / count):
            c, s = np.cos(turn), np.sin(turn)
            grey = look_up_ink(image, points @ np.array([[c, -s], [s, c]]))
            template = ((grey - grey.mean()) / np.linalg.norm(grey - grey.mean())).astype(np.float32)
            if all(template @ other < SAME_NCC for other in kept):
                kept.append(template)
                design.append(n)
                angle.append(turn)
        rotated += kept
    has_size = np.array([whole and len(patch.cells[0]) > 2 for patch in patches])
    return Templates(points, ink, solve, has_size, np.array(rotated), np.array(design, np.int64), np.array(angle))


def _linearise(image: Float32, points: Float) -> tuple[Float, Float]:
    """Return the normalised template (M,) of an ink image and its Gauss-Newton solver (6, M)."""
    step = 0.05
    ink = look_up_ink(image, points)
    du, dv = ((look_up_ink(image, points + s) - look_up_ink(image, points - s)) / (2 * step) for s in np.eye(2) * step)
    u, v = points.T
    jacobian = np.column_stack([du, dv, du * u, du * v, dv * u, dv * v])
    ink = ink - ink.mean()
    jacobian /= np.linalg.norm(ink)
    ink /= np.linalg.norm(ink)
    # offset and contrast of the grey values are unknown, so the step must not depend on them
    jacobian -= jacobian.mean(axis=0)
    jacobian -= np.outer(ink, ink @ jacobian)
    normal = jacobian.T @ jacobian
    # sectors with two edges look the same when they are stretched along the edges; damping keeps this stretch unchanged
    return ink, np.linalg.solve(normal + np.eye(6) * 0.02 * np.trace(normal) / 6, jacobian.T)


@lru_cache(maxsize=64)
def draw_ink(patch: Patch, whole: bool, blur: float | None = None) -> Float32:
    """Return a blurred image of a design's ink, white 1 and black -1, over [-VIEW_REACH, VIEW_REACH]² of its frame.

    Parameters
    ----------
    patch : Patch
    whole : bool
        True draws the design, with its outermost ring continued outwards. False draws the innermost sectors alone,
        continued outwards.
    blur : float, optional
        Standard deviation of the blur, in disc radii; 0 for none. None: the blur of templates.
    """
    if blur is None:
        blur = WHOLE_BLUR if whole else CORE_BLUR
    if blur:
        sharp, blur_px = draw_ink(patch, whole, 0.0), blur * _INK_PX / (2 * VIEW_REACH)
        return np.asarray(cv2.GaussianBlur(sharp, (0, 0), blur_px))
    fine = 3
    ticks = ((np.arange(_INK_PX * fine) + 0.5) / (_INK_PX * fine) * 2 - 1) * VIEW_REACH
    points = np.stack(np.meshgrid(ticks, ticks), axis=-1)
    # whole design: points beyond the disc take the ink at radius 0.999; core: all points take the ink of the innermost
    # sectors
    radius = np.hypot(*np.moveaxis(points, -1, 0)) + 1e-9
    looked_up = np.minimum(radius, 0.999) if whole else 0.5 * patch.cells[0][1]
    black = patch.is_black(points * (looked_up / radius)[..., None])
    return np.asarray(np.where(black, -1, 1).reshape(_INK_PX, fine, _INK_PX, fine).mean(axis=(1, 3)), np.float32)


def look_up_ink(image: Float32, points: Float) -> Float:
    """Return the ink (N,) of an image from :func:`draw_ink` at points (N, 2) of the patch frame."""
    at = ((points + VIEW_REACH) / (2 * VIEW_REACH) * _INK_PX - 0.5).astype(np.float32)
    return np.asarray(cv2.remap(image, at[:, :1], at[:, 1:], cv2.INTER_LINEAR), np.float64).ravel()


@lru_cache(maxsize=1)
def view_points() -> Float:
    """Return the centres of a view's pixels in the patch frame, (VIEW_PX², 2), row by row."""
    ticks = ((np.arange(VIEW_PX) + 0.5) / VIEW_PX * 2 - 1) * VIEW_REACH
    return np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
