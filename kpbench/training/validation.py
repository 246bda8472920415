"""Validation: the share of keypoints that a network finds in samples on which it was not trained."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from kpbench.detectors.heads import decode
from kpbench.patches.design import Patch
from kpbench.training.batches import Batch, make_batch
from kpbench.training.network import SuperPoint
from kpbench.training.recipe import Recipe
from kpbench.types import UInt8

FOUND_PX, CLOSE_PX = 3.0, 1.0
"""A keypoint is found if a detection lies within 3 px, and found closely if a detection lies within 1 px."""

TIMED_SHARE = 8
"""The time of a validation is estimated from one in so many images."""
ValidationSets = list[tuple[str, Batch]]
"""Name and samples of each validation set."""


def make_validation_sets(
    recipe: Recipe, patches: Sequence[Patch], photos: Sequence[UInt8], count: int = 32
) -> ValidationSets:
    """Make the validation sets of a training; the recipe's seed determines their random numbers.

    Returns
    -------
    list of (str, Batch)
        "clean": ``count`` whole images that are not degraded. "paper": the same images, degraded as in the paper.
        "hard": 8 · ``count`` crops at full severity.
    """
    scenes = replace(recipe.samples, kind="scenes", size=(640, 480), set_size=count)
    crops = replace(recipe.samples, kind="crops", size=(128, 128))
    seed = recipe.seed + 2**31  # the random numbers differ from those of the training batches
    return [
        ("clean", make_batch(scenes, patches, photos, seed, 0, count, 0.0)),
        ("paper", make_batch(scenes, patches, photos, seed, 0, count, 1.0)),
        ("hard", make_batch(crops, patches, photos, seed, 1, 8 * count, 1.0)),
    ]


def estimate_validation_s(network: SuperPoint, sets: ValidationSets) -> float:
    """Return about how long :func:`validate_network` will take, s, from an eighth of each set."""
    few = [(name, Batch(images[::TIMED_SHARE], keypoints[::TIMED_SHARE])) for name, (images, keypoints) in sets]
    start = time.monotonic()
    validate_network(network, few)
    return TIMED_SHARE * (time.monotonic() - start)


@torch.inference_mode()
def validate_network(network: SuperPoint, sets: ValidationSets) -> dict[str, float]:
    """Measure how many keypoints a network finds, at the default threshold and without verification.

    :func:`kpbench.score` cannot score crops, for two reasons. First, its tolerance ε is relative to the radius of a
    patch, and the keypoints of crops hold no patch radius. Second, crops have ignored keypoints, and a detection near
    an ignored keypoint is no false alarm.

    Returns
    -------
    dict
        Four figures for each set NAME. ``NAME_found_3px``: share of keypoints with a detection within 3 px.
        ``NAME_found_1px``: share of keypoints with a detection within 1 px. ``NAME_id``: share of the keypoints found
        within 3 px whose nearest detection has the right design. ``NAME_alarms``: number of false alarms per image.
    """
    network.eval()
    device = next(network.parameters()).device
    figures: dict[str, float] = {}
    for name, batch in sets:
        truths = found = close = right = alarms = 0
        for image, keypoints in zip(batch.images, batch.keypoints, strict=True):
            blob = torch.as_tensor(image, device=device).float()[None, None] / 255
            detector, identity = network(blob)
            detections = decode(detector[0].float().cpu().numpy(), identity[0].float().cpu().numpy())
            explained = np.zeros(len(detections), bool)
            for x, y, design, ignore in keypoints[keypoints[:, 2] >= 0]:
                distance = np.hypot(*(detections.xy - (x, y)).T)
                explained |= distance <= max(FOUND_PX, ignore)
                if ignore:
                    continue
                truths += 1
                if len(distance) and distance.min() <= FOUND_PX:
                    found += 1
                    close += bool(distance.min() <= CLOSE_PX)
                    right += bool(detections.patch_id is not None and detections.patch_id[distance.argmin()] == design)
            alarms += int(np.sum(~explained))
        figures |= {
            f"{name}_found_3px": found / max(truths, 1),
            f"{name}_found_1px": close / max(truths, 1),
            f"{name}_id": right / max(found, 1),
            f"{name}_alarms": alarms / len(batch.images),
        }
    return figures
