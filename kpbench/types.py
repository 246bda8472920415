"""Tables that pass between the stages: true keypoints, and detections of one image and of many images.

The stages that make tables and the stages that read tables share this module. The evaluator therefore never imports the
generator.

Coordinates are px. The centre of the top-left pixel is (0, 0), x points right and y points down.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.errors import PredictionsError
from kpbench.validity import as_whole, check_columns

Int = NDArray[np.int64]
Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]

KEYPOINT_DTYPE = np.dtype(
    [
        ("x", "<f8"),  # px, of the disc's centre
        ("y", "<f8"),
        ("patch_id", "<i2"),
        ("radius_major", "<f4"),  # px, semi-axes of the disc's ellipse in the image
        ("radius_minor", "<f4"),
        ("axis_angle", "<f4"),  # degrees, direction of the major axis from +x towards +y, in [0, 180)
        ("H_patch2image", "<f8", (3, 3)),  # homography from the patch frame (unit disc) to px
        ("visible", "<f4"),  # fraction of the disc that lies inside the image and is not occluded
        ("contrast", "<f4"),  # grey levels, white minus black, after deterioration
    ]
)
"""Record type of one true keypoint, as in ``/keypoints`` of a shard."""
LABELLED_KEYPOINT_DTYPE = np.dtype(
    [
        *KEYPOINT_DTYPE.descr,
        ("sigma_x", "<f4"),  # px, standard deviation of the error of x
        ("sigma_y", "<f4"),
        ("rho", "<f4"),  # correlation of the errors of x and y
    ]
)
"""Record type of one keypoint of a labelled photograph, whose truth has an error.

A row whose ``sigma_x`` is infinite is *ignored*: a patch is there that nobody judges, such as a covered one.
"""


def is_ignored(keypoints: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which rows of a table of keypoints are ignored, see :data:`LABELLED_KEYPOINT_DTYPE`."""
    if "sigma_x" not in (keypoints.dtype.names or ()):
        return np.zeros(len(keypoints), bool)
    return np.asarray(np.isposinf(keypoints["sigma_x"]))


@dataclass(frozen=True)
class Detections:
    """Detections of one image.

    Attributes
    ----------
    xy : ndarray of shape (n, 2), float64
        Points in px. The centre of the top-left pixel is (0, 0).
    score : ndarray of shape (n,), float64
        Confidence. A higher score means a surer detection.
    patch_id : ndarray of shape (n,), int64, or None
        Identity of each point; None if the detector does not identify patches.
    A_patch2image : ndarray of shape (n, 2, 2), float64, or None
        Affine frame of each patch: the map from the unit disc of the patch to the image, px, without the shift to
        ``xy``. It holds the ellipse and the rotation.
    covariance : ndarray of shape (n, 2, 2), float64, or None
        Covariance of the error of ``xy``, px².
    blur_px : ndarray of shape (n,), float64, or None
        Standard deviation of the image blur at each patch, px.

    Raises
    ------
    ValueError
        If the shapes disagree, or an identity is no whole number.

    Examples
    --------
    >>> from kpbench import Detections
    >>> found = Detections(xy=[[10.5, 20.0], [30.0, 5.25]], score=[0.9, 0.4], patch_id=[2, 0])
    >>> len(found)
    2
    >>> found[found.score > 0.5].xy
    array([[10.5, 20. ]])
    """

    xy: Float
    score: Float
    patch_id: NDArray[np.int64] | None = None
    A_patch2image: Float | None = None
    covariance: Float | None = None
    blur_px: Float | None = None

    def __post_init__(self) -> None:
        assign = object.__setattr__
        xy = np.asarray(self.xy, np.float64)
        if xy.size and (xy.ndim != 2 or xy.shape[1] != 2):
            raise ValueError(f"xy has shape {xy.shape}, expected (n, 2)")
        assign(self, "xy", xy.reshape(-1, 2))
        assign(self, "score", np.asarray(self.score, np.float64).reshape(-1))
        if len(self.score) != len(self.xy):
            raise ValueError(f"{len(self.xy)} points have {len(self.score)} scores, expected one per point")
        if self.patch_id is not None:
            ids = np.asarray(self.patch_id)
            if ids.size and not (np.isfinite(ids) & (ids == np.rint(ids))).all():
                raise ValueError("patch_id holds numbers that are not whole")
            assign(self, "patch_id", ids.astype(np.int64).reshape(-1))
            if ids.size != len(self.xy):
                raise ValueError(f"{len(self.xy)} points have {ids.size} patch IDs, expected one per point")
        for name, shape in (("A_patch2image", (2, 2)), ("covariance", (2, 2)), ("blur_px", ())):
            if getattr(self, name) is not None:
                column = np.asarray(getattr(self, name), np.float64)
                if column.shape != (len(self.xy), *shape):
                    raise ValueError(f"{name} has shape {column.shape}, expected {(len(self.xy), *shape)}")
                assign(self, name, column)

    def __len__(self) -> int:
        return len(self.xy)

    def __getitem__(self, keep: Any) -> Detections:
        """Return the detections that a mask, a slice or an index array selects."""
        optional = (self.patch_id, self.A_patch2image, self.covariance, self.blur_px)
        return Detections(self.xy[keep], self.score[keep], *(None if c is None else c[keep] for c in optional))

    @classmethod
    def none(cls, with_ids: bool = True) -> Detections:
        """Return an empty table, with or without the column of identities."""
        empty = np.zeros(0, np.int64) if with_ids else None
        return cls(np.zeros((0, 2)), np.zeros(0), empty)


