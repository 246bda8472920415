"""A dataset in the formats of other tools: COCO keypoints, YOLO-pose, WebDataset.

kpbench and COCO's keypoints count from the centre of the top-left pixel; boxes, and all of YOLO's
coordinates, from its corner, half a pixel further up and left.
"""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.dataset.card import names, write_card
from kpbench.dataset.folder import Dataset
from kpbench.errors import DataError
from kpbench.files import make_folder, write_atomic
from kpbench.images import encode_png
from kpbench.types import KEYPOINT_DTYPE

Progress = Callable[[int], None]


def export_dataset(dataset: Dataset, form: str, out: str | Path, progress: Progress = lambda images: None) -> Path:
    """Write a dataset in another format into a new or empty folder.

    Parameters
    ----------
    dataset : Dataset
    form : "coco", "yolo" or "webdataset"
    out : folder
    progress : called as images are written.

    Returns
    -------
    Path
        The file that names all others: ``annotations.json``, ``data.yaml``, or the first tar.

    Raises
    ------
    DataError
        If the format is unknown, the folder holds something, or it cannot be written.
    """
    if form not in FORMATS:
        raise DataError(f"format is {form!r}, expected one of: {', '.join(FORMATS)}")
    folder = Path(out)
    if folder.is_dir() and any(folder.iterdir()):
        raise DataError(f"{folder}: is not empty; name a new folder with --out")
    make_folder(folder)
    named = FORMATS[form](dataset, folder, progress)
    write_card(dataset, folder)
    return named


def _boxes(keypoints: NDArray[Any], width: int, height: int) -> NDArray[np.float64]:
    """Boxes around the projected discs, cut at the image, px from the corner: (n, 4) of x, y, w, h."""
    H = keypoints["H_patch2image"]
    dual = H @ np.diag([1.0, 1.0, -1.0]) @ H.transpose(0, 2, 1)  # see geometry.project_disc
    dual = dual / dual[:, 2:, 2:]
    centre = dual[:, :2, 2]
    half = np.sqrt(centre**2 - dual[:, (0, 1), (0, 1)])
    low = np.clip(centre - half + 0.5, 0, [width, height])
    high = np.clip(centre + half + 0.5, 0, [width, height])
    return np.hstack([low, high - low])


def _coco(dataset: Dataset, folder: Path, progress: Progress) -> Path:
    """COCO keypoints: a category a design with one keypoint, plus kpbench's own columns."""
    (folder / "images").mkdir()
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    ids = dataset.truth.image_id
    for n in range(len(dataset)):
        image, keypoints = dataset[n]
        name = f"{ids[n]:08d}.png"
        write_atomic(folder / "images" / name, encode_png(image))
        height, width = image.shape[:2]
        images.append({"id": int(ids[n]), "file_name": name, "width": width, "height": height, **_origin(dataset, n)})
        for k, box in zip(keypoints, _boxes(keypoints, width, height), strict=True):
            annotations.append(
                {
                    "id": len(annotations) + 1,  # pycocotools takes id 0 for "no match"
                    "image_id": int(ids[n]),
                    "category_id": int(k["patch_id"]) + 1,
                    "keypoints": [float(k["x"]), float(k["y"]), 2],
                    "num_keypoints": 1,
                    "bbox": box.tolist(),
                    "area": float(box[2] * box[3]),
                    "iscrowd": 0,
                    "patch_id": int(k["patch_id"]),
                    **{c: float(k[c]) for c in ("radius_major", "radius_minor", "axis_angle", "visible")},
                }
            )
        progress(1)
    categories = [
        {"id": i + 1, "name": name, "supercategory": "patch", "keypoints": ["centre"], "skeleton": []}
        for i, name in names(dataset).items()
    ]
    info = {"description": "kpbench dataset", "fingerprint": dataset.fingerprint}  # checked when scoring
    content = {"info": info, "licenses": [], "images": images, "annotations": annotations, "categories": categories}
    write_atomic(folder / "annotations.json", json.dumps(content).encode())
    return folder / "annotations.json"


def _origin(dataset: Dataset, n: int) -> dict[str, Any]:
    """What ``kpbench score`` groups an image by."""
    truth = dataset.truth
    known = {"condition": str(truth.condition[n]), "rung": float(truth.rung[n])} if truth.condition[n] else {}
    return {**known, "scene_id": int(truth.scene_id[n])}


def _yolo(dataset: Dataset, folder: Path, progress: Progress) -> Path:
    """YOLO-pose: a text file an image, all lengths as fractions of the image."""
    for name in ("images", "labels"):
        (folder / name).mkdir()
    ids = dataset.truth.image_id
    called = names(dataset)
    classes = {patch_id: n for n, patch_id in enumerate(called)}
    for n in range(len(dataset)):
        image, keypoints = dataset[n]
        height, width = image.shape[:2]
        lines = []
        for k, (x, y, w, h) in zip(keypoints, _boxes(keypoints, width, height), strict=True):
            numbers = [(x + w / 2) / width, (y + h / 2) / height, w / width, h / height]
            numbers += [(k["x"] + 0.5) / width, (k["y"] + 0.5) / height]
            lines.append(f"{classes[int(k['patch_id'])]} {' '.join(f'{v:.9f}' for v in numbers)} 2\n")
        write_atomic(folder / "images" / f"{ids[n]:08d}.png", encode_png(image))
        write_atomic(folder / "labels" / f"{ids[n]:08d}.txt", "".join(lines).encode())
        progress(1)
    listed = "".join(f"  {classes[i]}: {json.dumps(name)}\n" for i, name in called.items())
    # without a path, folders are those beside this file
    text = f"train: images\nval: images\nkpt_shape: [1, 3]\nnames:\n{listed}"
    write_atomic(folder / "data.yaml", text.encode())
    return folder / "data.yaml"


def _webdataset(dataset: Dataset, folder: Path, progress: Progress) -> Path:
    """WebDataset: a tar a shard, a PNG and a JSON a sample; the same dataset gives the same bytes."""
    ids = dataset.truth.image_id
    for number, shard in enumerate(dataset.shards):
        buffer = io.BytesIO()
        with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as tar:
            for n in range(shard.first, shard.first + shard.count):
                image, keypoints = dataset[n]
                columns = {name: _numbers(keypoints[name]) for name in KEYPOINT_DTYPE.names or ()}
                label = {"image_id": int(ids[n]), "keypoints": columns, "degradations": dataset.effects(n)}
                for suffix, data in (("png", encode_png(image)), ("json", json.dumps(label, allow_nan=False).encode())):
                    entry = tarfile.TarInfo(f"{ids[n]:08d}.{suffix}")
                    entry.size = len(data)
                    tar.addfile(entry, io.BytesIO(data))
                progress(1)
        write_atomic(folder / f"shard-{number:05d}.tar", buffer.getvalue())
    return folder / "shard-00000.tar"


def _numbers(column: NDArray[Any]) -> list[Any]:
    """A column for JSON, which has no nan: null stands for it."""
    return [None if value != value else value for value in column.tolist()]


FORMATS: dict[str, Callable[[Dataset, Path, Progress], Path]] = {
    "coco": _coco,
    "yolo": _yolo,
    "webdataset": _webdataset,
}
