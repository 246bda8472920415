"""A dataset in the formats of other tools: COCO keypoints, YOLO-pose, WebDataset, Parquet.

In kpbench and in the keypoints of COCO, the origin is the centre of the top-left pixel. In the boxes of COCO and in all
coordinates of YOLO, the origin is the top-left corner of this pixel, half a pixel further left and up.
"""

from __future__ import annotations

import hashlib
import io
import json
import tarfile
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.dataset.card import patch_names, write_card
from kpbench.dataset.croissant import write_croissant
from kpbench.dataset.folder import Dataset
from kpbench.dataset.parquet import export_parquet
from kpbench.dataset.splits import SPLITS, VAL_SHARE, split_scenes
from kpbench.dataset.usage import EXPORT_USAGE
from kpbench.errors import DataError
from kpbench.files import escape_surrogates, make_folder
from kpbench.geometry.homography import project_disc_boxes
from kpbench.images import encode_png
from kpbench.locks import LOCK_FILE, lock_folder
from kpbench.portable import cos_sin
from kpbench.predictions.coco import CocoDataset
from kpbench.provenance import image_source
from kpbench.text import escape_yaml
from kpbench.types import KEYPOINT_DTYPE, Float
from kpbench.workers import Progress
from kpbench.writing import is_leftover, remove_file, require_space, write_file

EXPORT_MARK = "kpbench.export/1"
"""Mark in the main file of an export to COCO or YOLO."""
IMAGE_KIND = "exported-image"
"""Kind of the exported images."""
IMAGES_PER_TAR = 500
"""Images per tar of an export to WebDataset, where the dataset has no shards."""
UNFINISHED = ".kpbench-unfinished"
"""File that stands in the folder of an export until the export is finished. The same export then continues."""


def export_dataset(
    dataset: Dataset | CocoDataset,
    file_format: str,
    out: str | Path,
    progress: Progress = lambda images: None,
    val_share: float = VAL_SHARE,
) -> Path:
    """Write a dataset in another format into a new or empty folder, with the dataset's card.

    Parameters
    ----------
    dataset : Dataset or CocoDataset
        See :func:`kpbench.dataset.open_labelled`.
    file_format : {"coco", "yolo", "webdataset", "parquet"}
    out : str or Path
        Folder; made if missing.
    progress : callable
        Called with the number of images written since its last call.
    val_share : float
        Share of the scenes that are for validation, see :func:`kpbench.dataset.split_scenes`. Only "yolo" and
        "parquet" split.

    Returns
    -------
    Path
        The main file: ``annotations.json``, ``data.yaml``, the first tar, or ``croissant.json``.

    Raises
    ------
    DataError
        If the format is unknown, the folder holds other files, or a file cannot be written. An interrupted export
        continues when the same export is asked for again.

    Examples
    --------
    >>> from kpbench import export_dataset, open_dataset
    >>> export_dataset(open_dataset("kpbench-data"), "coco", "coco").name
    'annotations.json'
    """
    if file_format not in EXPORT_FORMATS:
        raise DataError(f"`file_format` is {file_format!r}, expected one of: {', '.join(EXPORT_FORMATS)}")
    folder = Path(out)
    share = f"{val_share:g}" if file_format in SPLIT_FORMATS else ""
    digest = hashlib.sha256(f"{dataset.fingerprint} {share}".encode()).hexdigest()
    mark, content = folder / UNFINISHED, f"{EXPORT_MARK} {file_format} {digest}\n".encode()
    if folder.is_dir() and any(path.name != LOCK_FILE for path in folder.iterdir()):
        if not mark.is_file():
            raise DataError(f"{folder}: is not empty; name a new folder as `out`")
        if mark.read_bytes() != content:
            raise DataError(f"{folder}: holds another unfinished export; name a new folder as `out`")
    splits = split_scenes(dataset.truth, val_share) if file_format in SPLIT_FORMATS else []
    with lock_folder(make_folder(folder)):
        for part in filter(is_leftover, folder.rglob(".*.part")):  # of a killed run
            part.unlink()
        require_space(folder, _expected_bytes(dataset), f"{len(dataset)} images")
        write_file(mark, content)
        main_file = EXPORT_FORMATS[file_format](dataset, folder, progress, splits)
        write_card(dataset, folder, EXPORT_USAGE[file_format])
        remove_file(mark, "export")
    return main_file


