"""The last steps of every synthetic image: degrade a rendered scene and update its truth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.degrade.effects import Effect, polygon_cover
from kpbench.degrade.ladder import OUTLINES_OF_COVER, apply_effects
from kpbench.geometry.coverage import clip_to_image
from kpbench.render.placement import Placement
from kpbench.render.scene import Mask, Rendering, fraction_inside, keypoint_table, measure_contrast, rasterise_patches
from kpbench.synth.user_pipeline import run_pipeline
from kpbench.types import Float, UInt8


def discs_of(keypoints: NDArray[Any]) -> Float:
    """Return x, y and radius (px) of each keypoint's patch, shape (n, 3), for effects that aim at patches."""
    return np.column_stack([keypoints[name] for name in ("x", "y", "radius_major")]).astype(np.float64)


def degrade_scene(scene: Rendering, rng: np.random.Generator, effects: Sequence[Effect]) -> Rendering:
    """Apply effects to a rendered scene.

    Parameters
    ----------
    scene : Rendering
        Stays unchanged.
    rng : numpy.random.Generator
        See :func:`kpbench.degrade.apply_effects`.
    effects : sequence of dict
        Records of the effects.

    Returns
    -------
    Rendering
        The poses are unchanged, because no effect moves the image. Occlusions lower ``visible``. The
        values of ``contrast`` are measured in the degraded image.
    """
    image, keypoints = apply_effects(scene.image, rng, effects), scene.keypoints.copy()
    keypoints["visible"] *= unoccluded_fraction(image, effects, scene.masks)
    keypoints["contrast"] = measure_contrast(image, scene.masks)
    return Rendering(image, keypoints, scene.masks)


def augment_scene(
    scene: Rendering, placements: Sequence[Placement], effects: Sequence[Effect], pipeline: str, seed: int
) -> Rendering:
    """Send a degraded scene through the user's albumentations pipeline, which may move patches.

    Parameters
    ----------
    scene : Rendering
        Stays unchanged.
    placements : sequence of Placement
        The patches of the scene.
    effects : sequence of dict
        Records of the effects that degraded the scene. Occlusions lower ``visible``.
    pipeline : str
        From :func:`kpbench.synth.load_augmentation`.
    seed : int
        Seed of the pipeline's random numbers.

    Returns
    -------
    Rendering
        The moved scene. Patches whose centre has left the image are left out.

    Raises
    ------
    DataError
        See :func:`kpbench.synth.user_pipeline.run_pipeline`.
    """
    unoccluded = unoccluded_fraction(scene.image, effects, scene.masks)
    image, moved = run_pipeline(scene.image, placements, pipeline, seed)
    remaining = [placement for placement in moved if placement is not None]
    masks = tuple(rasterise_patches(remaining))
    keypoints = keypoint_table(remaining, [fraction_inside(image, mask) for mask in masks])
    keypoints["visible"] *= unoccluded[[placement is not None for placement in moved]]
    keypoints["contrast"] = measure_contrast(image, masks)
    return Rendering(image, keypoints, masks)


def unoccluded_fraction(image: UInt8, effects: Sequence[Effect], masks: Sequence[Mask]) -> Float:
    """Compute the fraction of each patch that occlusions leave uncovered.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
        Parts of a patch outside this image do not count.
    effects : sequence of dict
        Records of effects; effects other than occlusions are ignored.
    masks : sequence of Mask

    Returns
    -------
    ndarray of shape (n,), float64
    """
    covers = [OUTLINES_OF_COVER[e["effect"]](e) for e in effects if e["effect"] in OUTLINES_OF_COVER]
    fraction = np.ones(len(masks))
    for n, mask in enumerate(masks) if covers else ():
        _, in_box = clip_to_image(mask.box, image)
        uncovered = disc = mask.disc[in_box]
        for outlines in covers:
            uncovered = uncovered * (1 - polygon_cover(outlines, mask.box))[in_box]
        fraction[n] = uncovered.sum() / max(disc.sum(), 1e-9)
    return fraction
