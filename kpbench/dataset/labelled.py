"""Labelled images, whatever holds them: a dataset of kpbench, a COCO file, or a folder with a COCO file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from kpbench.dataset.folder import MANIFEST, Dataset, open_dataset
from kpbench.errors import DataError
from kpbench.files import folder_at
from kpbench.predictions.coco import CocoDataset, open_coco
from kpbench.types import Truth, UInt8

COCO_NAMES = ("annotations.json", "_annotations.coco.json")
"""File names of COCO annotations in a labelled folder: those of :func:`kpbench.export_dataset`, and of Roboflow."""


class LabelledImages(Protocol):
    """The attributes of a dataset that scoring and reports need.

    :class:`kpbench.Dataset` and COCO annotations have these attributes. A class of your own may have them too.

    Examples
    --------
    >>> import kpbench
    >>> dataset: kpbench.LabelledImages = kpbench.open_dataset("kpbench-data")
    >>> len(dataset.truth), dataset.image(0).shape
    (6, (480, 640))
    """

    @property
    def path(self) -> Path:
        """Folder of the dataset, or its annotations file."""
        ...

    @property
    def fingerprint(self) -> str:
        """Digest of the dataset, 64 hexadecimal digits."""
        ...

    @property
    def config(self) -> Mapping[str, Any]:
        """How the images were made, and the names of the patches; may be empty."""
        ...

    @property
    def truth(self) -> Truth:
        """The true keypoints of all images."""
        ...

    def image(self, index: int) -> UInt8:
        """Return the image at an index into the truth, as an array of shape (H, W) or (H, W, 3).

        Raises
        ------
        DataError
            If the image cannot be read.
        """
        ...


def find_coco(path: str | Path) -> Path | None:
    """Return the COCO annotations that a path names: the file itself, or that in a labelled folder. None if none."""
    given = folder_at(path)
    if given.suffix.lower() == ".json" and given.name != MANIFEST and not given.is_dir():
        return given
    return next((given / name for name in COCO_NAMES if (given / name).is_file()), None)


def is_labelled(path: str | Path) -> bool:
    """Return whether a path is for :func:`open_labelled`: a dataset, finished or not, or COCO annotations."""
    folder = folder_at(path)
    return (folder / MANIFEST).exists() or any(folder.glob("shard-*.h5")) or find_coco(path) is not None


def open_labelled(path: str | Path) -> Dataset | CocoDataset:
    """Open labelled images: a dataset of kpbench, a COCO file, or a folder with a COCO file.

    Every command that takes a dataset opens it with this function.

    Parameters
    ----------
    path : str or Path
        Folder or URL of a dataset, COCO annotations (.json), or a folder that holds ``annotations.json`` or
        ``_annotations.coco.json``. See :func:`kpbench.predictions.open_coco` for what annotations hold.

    Returns
    -------
    Dataset or CocoDataset

    Raises
    ------
    DataError
        If there are no labelled images, or their files cannot be read.

    Examples
    --------
    >>> import kpbench
    >>> folder = kpbench.export_dataset(kpbench.open_dataset("kpbench-data"), "coco", "coco").parent
    >>> labelled = kpbench.dataset.open_labelled(folder)
    >>> len(labelled), labelled.keypoints(0)["x"].shape, labelled.image(0).shape
    (6, (6,), (480, 640, 3))
    """
    folder = folder_at(path)
    annotations = None if (folder / MANIFEST).exists() else find_coco(path)
    dataset = open_dataset(path) if annotations is None else open_coco(annotations)
    if not len(dataset):
        raise DataError(f"{annotations}: lists no images")
    return dataset
