"""Scenes of single patches: exact rendering in front of a background, and the true keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.camera.paper import spread_ink
from kpbench.geometry.coverage import Box, bounding_box, clip_to_image, rasterise_edges
from kpbench.geometry.homography import project_disc_sizes, project_discs
from kpbench.geometry.outline import flatten
from kpbench.geometry.warp import PointMap, join_polygons, subdivide
from kpbench.patches.design import Patch, unit_polygons
from kpbench.render.placement import Placement
from kpbench.types import KEYPOINT_DTYPE, Float, Float32, UInt8

WHOLLY_COVERED = 1 - 1e-6
"""A pixel lies wholly on a patch if its computed coverage is above this threshold. Because of rounding, the computed
coverage of such a pixel may differ from 1."""


@dataclass(frozen=True)
class Mask:
    """Fractions of pixels that one rendered patch covers.

    Attributes
    ----------
    box : Box
        The rectangle of pixels to which the two arrays belong. The rectangle may reach outside the image.
    black : ndarray of shape (height, width)
        Fraction of each pixel that black ink covers.
    disc : ndarray of shape (height, width)
        Fraction of each pixel that the patch covers.
    """

    box: Box
    black: Float
    disc: Float


@dataclass(frozen=True)
class Rendering:
    """A rendered image and its true keypoints.

    Attributes
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    keypoints : ndarray of shape (n,), :data:`kpbench.KEYPOINT_DTYPE`
    masks : tuple of Mask
        One mask per keypoint.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench import render_scene
    >>> rendering = render_scene(np.full((80, 100), 128, np.uint8), [])
    >>> rendering.image.shape, len(rendering.keypoints), rendering.masks
    ((80, 100), 0, ())
    """

    image: UInt8
    keypoints: NDArray[Any]
    masks: tuple[Mask, ...]


@lru_cache(maxsize=1024)
def inked_polygons(patch: Patch, tolerance: float, ink_gain: float) -> tuple[tuple[Float, ...], tuple[Float, ...]]:
    """Return the polygons of the black ink of a patch, and of the whole patch with all its ink, after ink gain.

    Parameters
    ----------
    patch : Patch
    tolerance : float
        Largest distance between an arc and its chords, in disc radii.
    ink_gain : float
        See :func:`rasterise_patches`.
    """
    black = flatten(spread_ink(patch.black_region, ink_gain), tolerance)
    inner = flatten(spread_ink(patch.black_region, ink_gain, patch.extent), tolerance)
    # the winding numbers of the disc and of the ink add up to 2 where they overlap; the reversed overlap leaves 1
    disc = [*flatten(patch.disc_region, tolerance), *black, *(polygon[::-1] for polygon in inner)]
    return tuple(black), tuple(disc if ink_gain > 0 else disc[:1])


@lru_cache(maxsize=256)
def _unit_edges(patch: Patch, tolerance: float, ink_gain: float = 0.0) -> tuple[Float, NDArray[np.int64], int, int]:
    """Return the polygons of a patch on the unit disc, as edges.

    ``tolerance`` : largest distance between an edge and the true outline, in disc radii.
    ``ink_gain`` : see :func:`rasterise_patches`.

    Returns
    -------
    vertices : ndarray of shape (2, N)
        First the vertices of the black areas, then the vertices of the disc.
    next_vertex : ndarray of shape (N,)
        Index of the next vertex of the same polygon. An edge leads from each vertex to its next vertex.
    black_count, disc_count : int
        Number of vertices of the black areas and of the disc.
    """
    black, disc = inked_polygons(patch, tolerance, ink_gain) if ink_gain else unit_polygons(patch, tolerance)
    points, next_vertex = join_polygons([*black, *disc])
    black_count = sum(map(len, black))
    return np.ascontiguousarray(points.T), next_vertex, black_count, len(points) - black_count


def rasterise_patches(
    placements: Sequence[Placement],
    tolerance_px: float = 1e-3,
    warp: PointMap | None = None,
    ink_gain: float = 0.0,
) -> list[Mask]:
    """Compute which fraction of each pixel each patch covers. The patches may belong to different images.

    Parameters
    ----------
    placements : sequence of Placement
    tolerance_px : float
        Largest distance between a drawn edge and the true edge, px.
    warp : callable, optional
        Map from px to px that follows the homographies, such as the distortion of a lens. Straight edges are divided
        so that their chords follow their bent images.
    ink_gain : float
        Distance by which all edges of the black ink move outwards, in disc radii. Black ink beyond the rim of a patch
        counts as part of the patch. See :func:`kpbench.camera.paper.spread_ink`.

    Returns
    -------
    list of Mask
        One mask per placement.
    """
    if not placements:
        return []
    poses = np.stack([p.H_patch2image for p in placements])
    _, major, _ = project_disc_sizes(poses)
    # the tolerances are rounded down to powers of two, so that patches of similar size share cached polygons
    tolerances = np.ldexp(0.5, np.frexp(tolerance_px / major)[1])
    starts, ends, counts, boxes = list[Float](), list[Float](), list[int](), list[Box]()
    for p, tolerance in zip(placements, tolerances, strict=True):
        (u, v), next_vertex, black_count, disc_count = _unit_edges(p.patch, float(tolerance), ink_gain)
        H = p.H_patch2image
        mapped = H[:, :1] * u + H[:, 1:2] * v + H[:, 2:]
        points = mapped[:2] / mapped[2]
        if warp is not None:
            finer, next_vertex, edge = subdivide(points.T, next_vertex, warp, tolerance_px)
            black_count = int(np.searchsorted(edge, black_count))
            disc_count, points = len(edge) - black_count, warp(finer).T
        starts.append(points)
        ends.append(points.take(next_vertex, axis=1))
        counts += [black_count, disc_count]
        boxes += [bounding_box([points[:, black_count:].T])] * 2
    owner = np.repeat(np.arange(len(counts)), counts)
    covers = rasterise_edges(np.concatenate(starts, axis=1), np.concatenate(ends, axis=1), owner, boxes)
    return [Mask(boxes[n], covers[n], covers[n + 1]) for n in range(0, len(covers), 2)]


def render_scene(background: UInt8, placements: Sequence[Placement]) -> Rendering:
    """Draw patches onto a background, by exact area coverage. The edges are accurate to 1/1000 px.

    Parameters
    ----------
    background : ndarray of shape (H, W) or (H, W, 3), uint8
        Not changed.
    placements : sequence of Placement

    Returns
    -------
    Rendering
        ``keypoints["contrast"]`` is nan; :func:`measure_contrast` measures the contrast.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench import render_scene, shipped_patches
    >>> from kpbench.render import Placement
    >>> H = np.array([[20.0, 0, 50], [0, 20, 40], [0, 0, 1]])  # radius 20 px, centre at (50, 40)
    >>> rendering = render_scene(np.full((80, 100), 128, np.uint8), [Placement(shipped_patches()[0], H, 20, 230)])
    >>> rendering.keypoints[["x", "y", "radius_major"]].tolist()
    [(50.0, 40.0, 20.0)]
    """
    image = background.copy()
    masks = rasterise_patches(placements)
    visible = [paint_patch(image, m, p.black, p.white) for m, p in zip(masks, placements, strict=True)]
    return Rendering(image, keypoint_table(placements, visible), tuple(masks))


def keypoint_table(placements: Sequence[Placement], visible: Sequence[float]) -> NDArray[Any]:
    """Make the table of true keypoints.

    Parameters
    ----------
    placements : sequence of Placement
    visible : sequence of float
        Fraction of each patch that is visible.

    Returns
    -------
    ndarray of shape (n,), KEYPOINT_DTYPE
        ``contrast`` is nan.
    """
    keypoints = np.zeros(len(placements), KEYPOINT_DTYPE)
    if placements:
        H = keypoints["H_patch2image"] = np.stack([p.H_patch2image for p in placements])
        _, keypoints["radius_major"], keypoints["radius_minor"], keypoints["axis_angle"] = project_discs(H)
        keypoints["x"], keypoints["y"] = H[:, 0, 2] / H[:, 2, 2], H[:, 1, 2] / H[:, 2, 2]
        keypoints["patch_id"] = [p.patch.patch_id for p in placements]
        keypoints["visible"] = visible
    keypoints["contrast"] = np.nan
    return keypoints


def paint_patch(image: UInt8 | Float32, mask: Mask, black: float, white: float) -> float:
    """Draw one patch into an image, in place.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8 or float32
        Grey levels, or linear light.
    mask : Mask
    black, white : float
        Grey levels or light of the two inks.

    Returns
    -------
    float
        Fraction of the patch that lies in the image.
    """
    in_image, in_box = clip_to_image(mask.box, image)
    disc = mask.disc[in_box]
    if not disc.size:
        return 0.0
    ink, part = (white - black) * mask.black[in_box], image[in_image]
    if image.ndim == 3:
        disc, ink = disc[..., None], ink[..., None]
    change = (white - part.astype(np.float64)) * disc
    change -= ink
    change += part
    image[in_image] = np.rint(change, out=change) if image.dtype == np.uint8 else change
    return 1.0 if disc.size == mask.disc.size else float(disc.sum() / mask.disc.sum())


def fraction_inside(image: UInt8, mask: Mask) -> float:
    """Return the fraction of a patch that lies in the image."""
    _, in_box = clip_to_image(mask.box, image)
    return float(mask.disc[in_box].sum() / mask.disc.sum())


def measure_contrast(image: UInt8 | Float32, masks: Sequence[Mask]) -> Float:
    """Measure the contrast of each patch in an image: grey level of white minus grey level of black.

    The method is linear regression over the pixels that lie wholly on the patch: the grey level of a pixel is regressed
    on the fraction of the pixel that black ink covers. The contrast is the negative slope of the regression line. Noise
    does not bias the contrast. Blur and shadow lower the contrast.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8 or float32
        Grey levels.
    masks : sequence of Mask

    Returns
    -------
    ndarray of shape (n,), float64
        Contrasts, grey levels; nan if the image shows nothing of the patch, or only one of its inks.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench import render_scene, shipped_patches
    >>> from kpbench.render import Placement, measure_contrast
    >>> H = np.array([[20.0, 0, 50], [0, 20, 40], [0, 0, 1]])
    >>> rendering = render_scene(np.full((80, 100), 128, np.uint8), [Placement(shipped_patches()[0], H, 20, 230)])
    >>> measure_contrast(rendering.image, rendering.masks).round()
    array([210.])
    """
    contrast = np.full(len(masks), np.nan)
    for n, mask in enumerate(masks):
        in_image, in_box = clip_to_image(mask.box, image)
        part = image[in_image]
        channels = [part] if part.ndim == 2 else [part[..., n] for n in range(3)]  # faster than a mean over an axis
        grey = (np.add.reduce([channel.astype(np.float64) for channel in channels]) / len(channels)).ravel()
        black = mask.black[in_box].ravel()
        weight = (mask.disc[in_box].ravel() > WHOLLY_COVERED).astype(np.float64)  # faster than indexing with a mask
        count = weight.sum()
        weighted = weight * black
        # sums instead of @, because starting the threads of BLAS takes longer than summing so few pixels
        if count and (variation := (weighted * black).sum() - weighted.sum() ** 2 / count) > 1e-6 * count:
            contrast[n] = (weighted.sum() * (weight * grey).sum() / count - (weighted * grey).sum()) / variation
    return contrast
