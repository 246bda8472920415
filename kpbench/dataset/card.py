"""What is in a dataset, for people: facts and histograms, and the dataset card made of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kpbench.dataset.drawing import contact_sheet, draw_keypoints
from kpbench.dataset.folder import Dataset
from kpbench.files import write_atomic
from kpbench.images import encode_png
from kpbench.types import Float, UInt8

FILES = ("README.md", "preview.png")
"""What :func:`write_card` writes."""


@dataclass(frozen=True)
class Histogram:
    """Counts (n,) under n labels."""

    title: str
    labels: tuple[str, ...]
    counts: NDArray[np.int64]

    @property
    def shares(self) -> Float:
        """Of all that was counted, shape (n,)."""
        return self.counts / max(int(self.counts.sum()), 1)


def names(dataset: Dataset) -> dict[int, str]:
    """Name of every patch ID, from the dataset's config where it tells them."""
    told = {patch["id"]: patch["name"] for patch in dataset.config.get("patches", [])}
    return {int(i): told.get(int(i), f"patch-{i}") for i in sorted({*told, *dataset.truth.keypoints["patch_id"]})}


def facts(dataset: Dataset) -> dict[str, str]:
    """Name and value of what holds for the whole dataset."""
    image, config, keypoints = dataset.image(0), dataset.config, dataset.truth.keypoints
    size = sum(shard.bytes for shard in dataset.shards)
    made = [f"{config.get('backgrounds', {}).get('kind', 'n/a')} backgrounds"]
    made += [f"deterioration {config['deteriorate']}"] if "deteriorate" in config else []
    made += ["radii of {:g} to {:g} px".format(*config["limits"]["radius_px"])] if "limits" in config else []
    made += [f"up to {config['distractors']} look-alikes an image"] if config.get("distractors") else []
    made += ["an albumentations pipeline (in dataset.json)"] if config.get("augmentation") else []
    designs = [f"{patch['name']} ({patch['id']})" for patch in config.get("patches", [])]
    return {
        "fingerprint": dataset.fingerprint,
        "images": f"{len(dataset)} of {image.shape[1]}x{image.shape[0]}, {'grey' if image.ndim == 2 else 'RGB'}",
        "on disk": f"{size / 1e6:.1f} MB in {len(dataset.shards)} shards, {size / len(dataset) / 1e3:.1f} kB an image",
        "made from": ", ".join([f"seed {config.get('seed')}", *made]),
        "designs": ", ".join(designs) or "n/a",
        "keypoints": f"{len(keypoints)}",
    }


def histograms(dataset: Dataset) -> list[Histogram]:
    """How designs, counts, sizes, tilts and contrasts are distributed."""
    keypoints = dataset.truth.keypoints
    per_image = np.diff(dataset.truth.offsets)
    made = [_counted("keypoints an image", per_image)]
    if not len(keypoints):
        return made
    major, minor = keypoints["radius_major"], keypoints["radius_minor"]
    called = names(dataset)
    by_id = _counted("patch ID", keypoints["patch_id"])
    by_id = replace(by_id, labels=tuple(f"{label} ({called[int(label)]})" for label in by_id.labels))
    tilt_deg = np.degrees(np.arccos(np.clip(minor / major, 0, 1)))
    return [
        *made,
        by_id,
        _binned("radius (major semi-axis), px", major, [0, 5, 8, 12, 20, 32, 50, 80, np.inf]),
        _binned("short axis (full length), px", 2 * minor, [0, 10, 16, 24, 40, 64, 100, 160, np.inf]),
        _binned("tilt by the axes, acos(minor / major), degrees", tilt_deg, [0, 15, 30, 45, 60, 75, 90]),
        _binned("contrast, grey levels", keypoints["contrast"], [-np.inf, 0, 25, 50, 100, 150, 200, 256]),
        _binned("visible fraction", keypoints["visible"], [0, 0.5, 0.75, 0.99, 1.01]),
    ]


def _counted(title: str, values: ArrayLike) -> Histogram:
    found, counts = np.unique(np.asarray(values), return_counts=True)
    return Histogram(title, tuple(map(str, found)), counts)


def _binned(title: str, values: ArrayLike, borders: list[float]) -> Histogram:
    labels = tuple(f"{low:g} to {high:g}" for low, high in pairwise(borders))
    return Histogram(title, labels, np.histogram(np.asarray(values), borders)[0])


def overview(dataset: Dataset, count: int, columns: int, tile_width_px: int) -> UInt8:
    """A contact sheet, RGB, of evenly spaced images with their true keypoints."""
    chosen = np.unique(np.linspace(0, len(dataset) - 1, min(count, len(dataset))).astype(int)).tolist()
    scale = tile_width_px / dataset.image(0).shape[1]
    return contact_sheet([draw_keypoints(*dataset[i], scale) for i in chosen], min(columns, len(chosen)))


def write_card(dataset: Dataset, folder: Path) -> None:
    """Write ``README.md``, with the header that dataset hubs read, and its picture into a folder.

    Raises
    ------
    DataError
        If they cannot be written.
    """
    write_atomic(folder / FILES[1], encode_png(overview(dataset, 12, 4, 320)))
    tables = "\n\n".join(map(_table, histograms(dataset)))
    said = "\n".join(f"| {key} | {value} |" for key, value in facts(dataset).items())
    versions = ", ".join(f"{name} {version}" for name, version in dataset.provenance.get("versions", {}).items())
    text = f"""---
pretty_name: Keypoint patches, {len(dataset)} images
task_categories: [keypoint-detection]
size_categories: ["{_size_category(len(dataset))}"]
tags: [keypoint-patches, simulated]
---

# Keypoint patches, {len(dataset)} simulated images

![Evenly spaced images with their true keypoints](preview.png)

| | |
|---|---|
{said}

The images are simulated by kpbench; each is a function of the configuration in `dataset.json`, the seed and the
background files. Where those are photographs, their licence holds for what is seen of them here.

```python
import kpbench

image, keypoints = kpbench.open_dataset("path/of/this/folder")[0]
```

{tables}

Made with {versions}.
"""
    write_atomic(folder / FILES[0], text.encode(errors="backslashreplace"))


def _table(histogram: Histogram) -> str:
    rows = [
        f"| {label} | {count} | {share:.1%} |"
        for label, count, share in zip(histogram.labels, histogram.counts, histogram.shares, strict=True)
    ]
    return "\n".join([f"| {histogram.title} | | |", "|---|---|---|", *rows])


def _size_category(images: int) -> str:
    """The words of the Hugging Face hub."""
    steps = ((10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"), (10**7, "1M<n<10M"))
    return next((name for most, name in steps if images < most), "n>10M")
