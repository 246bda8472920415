"""Degrade a rendered scene and carry its truth along."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kpbench.degrade.effects import Effect, _strips
from kpbench.geometry.coverage import Box, box_around, coverage
from kpbench.render.scene import Mask, inside_image
from kpbench.types import Float, UInt8


def occlusion_cover(strips: list[list[float]], box: Box) -> Float:
    """Fraction of each pixel of a box that :func:`occlusion` hides, shape (height, width)."""
    x, y, w, h = box
    seen = np.ones((h, w))
    for polygon in _strips(strips):
        around = box_around([polygon])
        shifted = (around[0] - x, around[1] - y, *around[2:])
        there, here = inside_image(shifted, seen)
        if seen[there].size:
            seen[there] *= 1 - coverage([[polygon]], [around])[0][here]
    return 1 - seen


def share_open(image: UInt8, effects: Sequence[Effect], masks: Sequence[Mask]) -> Float:
    """The fraction of what is in the image of each patch (n,) that the occlusions among these effects leave open."""
    strips = [effect["strips"] for effect in effects if effect["effect"] == "occlusion"]
    share = np.ones(len(masks))
    for n, mask in enumerate(masks) if strips else ():
        open_ = disc = mask.disc[inside_image(mask.box, image)[1]]
        for one in strips:
            open_ = open_ * (1 - occlusion_cover(one, mask.box))[inside_image(mask.box, image)[1]]
        share[n] = open_.sum() / max(disc.sum(), 1e-9)
    return share
