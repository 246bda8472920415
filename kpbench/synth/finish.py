"""Degrade a rendered scene and carry its truth along."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kpbench.degrade.effects import Effect, occlusion_cover
from kpbench.geometry.coverage import clip_to_image
from kpbench.render.scene import Mask
from kpbench.types import Float, UInt8


def share_open(image: UInt8, effects: Sequence[Effect], masks: Sequence[Mask]) -> Float:
    """The fraction of what is in the image of each patch (n,) that the occlusions among these effects leave open."""
    strips = [effect["strips"] for effect in effects if effect["effect"] == "occlusion"]
    share = np.ones(len(masks))
    for n, mask in enumerate(masks) if strips else ():
        open_ = disc = mask.disc[clip_to_image(mask.box, image)[1]]
        for one in strips:
            open_ = open_ * (1 - occlusion_cover(one, mask.box))[clip_to_image(mask.box, image)[1]]
        share[n] = open_.sum() / max(disc.sum(), 1e-9)
    return share
