"""What differs between the same images of two datasets: their keypoints and their pixels."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from kpbench.dataset.folder import Dataset
from kpbench.predictions.coco import CocoDataset
from kpbench.types import Int, Truth, UInt8

UNMOVED_PX = 1e-6
"""Largest distance of a keypoint from its old place that is no movement: rounding of other software."""


@dataclass(frozen=True)
class TruthChanges:
    """The differences between the keypoints of the images that two datasets share.

    Attributes
    ----------
    matched_by : str
        "file" if images are matched by the names of their files, "image_id" if one of the datasets has no names.
    common : int
        Number of images in both datasets.
    only_a, only_b : tuple of str
        Names, or IDs, of the images that only one dataset has.
    changed : int
        Number of common images whose keypoints differ in any column, or whose ignored patches differ.
    added, removed : int
        Number of keypoints that only the second or only the first dataset has.
    moved_px : tuple of float
        Distances of the keypoints that moved, px, in rising order. A keypoint is the same in both datasets if it moved
        by at most its radius. Pairs are chosen so that they are as many as possible, then as near as possible.
    id_changed : int
        Number of keypoints in both datasets whose ``patch_id`` differs.
    columns : dict of str to int
        For every other column that both datasets tell: number of keypoints in both whose value differs.

    Examples
    --------
    >>> import kpbench
    >>> dataset = kpbench.open_dataset("kpbench-data")
    >>> kpbench.diff(dataset, dataset).truth.changed
    0
    """

    matched_by: str
    common: int
    only_a: tuple[str, ...]
    only_b: tuple[str, ...]
    changed: int
    added: int
    removed: int
    moved_px: tuple[float, ...]
    id_changed: int
    columns: dict[str, int]

    def to_dict(self) -> dict[str, Any]:
        """Return ``truth`` of the file of differences. Movements are summarised."""
        moved = np.array(self.moved_px)
        summary = [float(f(moved)) if len(moved) else None for f in (np.median, lambda d: np.quantile(d, 0.95), np.max)]
        movement = {"count": len(moved), **dict(zip(("median", "quantile_95", "largest"), summary, strict=True))}
        return {**vars(self), "moved_px": movement}


@dataclass(frozen=True)
class PixelChanges:
    """The differences between the pixels of the images that two datasets share.

    Attributes
    ----------
    compared : int
        Number of images compared.
    other_size : int
        Number of images whose width or height differ. Their pixels are not compared.
    changed : int
        Number of images of one size with a pixel that differs.
    mean_levels : float or None
        Mean absolute difference of a changed image, grey levels: the median over the changed images.
    largest_levels : int or None
        Largest difference of a pixel, grey levels, over all images.

    Examples
    --------
    >>> import kpbench
    >>> dataset = kpbench.open_dataset("kpbench-data")
    >>> kpbench.diff(dataset, dataset).pixels
    PixelChanges(compared=6, other_size=0, changed=0, mean_levels=None, largest_levels=None)
    """

    compared: int
    other_size: int
    changed: int
    mean_levels: float | None
    largest_levels: int | None


def pair_images(a: Truth, b: Truth) -> tuple[str, Int, Int]:
    """Find the images that two datasets share.

    Returns
    -------
    matched_by : str
        "file" if both datasets name every image once, else "image_id".
    index_a, index_b : ndarray of shape (N,), int64
        Index of each common image, in the order of ``a``.
    """
    by_file = all(t.file is not None and all(t.file) and len(set(t.file)) == len(t) for t in (a, b))
    keys_a, keys_b = ([*(t.file or ())] if by_file else t.image_id.tolist() for t in (a, b))
    index = {key: n for n, key in enumerate(keys_b)}
    common = np.array([(n, index[key]) for n, key in enumerate(keys_a) if key in index], np.int64).reshape(-1, 2)
    return ("file" if by_file else "image_id"), common[:, 0], common[:, 1]


def compare_truth(a: Truth, b: Truth) -> TruthChanges:
    """Compare the keypoints of the images that two datasets share."""
    matched_by, index_a, index_b = pair_images(a, b)
    shared = [name for name in a.keypoints.dtype.names or () if _tells(a, name) and _tells(b, name)]
    pairs: list[tuple[NDArray[Any], NDArray[Any]]] = []
    changed = added = removed = 0
    for n, m in zip(index_a.tolist(), index_b.tolist(), strict=True):
        old, new = (t.keypoints[t.offsets[k] : t.offsets[k + 1]] for t, k in ((a, n), (b, m)))
        rows_old, rows_new = _pair_keypoints(old, new)
        pairs.append((old[rows_old], new[rows_new]))
        added, removed = added + len(new) - len(rows_new), removed + len(old) - len(rows_old)
        is_same = len(old) == len(new) == len(rows_old) and _have_same_ignored(a, n, b, m)
        changed += not (is_same and not any(_differ(*pairs[-1], name).any() for name in shared))
    old = np.concatenate([a.keypoints[:0], *(pair[0] for pair in pairs)])
    new = np.concatenate([b.keypoints[:0], *(pair[1] for pair in pairs)])
    moved = np.hypot(new["x"] - old["x"], new["y"] - old["y"])
    others = [name for name in shared if name not in ("x", "y", "patch_id")]
    return TruthChanges(
        matched_by=matched_by,
        common=len(index_a),
        only_a=_name_others(a, index_a, matched_by),
        only_b=_name_others(b, index_b, matched_by),
        changed=changed,
        added=added,
        removed=removed,
        moved_px=tuple(np.sort(moved[moved > UNMOVED_PX]).tolist()),
        id_changed=int((old["patch_id"] != new["patch_id"]).sum()),
        columns={name: int(_differ(old, new, name).sum()) for name in others},
    )


def _have_same_ignored(a: Truth, n: int, b: Truth, m: int) -> bool:
    """Return whether an image has the same ignored patches in both datasets."""
    rows = [set[Any](), set[Any]()]
    for found, t, k in zip(rows, (a, b), (n, m), strict=True):
        if t.ignored is not None and t.ignored_image is not None:
            of_image = slice(*np.searchsorted(t.ignored_image, (k, k + 1)))
            found.update(t.ignored[of_image][["x", "y", "patch_id"]].tolist())
    return rows[0] == rows[1]


def _tells(truth: Truth, name: str) -> bool:
    """Return whether a dataset tells a column. COCO annotations tell no contrast (nan) and no homography (0)."""
    if name not in (truth.keypoints.dtype.names or ()):
        return False
    values = truth.keypoints[name]
    return name not in ("contrast", "H_patch2image") or bool((np.isfinite(values) & (values != 0)).any())


def _name_others(truth: Truth, common: Int, matched_by: str) -> tuple[str, ...]:
    """Return the names or IDs of the images that are not common."""
    rest = np.setdiff1d(np.arange(len(truth)), common).tolist()
    return tuple(truth.file[n] if matched_by == "file" and truth.file else str(truth.image_id[n]) for n in rest)


def _differ(old: NDArray[Any], new: NDArray[Any], name: str) -> NDArray[np.bool_]:
    """Return whether a column differs in each row. nan equals nan."""
    is_same = (old[name] == new[name]) | ((old[name] != old[name]) & (new[name] != new[name]))
    return np.asarray(~is_same.reshape(len(old), -1 if len(old) else 1).all(axis=1))


def _pair_keypoints(old: NDArray[Any], new: NDArray[Any]) -> tuple[Int, Int]:
    """Return the rows of the keypoints that are the same: at most the smaller radius apart."""
    if len(old) == len(new) and (old["x"] == new["x"]).all() and (old["y"] == new["y"]).all():
        return np.arange(len(old)), np.arange(len(old))
    distance = np.hypot(old["x"][:, None] - new["x"], old["y"][:, None] - new["y"])
    reach = np.minimum(old["radius_major"][:, None], new["radius_major"])
    is_near = distance <= reach
    far = 1 + reach.sum()  # more than all distances together: the most pairs come first
    rows_old, rows_new = linear_sum_assignment(np.where(is_near, distance, far))
    kept = is_near[rows_old, rows_new]
    return rows_old[kept], rows_new[kept]


def compare_pixels(a: Dataset | CocoDataset, b: Dataset | CocoDataset, progress: Callable[[int], None]) -> PixelChanges:
    """Compare the pixels of the images that two datasets share. A grey image equals an RGB image of equal channels."""
    _, index_a, index_b = pair_images(a.truth, b.truth)
    other_size, means, largest = 0, list[float](), list[int]()
    for old, new in _read_pairs(a, index_a, b, index_b):
        progress(1)
        if old.shape[:2] != new.shape[:2]:
            other_size += 1
            continue
        if old.ndim != new.ndim:
            old, new = (image if image.ndim == 3 else image[..., None] for image in (old, new))
        difference = np.abs(old.astype(np.int16) - new)
        if difference.any():
            means.append(float(difference.mean()))
            largest.append(int(difference.max()))
    levels = (float(np.median(means)), max(largest)) if means else (None, None)
    return PixelChanges(len(index_a), other_size, len(means), *levels)


def _read_pairs(
    a: Dataset | CocoDataset, index_a: Int, b: Dataset | CocoDataset, index_b: Int
) -> Iterator[tuple[UInt8, UInt8]]:
    for n, m in zip(index_a.tolist(), index_b.tolist(), strict=True):
        yield a.image(n), b.image(m)