def _expected_bytes(dataset: Dataset | CocoDataset) -> int:
    """Return about how many bytes the images of a dataset need."""
    if isinstance(dataset, Dataset):
        return sum(shard.bytes for shard in dataset.shards)
    return len(dataset) * dataset.image(0).nbytes // 2


def _disc_boxes(keypoints: NDArray[Any], width: int, height: int) -> Float:
    """Return the bounding boxes of the projected discs, clipped to the image.

    The ellipse of a disc follows from ``H_patch2image``. Where that is zero, unknown, it follows from its semi-axes.

    Returns
    -------
    ndarray of shape (n, 4), float64
        x, y, width and height, px. The origin is the top-left corner of the top-left pixel.
    """
    centre, half_size = project_disc_boxes(keypoints["H_patch2image"])
    unknown = ~keypoints["H_patch2image"].any(axis=(1, 2))
    if unknown.any():
        k = keypoints[unknown]
        c, s = (np.square(v) for v in cos_sin(np.radians(k["axis_angle"].astype(np.float64))))
        major, minor = (np.square(k[name].astype(np.float64)) for name in ("radius_major", "radius_minor"))
        centre[unknown] = np.column_stack([k["x"], k["y"]])
        half_size[unknown] = np.sqrt(np.column_stack([major * c + minor * s, major * s + minor * c]))
    low = np.clip(centre - half_size + 0.5, 0, [width, height])
    high = np.clip(centre + half_size + 0.5, 0, [width, height])
    return np.hstack([low, high - low])


def _export_coco(dataset: Dataset | CocoDataset, folder: Path, progress: Progress, splits: list[str]) -> Path:
    """Write COCO keypoints. Each design is a category with one keypoint. Annotations also hold kpbench's columns."""
    make_folder(folder / "images")
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    ids = dataset.truth.image_id
    for n in range(len(dataset)):
        image, keypoints = dataset[n]
        name = f"{ids[n]:08d}.png"
        write_file(folder / "images" / name, encode_png(image, IMAGE_KIND))
        height, width = image.shape[:2]
        groups = _scoring_groups(dataset, n)
        images.append({"id": int(ids[n]), "file_name": name, "width": width, "height": height, **groups})
        ignored = dataset.ignored(n)
        rows = np.concatenate([keypoints, ignored])
        for row, (k, box) in enumerate(zip(rows, _disc_boxes(rows, width, height), strict=True)):
            is_judged = row < len(keypoints)
            annotations.append({
                "id": len(annotations) + 1,  # pycocotools takes id 0 for "no match"
                "image_id": int(ids[n]),
                "category_id": int(k["patch_id"]) + 1,
                "keypoints": [float(k["x"]), float(k["y"]), 2 if is_judged else 0],
                "num_keypoints": int(is_judged),
                "bbox": box.tolist(),
                "area": float(box[2] * box[3]),
                "iscrowd": int(not is_judged),
                "patch_id": int(k["patch_id"]),
                **{c: float(k[c]) for c in ("radius_major", "radius_minor", "axis_angle", "visible")},
            })  # fmt: skip
        progress(1)
    categories = [
        {
            "id": patch_id + 1,
            "name": escape_surrogates(name),
            "supercategory": "patch",
            "keypoints": ["centre"],
            "skeleton": [],
        }
        for patch_id, name in patch_names(dataset).items()
    ]
    # `kpbench score` compares this fingerprint with the fingerprint in the predictions
    info = {"description": f"kpbench dataset ({EXPORT_MARK})", "fingerprint": dataset.fingerprint}
    if source := image_source(dataset.config):
        info["source"] = source
    content = {"info": info, "licenses": [], "images": images, "annotations": annotations, "categories": categories}
    write_file(folder / "annotations.json", json.dumps(content, allow_nan=False).encode())
    return folder / "annotations.json"


def _scoring_groups(dataset: Dataset | CocoDataset, n: int) -> dict[str, Any]:
    """Return the groups of image n for scoring: the base scene, and for a suite the condition and the rung."""
    truth = dataset.truth
    scene = {"scene_id": int(truth.scene_id[n])}
    if not truth.condition[n]:
        return scene
    rung = {} if np.isnan(truth.rung[n]) else {"rung": float(truth.rung[n])}
    return {"condition": str(truth.condition[n]), **rung, **scene}


