"""kpbench: design, print, synthesise and score keypoint patches.

The names below are imported when first used, so that ``import kpbench`` loads neither torch, h5py nor
onnxruntime.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

_HOMES = {
    "Detections": "types",
    "KEYPOINT_DTYPE": "types",
    "KpbenchError": "errors",
    "Patch": "patches.design",
    "Predictions": "predictions.files",
    "Truth": "types",
    "compare": "scoring.comparison",
    "generate": "dataset.generation",
    "load_detector": "detectors.interface",
    "load_patches": "patches.design",
    "open_dataset": "dataset.folder",
    "predict": "detectors.prediction",
    "read_predictions": "predictions.files",
    "render_scene": "render.scene",
    "score": "scoring.scores",
    "shipped_patches": "patches.design",
    "write_predictions": "predictions.files",
}

__all__ = ["__version__", *sorted(_HOMES)]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'kpbench' has no attribute {name!r}")
    return getattr(importlib.import_module(f"kpbench.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
