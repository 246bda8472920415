"""Random numbers: every stage of every image has a stream of its own."""

from __future__ import annotations

import numpy as np

# Stages of an image of a synthetic set; a number once given is never given again, as pixels depend on it
SYNTH_BACKGROUND, SYNTH_SCENE, SYNTH_DETERIORATION, SYNTH_LOOKALIKES, SYNTH_AUGMENTATION = range(5)
# Stages of a scene of a suite
SUITE_BACKGROUND, SUITE_SCENE, SUITE_EFFECT, SUITE_FIELD = range(16, 20)


def stream(seed: int, index: int, stage: int) -> np.random.Generator:
    """Random numbers of one stage of one image, independent of every other stage and image."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(index, stage))))