@dataclass(frozen=True)
class Truth:
    """True keypoints of N images as one table. The rows of image ``i`` are ``offsets[i]:offsets[i + 1]``.

    Attributes
    ----------
    image_id : ndarray of shape (N,), int64
        Unique.
    offsets : ndarray of shape (N + 1,), int64
        First row of each image, and the number of all rows.
    keypoints : ndarray of shape (offsets[-1],), KEYPOINT_DTYPE
        One record per true keypoint.
    condition : ndarray of shape (N,), str
        Name of the condition of each image; "" for none.
    rung : ndarray of shape (N,), float64
        Severity within the condition; nan for none.
    scene_id : ndarray of shape (N,), int64
        Images of one base scene share this number. The bootstrap draws whole scenes.
    fingerprint : str
        Fingerprint of the dataset; "" for none.
    recipe : str
        SHA-256 of the dataset's config without the software that made the pixels; "" for none.
    file : tuple of N str, or None
        Name of each image's file; "" for none. The datasets of :func:`kpbench.generate` have no such names.
    ignored : ndarray of shape (M,), KEYPOINT_DTYPE, or None
        Patches that are not judged: a detection near one of them counts neither way.
    ignored_image : ndarray of shape (M,), int64, or None
        Index of the image of each ignored patch.

    Examples
    --------
    >>> import kpbench
    >>> truth = kpbench.open_dataset("kpbench-data").truth
    >>> len(truth)
    6
    >>> truth.keypoints.dtype == kpbench.KEYPOINT_DTYPE
    True
    """

    image_id: NDArray[np.int64]
    offsets: NDArray[np.int64]
    keypoints: NDArray[Any]
    condition: NDArray[np.str_]
    rung: Float
    scene_id: NDArray[np.int64]
    fingerprint: str = ""
    recipe: str = ""
    file: tuple[str, ...] | None = None
    ignored: NDArray[Any] | None = None
    ignored_image: NDArray[np.int64] | None = None

    def __len__(self) -> int:
        return len(self.image_id)

    @property
    def digest(self) -> str:
        """SHA-256 over ``recipe`` and all columns but ``contrast``, which is measured in the pixels; "" without recipe.

        Datasets of one digest show the same scenes, degraded in the same way. If their fingerprints differ, their
        pixels were made by different software.
        """
        if not self.recipe:
            return ""
        whole = hashlib.sha256(self.recipe.encode())
        names = [name for name in KEYPOINT_DTYPE.names or () if name != "contrast"]
        condition = "\n".join(self.condition.tolist()).encode("utf-8", "surrogatepass")
        columns = (self.image_id, self.offsets, self.rung, self.scene_id, *(self.keypoints[name] for name in names))
        for column in columns:
            whole.update(np.ascontiguousarray(column).tobytes())
        whole.update(condition)
        return whole.hexdigest()