def _export_yolo(dataset: Dataset | CocoDataset, folder: Path, progress: Progress, splits: list[str]) -> Path:
    """Write YOLO-pose: one text file per image, with lengths as fractions of the image's width or height."""
    for split in {*splits}:
        for name in ("images", "labels"):
            make_folder(folder / name / split)
    ids = dataset.truth.image_id
    names = patch_names(dataset)
    classes = {patch_id: n for n, patch_id in enumerate(names)}
    for n in range(len(dataset)):
        image, keypoints = dataset[n]
        height, width = image.shape[:2]
        lines = []
        for k, (x, y, w, h) in zip(keypoints, _disc_boxes(keypoints, width, height), strict=True):
            numbers = [(x + w / 2) / width, (y + h / 2) / height, w / width, h / height]
            numbers += [(k["x"] + 0.5) / width, (k["y"] + 0.5) / height]
            lines.append(f"{classes[int(k['patch_id'])]} {' '.join(f'{v:.9f}' for v in numbers)} 2\n")
        write_file(folder / "images" / splits[n] / f"{ids[n]:08d}.png", encode_png(image, IMAGE_KIND))
        write_file(folder / "labels" / splits[n] / f"{ids[n]:08d}.txt", "".join(lines).encode())
        progress(1)
    listing = "".join(f"  {classes[patch_id]}: {escape_yaml(name)}\n" for patch_id, name in names.items())
    # without a key `path`, YOLO looks for the folders beside this file
    train, val = (f"images/{split if split in splits else SPLITS[0]}" for split in SPLITS)
    text = f"# {EXPORT_MARK}\ntrain: {train}\nval: {val}\nkpt_shape: [1, 3]\nnames:\n{listing}"
    write_file(folder / "data.yaml", text.encode())
    return folder / "data.yaml"


def _export_webdataset(dataset: Dataset | CocoDataset, folder: Path, progress: Progress, splits: list[str]) -> Path:
    """Write WebDataset: one tar per shard, with a PNG and a JSON per image. Equal datasets give equal bytes."""
    ids = dataset.truth.image_id
    starts = (
        [s.first for s in dataset.shards] if isinstance(dataset, Dataset) else range(0, len(dataset), IMAGES_PER_TAR)
    )
    for number, (first, end) in enumerate(pairwise([*starts, len(dataset)])):
        buffer = io.BytesIO()
        with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as tar:
            for n in range(first, end):
                image, keypoints = dataset[n]
                columns = {name: _to_json_numbers(keypoints[name]) for name in KEYPOINT_DTYPE.names or ()}
                label = {"image_id": int(ids[n]), "keypoints": columns, "degradations": dataset.effects(n)}
                for suffix, data in (
                    ("png", encode_png(image, IMAGE_KIND)),
                    ("json", json.dumps(label, allow_nan=False).encode()),
                ):
                    entry = tarfile.TarInfo(f"{ids[n]:08d}.{suffix}")
                    entry.size = len(data)
                    tar.addfile(entry, io.BytesIO(data))
                progress(1)
        write_file(folder / f"shard-{number:05d}.tar", buffer.getvalue())
    return folder / "shard-00000.tar"


def _to_json_numbers(column: NDArray[Any]) -> list[Any]:
    """Return a column as a list with None in place of nan. None becomes null in JSON; JSON has no nan."""
    return [None if value != value else value for value in column.tolist()]


def _export_parquet(dataset: Dataset | CocoDataset, folder: Path, progress: Progress, splits: list[str]) -> Path:
    """Write Parquet for Hugging Face ``datasets``, and Croissant metadata."""
    export_parquet(dataset, folder, progress, splits)
    return write_croissant(dataset, folder, splits)


EXPORT_FORMATS: dict[str, Callable[[Dataset | CocoDataset, Path, Progress, list[str]], Path]] = {
    "coco": _export_coco,
    "yolo": _export_yolo,
    "webdataset": _export_webdataset,
    "parquet": _export_parquet,
}
SPLIT_FORMATS = ("yolo", "parquet")
"""Formats that keep training and validation apart."""
