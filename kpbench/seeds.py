"""Seeds: every stage in the making of an image has its own random numbers."""

from __future__ import annotations

import numpy as np

# The pixels of every dataset depend on these numbers. A new stage gets a new number. No number may change its meaning.
SYNTH_BACKGROUND, SYNTH_SCENE, SYNTH_DETERIORATION, SYNTH_LOOKALIKES, SYNTH_AUGMENTATION = range(5)
"""Stages in the making of an image of a synthetic set."""
SYNTH_CAMERA = 5
"""The same: what a camera draws for an image, and the noise of its sensor."""
SUITE_BACKGROUND, SUITE_SCENE, SUITE_EFFECT, SUITE_FIELD = range(16, 20)
"""Stages in the making of a base scene of a suite. SUITE_SCENE draws pose, inks and light. SUITE_FIELD draws the random
fields of the effects noise and low light."""
SUITE_CAMERA, SUITE_SENSOR = 20, 21
"""The same: what a camera draws for a base scene, and the noise of its sensor."""

SUITE_FILM = 22
"""The same: path of the board, and the bar before it, of a film. Frame k of scene n of films of N frames takes the
noise of its sensor from SUITE_SENSOR of n·N + k."""
SUITE_CLUTTER = 23
"""The same: the look-alikes on the background of a base scene."""


def stage_rng(seed: int, index: int, stage: int) -> np.random.Generator:
    """Return the random numbers of one stage of one image.

    The random numbers are independent of the random numbers of every other stage, image and seed.

    Parameters
    ----------
    seed : int
        Seed of the dataset, 0 or more.
    index : int
        Number of the image, or of the base scene in a suite.
    stage : int
        One of the constants of this module.

    Examples
    --------
    >>> from kpbench.seeds import SYNTH_SCENE, stage_rng
    >>> stage_rng(0, 7, SYNTH_SCENE).random() == stage_rng(0, 7, SYNTH_SCENE).random()
    True
    """
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(index, stage))))
