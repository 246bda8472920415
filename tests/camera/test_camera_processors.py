"""Each photometric step gives the same bits where each library leaves out instructions of the processor."""

import hashlib
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from kpbench import SuiteConfig, load_suite
from kpbench.camera import (
    ToneCurve,
    blur_linear,
    demosaic,
    develop,
    expose,
    guided_denoise,
    median_denoise,
    mosaic,
    psf_kernel,
    random_tone_curve,
    unsharp_mask,
    vignetting,
)

PROCESSORS = Path(__file__).parents[2] / "benchmarks" / "robustness" / "processors.py"


def digests():
    """SHA-256 of the results of each step."""
    rng = np.random.default_rng(5)
    grey = rng.random((121, 163), dtype=np.float32)
    grey *= grey  # more dark pixels; a power would not be the same everywhere
    light = np.dstack([grey, grey[::-1], grey[:, ::-1]])
    curves = [ToneCurve("srgb"), ToneCurve("s-curve", (6,)), ToneCurve("logarithmic", (90,)), random_tone_curve(rng)]
    kernels = [psf_kernel(0.55, f_number, 3.0, radius) for f_number, radius in ((2, 0.0), (2.8, 1.0), (8, 5.0))]
    raw = expose(mosaic(light, (0.5, 1, 0.6)), rng, 900, prnu=0.01, dsnu_e=1, row_noise_e=0.5, black_dn=64)
    mosaics = [demosaic(raw, "bilinear"), demosaic(raw, "edge-aware")]
    images = [develop(colours, curves[0], 12, 64, (2, 1, 1.7)) for colours in mosaics]
    only = ("tone", "bow", "saddle", "rolling-shutter", "moving-board", "bayer-denoise", "chromatic", "detail")
    suite = SuiteConfig(load_suite("camera-v1"), images=1, seed=3, size_px=(203, 155), only=only)
    samples = [suite.make(n)[0] for n in range(2, suite.n, 12)]
    results = {
        "suite": [values for sample in samples for values in (sample.image, sample.keypoints)],
        "tone": [f(grey) for curve in curves for f in (curve.value, curve.light, curve.encode)],
        "psf": kernels,
        "blur": [blur_linear(light, kernel) for kernel in kernels],
        "vignetting": [vignetting(light, 150, (-0.1, 0.02))],
        "sensor": [raw, *(expose(grey, rng, electrons) for electrons in (30, 9000))],
        "demosaic": mosaics,
        "develop": images,
        "unsharp mask": [unsharp_mask(image, 0.8, sigma, 3) for image in images for sigma in (0.5, 2.5)],
        "denoise": [f(image, side) for image in images for f in (median_denoise, guided_denoise) for side in (3, 5)],
    }
    return {name: hashlib.sha256(b"".join(a.tobytes() for a in arrays)).hexdigest() for name, arrays in results.items()}


def test_every_step_is_the_same_on_a_processor_without_wide_instructions():
    spec = importlib.util.spec_from_file_location("benchmarks_processors", PROCESSORS)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    done = subprocess.run(
        [sys.executable, __file__],
        env={**os.environ, **module.PROCESSORS["all of these"]},
        capture_output=True,
        text=True,
        check=True,
    )
    assert json.loads(done.stdout) == digests()


if __name__ == "__main__":
    print(json.dumps(digests()))
