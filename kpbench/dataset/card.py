"""Descriptions of a dataset for people: facts, histograms, an overview picture, and the dataset card."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kpbench.dataset.drawing import contact_sheet, draw_keypoints
from kpbench.dataset.folder import Dataset
from kpbench.dataset.usage import DATASET_USAGE
from kpbench.files import encode_utf8
from kpbench.images import encode_png
from kpbench.predictions.coco import CocoDataset
from kpbench.provenance import describe_images, image_source
from kpbench.text import escape_markdown
from kpbench.types import Float, UInt8
from kpbench.writing import is_replaceable, write_file

CARD_FILES = ("README.md", "preview.png")
"""The files that :func:`write_card` writes: the card and its picture."""
CARD_MARK = "kpbench.card/1"
"""Mark of a card that kpbench wrote. A card without the mark is the user's."""
LICENCES = {
    "simulated": (
        "The images are simulated by kpbench. Configuration and background files determine every image.\n"
        "If the background files are photographs, their licence also holds for these images."
    ),
    "simulated photographs": "The images are simulated by kpbench, and labelled as photographs are.",
    "photographs": "The images are photographs. The licence of the photographs holds for them.",
    "": "Nothing tells what the images are. The licence of the originals holds for them.",
}
"""What a card says of the images, by what :func:`kpbench.provenance.image_source` returns."""
SIZE_CATEGORIES = (
    (10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"), (10**7, "1M<n<10M"),
)  # fmt: skip
"""Pairs (limit, category): the Hugging Face hub's category of datasets with fewer images than the limit."""


@dataclass(frozen=True)
class Histogram:
    """A histogram of a dataset.

    Attributes
    ----------
    title : str
    labels : tuple of str
    counts : ndarray of shape (n,), int64
        One count per label.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.dataset import Histogram
    >>> Histogram("patch ID", ("0", "1"), np.array([3, 1])).shares
    array([0.75, 0.25])
    """

    title: str
    labels: tuple[str, ...]
    counts: NDArray[np.int64]

    @property
    def shares(self) -> Float:
        """The counts as fractions of their sum, ndarray of shape (n,)."""
        return self.counts / max(int(self.counts.sum()), 1)


def patch_names(dataset: Dataset | CocoDataset) -> dict[int, str]:
    """Return the name of every patch ID. An ID without a name in the dataset's config gets the name ``patch-ID``."""
    known = {patch["id"]: patch["name"] for patch in dataset.config.get("patches", [])}
    truth = dataset.truth
    ids = sorted({*known, *truth.keypoints["patch_id"], *(() if truth.ignored is None else truth.ignored["patch_id"])})
    return {int(patch_id): known.get(int(patch_id), f"patch-{patch_id}") for patch_id in ids}


def dataset_facts(dataset: Dataset | CocoDataset) -> dict[str, str]:
    """Return facts about the whole dataset, as a mapping from names to texts.

    Examples
    --------
    >>> from kpbench import open_dataset
    >>> from kpbench.dataset import dataset_facts
    >>> dataset_facts(open_dataset("kpbench-data"))["images"]
    '6 of 640x480, grey'
    """
    image, config = dataset.image(0), dataset.config
    keypoints, ignored = dataset.truth.keypoints, dataset.truth.ignored
    sources = [f"seed {config['seed']}"] if "seed" in config else []
    if "backgrounds" in config:
        sources.append(f"{config['backgrounds'].get('kind', 'n/a')} backgrounds")
    if "deteriorate" in config:
        sources.append(f"deterioration {config['deteriorate']}")
    if "limits" in config:
        sources.append("radii of {:g} to {:g} px".format(*config["limits"]["radius_px"]))
    if config.get("distractors"):
        sources.append(f"up to {config['distractors']} look-alikes an image")
    if config.get("augmentation"):
        sources.append("an albumentations pipeline (in dataset.json)")
    if config.get("kind") == "degraded":
        sources.append(f"effects of {config['suite']} on the images of {config['of']['fingerprint'][:16]}")
    designs = [f"{patch['name']} ({patch['id']})" for patch in config.get("patches", [])]
    return {
        "fingerprint": dataset.fingerprint,
        "images": f"{len(dataset)} of {image.shape[1]}x{image.shape[0]}, {'grey' if image.ndim == 2 else 'RGB'}",
        "source": image_source(config) or "n/a",
        **_disk_facts(dataset),
        "made from": ", ".join(sources) or "n/a",
        "designs": ", ".join(designs) or "n/a",
        "keypoints": f"{len(keypoints)}" + ("" if ignored is None else f", and {len(ignored)} ignored"),
    }


def _disk_facts(dataset: Dataset | CocoDataset) -> dict[str, str]:
    if not isinstance(dataset, Dataset):
        return {}
    size, shards = sum(shard.bytes for shard in dataset.shards), len(dataset.shards)
    return {"on disk": f"{size / 1e6:.1f} MB in {shards} shards, {size / len(dataset) / 1e3:.1f} kB an image"}


def dataset_histograms(dataset: Dataset | CocoDataset) -> list[Histogram]:
    """Return histograms: keypoints per image, patch IDs, sizes, tilts, contrasts and visible fractions.

    Examples
    --------
    >>> from kpbench import open_dataset
    >>> from kpbench.dataset import dataset_histograms
    >>> [histogram.title for histogram in dataset_histograms(open_dataset("kpbench-data"))][:2]
    ['keypoints an image', 'patch ID']
    """
    keypoints = dataset.truth.keypoints
    per_image = _count_values("keypoints an image", np.diff(dataset.truth.offsets))
    if not len(keypoints):
        return [per_image]
    major, minor = keypoints["radius_major"], keypoints["radius_minor"]
    names = patch_names(dataset)
    by_id = _count_values("patch ID", keypoints["patch_id"])
    by_id = replace(by_id, labels=tuple(f"{label} ({names[int(label)]})" for label in by_id.labels))
    tilt_deg = np.degrees(np.arccos(np.clip(minor / major, 0, 1)))
    return [
        per_image,
        by_id,
        _bin_values("radius (major semi-axis), px", major, [0, 5, 8, 12, 20, 32, 50, 80, np.inf]),
        _bin_values("short axis (full length), px", 2 * minor, [0, 10, 16, 24, 40, 64, 100, 160, np.inf]),
        _bin_values("tilt, acos(minor / major semi-axis), degrees", tilt_deg, [0, 15, 30, 45, 60, 75, 90]),
        _bin_values("contrast, grey levels", keypoints["contrast"], [-np.inf, 0, 25, 50, 100, 150, 200, 256]),
        _bin_values("visible fraction", keypoints["visible"], [0, 0.5, 0.75, 0.99, 1.01]),
    ]


def _count_values(title: str, values: ArrayLike) -> Histogram:
    """Count how often each value occurs."""
    different, counts = np.unique(np.asarray(values), return_counts=True)
    return Histogram(title, tuple(map(str, different)), counts)


def _bin_values(title: str, values: ArrayLike, borders: list[float]) -> Histogram:
    """Count the values in each bin. A bin lies between two successive borders."""
    labels = tuple(f"{low:g} to {high:g}" for low, high in pairwise(borders))
    return Histogram(title, labels, np.histogram(np.asarray(values), borders)[0])


def draw_overview(dataset: Dataset | CocoDataset, count: int, columns: int, tile_width_px: int) -> UInt8:
    """Draw a contact sheet of evenly spaced images with their true keypoints.

    Parameters
    ----------
    dataset : Dataset or CocoDataset
    count : int
        Number of images.
    columns : int
        Images per row.
    tile_width_px : int
        Width of an image on the sheet.

    Returns
    -------
    ndarray of shape (H, W, 3), uint8
        RGB.

    Examples
    --------
    >>> from kpbench import open_dataset
    >>> from kpbench.dataset import draw_overview
    >>> draw_overview(open_dataset("kpbench-data"), count=4, columns=2, tile_width_px=160).shape
    (252, 332, 3)
    """
    chosen = np.unique(np.linspace(0, len(dataset) - 1, min(count, len(dataset))).astype(int)).tolist()
    shown = (dataset[n] for n in chosen)
    tiles = [draw_keypoints(image, keypoints, tile_width_px / image.shape[1]) for image, keypoints in shown]
    return contact_sheet(tiles, min(columns, len(chosen)))


def draw_rungs(dataset: Dataset | CocoDataset, tile_width_px: int) -> UInt8:
    """Draw a contact sheet of a suite: a row per condition, and in it one image per rung with its true keypoints.

    All images show the same base scene and board, where the suite has one scene for all conditions.

    Parameters
    ----------
    dataset : Dataset or CocoDataset
        With conditions.
    tile_width_px : int
        Width of an image on the sheet.

    Returns
    -------
    ndarray of shape (H, W, 3), uint8
        RGB.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.dataset import draw_rungs
    >>> config = kpbench.SuiteConfig(kpbench.load_suite("paper-v1"), images=1, size_px=(203, 155), only=("blur",))
    >>> suite = kpbench.generate(config, "blurred", workers=1).dataset
    >>> draw_rungs(suite, tile_width_px=100).shape  # four rungs
    (102, 420, 3)
    """
    truth, tiles, titles = dataset.truth, list[UInt8](), list[str]()
    conditions = list(dict.fromkeys(truth.condition.tolist()))
    rungs = {name: np.unique(truth.rung[truth.condition == name]) for name in conditions}
    columns = max(map(len, rungs.values()))
    for name in conditions:
        for rung in rungs[name]:
            of_rung = np.flatnonzero((truth.condition == name) & ((truth.rung == rung) | np.isnan(rung)))
            of_scene = of_rung[truth.scene_id[of_rung] == truth.scene_id[of_rung[0]]]
            image, keypoints = dataset[int(of_scene[len(of_scene) // 2])]
            tiles.append(draw_keypoints(image, keypoints, tile_width_px / image.shape[1], labels=False))
            titles.append(name if np.isnan(rung) else f"{name} {rung:g}")
        empty = columns - len(rungs[name])
        tiles += [np.zeros((0, 0, 3), np.uint8)] * empty
        titles += [""] * empty
    return contact_sheet(tiles, columns, titles=titles)


def write_card(dataset: Dataset | CocoDataset, folder: Path, usage: str = DATASET_USAGE) -> None:
    """Write the dataset card into a folder: ``README.md`` with the header that dataset hubs read, and ``preview.png``.

    A file that kpbench did not write is not replaced.

    Parameters
    ----------
    dataset : Dataset or CocoDataset
    folder : Path
    usage : str
        Markdown that tells how the folder is used.

    Raises
    ------
    DataError
        If a file cannot be written.
    """
    card, picture = CARD_FILES
    if is_replaceable(folder / picture, "picture"):
        write_file(folder / picture, encode_png(draw_overview(dataset, 12, 4, tile_width_px=320), "picture"))
    if not is_replaceable(folder / card, "card"):
        return
    tables = "\n\n".join(map(_markdown_table, dataset_histograms(dataset)))
    facts = "\n".join(f"| {key} | {escape_markdown(value)} |" for key, value in dataset_facts(dataset).items())
    versions = {} if not isinstance(dataset, Dataset) else dataset.provenance.get("versions", {})
    made_with = ", ".join(escape_markdown(f"{name} {version}") for name, version in versions.items())
    source = image_source(dataset.config)
    tags = ", ".join(["keypoint-patches", *([source] if source else [])])
    images = describe_images(len(dataset), source)
    text = f"""---
pretty_name: Keypoint patches, {images}
task_categories: [keypoint-detection]
size_categories: ["{_size_category(len(dataset))}"]
tags: [{tags}]
---

<!-- {CARD_MARK}: kpbench replaces this file as long as this line stands in it -->
# Keypoint patches, {images}

![Evenly spaced images with their true keypoints](preview.png)

| | |
|---|---|
{facts}

{LICENCES[source]}

{usage}
{tables}
{f"{chr(10)}Made with {made_with}.{chr(10)}" if made_with else ""}"""
    write_file(folder / card, encode_utf8(text))


def _markdown_table(histogram: Histogram) -> str:
    rows = [
        f"| {escape_markdown(label)} | {count} | {share:.1%} |"
        for label, count, share in zip(histogram.labels, histogram.counts, histogram.shares, strict=True)
    ]
    return "\n".join([f"| {histogram.title} | | |", "|---|---|---|", *rows])


def _size_category(images: int) -> str:
    return next((name for limit, name in SIZE_CATEGORIES if images < limit), "n>10M")