UNKNOWN: dict[str, Any] = {"file": "", "size": 0, "frame_index": -1, "time_s": np.nan, "ms": np.nan}
"""Optional columns of the images in :class:`Predictions`, and the value that stands for an unknown one."""


@dataclass(frozen=True)
class Predictions:
    """Detections of N images as columns. The rows of image ``i`` are ``offsets[i]:offsets[i + 1]``.

    Attributes
    ----------
    image_id : ndarray of shape (N,), int64
        Unique, 0 or more, in any order.
    offsets : ndarray of shape (N + 1,), int64
        First row of each image, and the number of all rows.
    xy : ndarray of shape (K, 2), float64
        Points in px. The centre of the top-left pixel is (0, 0).
    score : ndarray of shape (K,), float64
        Confidence. A higher score means a surer detection.
    patch_id : ndarray of shape (K,), int64, or None
        Identity of each point, 0 or more; None if the detector does not identify patches.
    A_patch2image, covariance, blur_px : ndarray with K rows, float64, or None
        As in :class:`Detections`. A covariance is symmetric and positive semi-definite.
    board, points : ndarray of shape (K,), int64, or None
        Number of the board that each detection is a part of, in ``boards``, and index of the board's keypoint; -1 for
        none. A detection of a board whose points are ambiguous has a board and no point. Both are given or none.
    probability : ndarray of shape (K,), float64, or None
        Probability of the most probable point of each detection, also of one that is ambiguous; 0 for no board.
    boards : tuple of str
        Names of the boards that were looked for.
    file : tuple of N str, or None
        Name of each image's file, as it was given; "" for none. All frames of a film have the name of the film.
    size : ndarray of shape (N, 2), int64, or None
        Width and height of each image, px; 0 if unknown.
    frame_index : ndarray of shape (N,), int64, or None
        Number of the frame in its film, from 0; -1 if unknown.
    time_s : ndarray of shape (N,), float64, or None
        Time of the frame, s from the start of its film; nan if unknown.
    ms : ndarray of shape (N,), float64, or None
        Time that the detector took, milliseconds; nan if unknown.
    detector : dict
        Name and settings of the detector, such as ``{"name": "superpoint", "version": "1"}``.
    dataset : str or None
        Path or fingerprint of the dataset.
    fingerprint : str or None
        Fingerprint of the dataset. Scoring compares this fingerprint with the fingerprint of the truth.
    truth_digest : str or None
        :attr:`Truth.digest` of the dataset. If only the fingerprints differ, scoring warns of other pixels.

    Raises
    ------
    PredictionsError
        If the columns do not fit each other, or a value is impossible. The message names image and keypoint.

    Examples
    --------
    >>> from kpbench import Detections, Predictions
    >>> found = [Detections([[3.0, 4.0]], [0.9], [1]), Detections.none()]
    >>> predictions = Predictions.from_detections(found, image_id=[7, 8])
    >>> predictions.offsets.tolist()
    [0, 1, 1]
    >>> len(predictions.detections())
    2
    """

    image_id: Int
    offsets: Int
    xy: Float
    score: Float
    patch_id: Int | None = None
    detector: dict[str, Any] = field(default_factory=dict)
    dataset: str | None = None
    fingerprint: str | None = None
    truth_digest: str | None = None
    A_patch2image: Float | None = None
    covariance: Float | None = None
    blur_px: Float | None = None
    file: tuple[str, ...] | None = None
    size: Int | None = None
    frame_index: Int | None = None
    time_s: Float | None = None
    ms: Float | None = None
    board: Int | None = None
    points: Int | None = None
    boards: tuple[str, ...] = ()
    probability: Float | None = None

    def __post_init__(self) -> None:
        assign = object.__setattr__
        assign(self, "image_id", np.ascontiguousarray(self.image_id, np.int64).reshape(-1))
        assign(self, "offsets", np.ascontiguousarray(self.offsets, np.int64).reshape(-1))
        assign(self, "xy", np.ascontiguousarray(self.xy, np.float64).reshape(-1, 2))
        assign(self, "score", np.ascontiguousarray(self.score, np.float64).reshape(-1))
        if self.patch_id is not None:
            assign(self, "patch_id", np.ascontiguousarray(self.patch_id, np.int64).reshape(-1))
        for name in ("A_patch2image", "covariance", "blur_px", "probability"):
            if getattr(self, name) is not None:
                assign(self, name, np.ascontiguousarray(getattr(self, name), np.float64))
        for name in ("board", "points"):
            if getattr(self, name) is not None:
                assign(self, name, as_whole(name, getattr(self, name)))
        for name, unknown in UNKNOWN.items():
            values = getattr(self, name)
            if values is not None and name != "file":
                values = np.ascontiguousarray(values, np.float64) if np.isnan(unknown) else as_whole(name, values)
                values = None if (np.isnan(values) | (values == unknown)).all() else values
            elif values is not None:
                values = tuple(values) if any(values) else None
            assign(self, name, values)
        check_columns(self)
        if self.covariance is not None:  # symmetric to the last bit, as tables hold three numbers of each matrix
            assign(self, "covariance", (self.covariance + self.covariance.transpose(0, 2, 1)) / 2)

    def __len__(self) -> int:
        return len(self.image_id)

    @classmethod
    def from_detections(
        cls,
        detections: Iterable[Detections],
        image_id: Sequence[int] | Int | None = None,
        detector: dict[str, Any] | None = None,
        dataset: str | None = None,
        fingerprint: str | None = None,
        truth_digest: str | None = None,
        **of_images: Any,
    ) -> Predictions:
        """Make predictions from one :class:`Detections` per image.

        Parameters
        ----------
        detections : iterable of Detections
            One element per image. All or none of the elements with detections have identities, and so have the other
            optional columns.
        image_id : sequence of int, optional
            0, 1, 2, … if left out.
        detector, dataset, fingerprint, truth_digest
            See :class:`Predictions`.
        **of_images
            Columns of the images: `file`, `size`, `frame_index`, `time_s`, `ms`, see :class:`Predictions`.

        Raises
        ------
        PredictionsError
            As raised by :class:`Predictions`, or if only some of the elements with detections have an optional column.
        """
        listed = list(detections)
        found = [d for d in listed if len(d)]

        def join(name: str, label: str) -> NDArray[Any] | None:
            columns = [getattr(d, name) for d in found if getattr(d, name) is not None]
            if columns and len(columns) < len(found):
                raise PredictionsError(
                    f"some images have {label} and others have none; give {label} to all detections or to none"
                )
            return np.concatenate(columns) if columns else None

        return cls(
            image_id=np.arange(len(listed)) if image_id is None else np.asarray(image_id, np.int64),
            offsets=offsets_of([len(d) for d in listed]),
            xy=np.concatenate([np.zeros((0, 2)), *(d.xy for d in found)]),
            score=np.concatenate([np.zeros(0), *(d.score for d in found)]),
            patch_id=join("patch_id", "ids") if found else np.zeros(0, np.int64),
            detector=detector or {},
            dataset=dataset,
            fingerprint=fingerprint,
            truth_digest=truth_digest,
            A_patch2image=join("A_patch2image", "A_patch2image"),
            covariance=join("covariance", "covariance"),
            blur_px=join("blur_px", "blur_px"),
            **of_images,
        )

    def detections(self) -> list[Detections]:
        """Return one :class:`Detections` per image, in the order of ``image_id``."""
        columns = (self.xy, self.score, self.patch_id, self.A_patch2image, self.covariance, self.blur_px)
        return [
            Detections(*(None if c is None else c[a:b] for c in columns))  # type: ignore[arg-type]
            for a, b in pairwise(self.offsets.tolist())
        ]


def offsets_of(counts: Sequence[int] | Int) -> Int:
    """Return the first row of each image and the number of all rows, shape (N + 1,), from N counts of rows."""
    return np.concatenate([[0], np.cumsum(counts, dtype=np.int64)]).astype(np.int64)
