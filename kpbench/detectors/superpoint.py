"""The reference detector: a SuperPoint network from an ONNX file, decoded with NumPy and OpenCV.

The network divides the image into cells of 8x8 px and has two heads. The detector head gives a logit for each pixel of
a cell and for "no keypoint". The ID head gives a logit for each design and for "no patch", one set per cell.
:func:`decode` turns the logits of the detector head into one probability map at full resolution. A keypoint is the
centre of mass of the probability in a window around a local maximum. The window may cross the borders of cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.detectors.hypotheses import clipped_semi_axis
from kpbench.detectors.inference import open_session, runs_on_gpu, try_network
from kpbench.detectors.suppression import suppress
from kpbench.detectors.verification import WEIGHTS, verifier_version, verify_candidates
from kpbench.errors import DataError, system_reason
from kpbench.files import load_json, read_bytes
from kpbench.images import resize, to_grey
from kpbench.memory import require_memory
from kpbench.patches.design import parse_patch
from kpbench.toml import TomlTable, name_source
from kpbench.types import Detections, Float, Float32, UInt8

CELL_PX = 8
"""Side of a cell, px."""
SCHEMA = "kpbench.superpoint/1"
MOST_PEAKS = 10_000
"""Largest number of maxima of an image that are looked at, the best first. A trained network has a few hundred."""
MOST_DESIGNS = 256
"""Largest number of designs of a network."""
"""Schema of the metadata in the ONNX file."""
EMPTY_CELL_LOG_ODDS = float(np.log(2e-4))
"""A cell is empty if log(p / q) is at most this for every pixel, where p is the probability of the pixel and q the
probability of "no keypoint". Most cells are empty."""

# Settings of the verified detector. CANDIDATE_SCORE, SCALES and VERIFIED_THRESHOLD were chosen on synthetic images with
# training photographs as backgrounds. The measurements are in two sections of notebook/training-log.md:
# - "Weaker places, longer ellipses, and judges on their poses"
# - "Fewer looks, and what ten thousand more images were worth"
# The source of MERGE_DISTANCE_PX and DISC_SHARE is not recorded.
CANDIDATE_SCORE = 0.015
"""Least network score of a place that is verified."""
SCALES = (1.2, 0.5, 0.25)
"""Scales of the image that the network sees: enlarged for small patches, shrunk for large patches."""
VERIFIED_THRESHOLD = 0.3
"""Least score of a verified detection."""
MERGE_DISTANCE_PX = 3.0
"""If two candidates are nearer than this, px, only the better is kept, as two scales may find the same keypoint."""
DISC_SHARE = 0.6
"""If two detections are nearer than this, in short semi-axes of the better detection, only the better is kept."""


@dataclass(frozen=True)
class Decoding:
    """Settings of :func:`decode`.

    Attributes
    ----------
    threshold : float
        Least score of a keypoint: the probability that a keypoint lies in the window around the maximum, in [0, 1].
        A threshold below 0.01 still misses some keypoints, as the pixels of empty cells count as 0.
    separation_px : int
        If two maxima are nearer than this, px, only the better is kept. With the default, the centres of two discs side
        by side are both kept if the short axes of the discs are at least 10 px long.
    window_px : int
        Reach of the window around a maximum, px: the window is ``2 · window_px + 1`` px wide. The score is the sum of
        the probability in the window. The place is the centre of mass of this probability.

    Examples
    --------
    >>> from kpbench.detectors import Decoding
    >>> Decoding(threshold=0.3).window_px
    3
    """

    threshold: float = 0.5
    separation_px: int = 6
    window_px: int = 3


def decode(detector_logits: Float32, id_logits: Float32, decoding: Decoding | None = None) -> Detections:
    """Return the keypoints of one image from the logits of the network's two heads.

    Parameters
    ----------
    detector_logits : ndarray of shape (65, h, w), float32
        One channel per pixel of a cell, row by row, and a last channel for "no keypoint".
    id_logits : ndarray of shape (ids + 1, h, w), float32
        One channel per design, and a last channel for "no patch".
    decoding : Decoding, optional
        None: the defaults.

    Returns
    -------
    Detections
        ``xy`` in px of the (8h, 8w) image, best first. ``patch_id`` is the index of the ID head's likeliest design.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.detectors import decode
    >>> detector_logits, id_logits = np.zeros((65, 4, 4), np.float32), np.zeros((5, 4, 4), np.float32)
    >>> detector_logits[64] = 10                      # "no keypoint" in all cells ...
    >>> detector_logits[8 * 5 + 3, 2, 1] = 30         # ... but at row 5, column 3 of the cell in row 2, column 1
    >>> decode(detector_logits, id_logits).xy
    array([[11., 21.]])
    """
    xy, score = locate(detector_logits, decoding or Decoding())
    return Detections(xy, score, np.argmax(identify(id_logits, xy)[:, :-1], axis=1))


def locate(detector_logits: Float32, decoding: Decoding) -> tuple[Float, Float]:
    """Return places (n, 2) px and scores (n,) of keypoints from detector logits (65, h, w), best first."""
    probability = keypoint_probability(detector_logits)
    # a light smoothing removes small bumps, so that each blob has one maximum
    ranked = cv2.GaussianBlur(probability, (5, 5), 1.0, borderType=cv2.BORDER_CONSTANT)
    side = 2 * decoding.separation_px - 1
    highest = cv2.dilate(ranked, np.ones((side, side), np.uint8))
    width, offset = 2 * decoding.window_px + 1, np.arange(-decoding.window_px, decoding.window_px + 1)
    # a window whose sum reaches the threshold has a pixel of at least threshold / width²; 0.5 allows for the smoothing
    found = np.flatnonzero(ranked > 0.5 * decoding.threshold / width**2)  # many times faster than nonzero in 2-D
    found = found[ranked.ravel()[found] >= highest.ravel()[found]]
    rows, columns = np.divmod(found, probability.shape[1])
    windows = _windows(probability, rows[:, None] + offset, columns[:, None] + offset)
    total = windows.sum(axis=(1, 2))
    likely = np.flatnonzero(total >= decoding.threshold)
    likely = likely[np.argsort(-total[likely], kind="stable")[:MOST_PEAKS]] if len(likely) > MOST_PEAKS else likely
    rows, columns, windows, total = rows[likely], columns[likely], windows[likely], total[likely]
    x = columns + windows.sum(axis=1) @ offset / total
    y = rows + windows.sum(axis=2) @ offset / total
    xy = np.column_stack([x, y])
    score = np.minimum(total, 1.0).astype(np.float64)
    kept = suppress(xy, score, decoding.separation_px)
    return xy[kept], score[kept]


def _windows(image: Float32, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Float32:
    """Return windows (n, k, k) of an image at rows (n, k) and columns (n, k); 0 outside the image."""
    height, width = image.shape
    inside = ((rows >= 0) & (rows < height))[:, :, None] & ((columns >= 0) & (columns < width))[:, None]
    part = image[np.clip(rows, 0, height - 1)[:, :, None], np.clip(columns, 0, width - 1)[:, None]]
    return np.asarray(part * inside, np.float32)


def identify(id_logits: Float32, xy: Float) -> Float:
    """Return log probabilities (n, ids + 1) of each design and of "no patch" at places (n, 2) px."""
    logits = _interpolate_cells(id_logits, xy)
    logits = logits - logits.max(axis=1, keepdims=True)
    return np.asarray(logits - np.log(np.exp(logits).sum(axis=1, keepdims=True)))


def keypoint_probability(detector_logits: Float32) -> Float32:
    """Return the probability (8h, 8w) of a keypoint at each pixel, from detector logits (65, h, w).

    The probabilities of a cell are the softmax of its logits. All probabilities of an empty cell are set to 0.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.detectors import keypoint_probability
    >>> keypoint_probability(np.zeros((65, 3, 4), np.float32)).shape
    (24, 32)
    """
    _, h, w = detector_logits.shape
    rows, columns = np.nonzero(detector_logits[:-1].max(axis=0) - detector_logits[-1] > EMPTY_CELL_LOG_ODDS)
    logits = detector_logits[:, rows, columns]
    share = np.exp(logits - logits.max(axis=0))
    share = share[:-1] / share.sum(axis=0)
    probability = np.zeros((h, CELL_PX, w, CELL_PX), np.float32)
    probability[rows, :, columns] = share.T.reshape(-1, CELL_PX, CELL_PX)
    return probability.reshape(CELL_PX * h, CELL_PX * w)


def _interpolate_cells(cells: Float32, xy: Float) -> Float:
    """Interpolate a map of cells (C, h, w) bilinearly at places (n, 2) px. Return the values (n, C).

    Cell i is centred at 3.5 + 8i px.
    """
    _, h, w = cells.shape
    u = np.clip((xy - (CELL_PX - 1) / 2) / CELL_PX, 0, (w - 1, h - 1))
    low = np.minimum(u.astype(int), np.maximum((w - 2, h - 2), 0))
    (fx, fy), (j, i) = (u - low).T, low.T
    j1, i1 = np.minimum(j + 1, w - 1), np.minimum(i + 1, h - 1)
    top = cells[:, i, j] * (1 - fx) + cells[:, i, j1] * fx
    bottom = cells[:, i1, j] * (1 - fx) + cells[:, i1, j1] * fx
    return np.asarray((top * (1 - fy) + bottom * fy).T)


def _inside(xy: Float, image: UInt8) -> NDArray[np.bool_]:
    """Return whether places (n, 2) px lie in the image."""
    return np.asarray(np.all((xy > -0.5) & (xy < np.subtract(image.shape[1::-1], 0.5)), axis=1))


def pad_to_cells(grey: UInt8) -> UInt8:
    """Return an image whose last row and column are repeated until both sides are multiples of 8 px."""
    height, width = grey.shape
    return np.pad(grey, ((0, -height % CELL_PX), (0, -width % CELL_PX)), mode="edge")


@dataclass
class SuperPointDetector:
    """SuperPoint, whose candidates are compared with the designs; call the detector with an image.

    Attributes
    ----------
    path : Path, optional
        ONNX file written by ``kpbench export-model``. None: the weights that ship with kpbench, as 8-bit integers on a
        CPU and as float32 on a GPU.
    threshold : float, optional
        Least score of a detection, in [0, 1]. None: 0.3 if candidates are verified, else 0.5.
    verified : bool
        Whether the candidates of the network are compared with the designs in the file. The verification then gives
        centre, identity and score. False: the network alone decides, at the image's own scale. A design without an
        edge at its centre cannot be verified; ``verified`` becomes False if the file has such a design.
    threads : int
        Threads of the networks. 0 means the number of OpenCV's threads.
    scales : tuple of float
        Scales of the image that the network sees, if candidates are verified.
    shipped : str
        Name of the shipped weights, for ``path=None``.

    Raises
    ------
    DataError
        If the file cannot be read or was not written by kpbench, ``scales`` is empty, or a scale is not in (0, 16].

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.detectors import SmallSuperPointDetector
    >>> detector = SmallSuperPointDetector(threshold=0.5)
    >>> detector.name
    'superpoint-small'
    >>> len(detector(np.full((48, 64), 128, np.uint8)))
    0
    """

    path: Path | None = None
    threshold: float | None = None
    verified: bool = True
    threads: int = 0
    scales: tuple[float, ...] = SCALES
    shipped: ClassVar[str] = "superpoint"

    def __post_init__(self) -> None:
        if not self.scales or not all(0 < scale <= 16 for scale in self.scales):
            raise DataError(f"scales are {self.scales}, expected at least one, each over 0 and up to 16")
        ours = WEIGHTS / f"{self.shipped}{'' if runs_on_gpu() else '-int8'}.onnx"
        self.path = ours if self.path is None else Path(self.path)
        try:
            model = read_bytes(self.path)
            if self.path != ours:
                try_network(model, str(self.path))
            self._session, text = open_session(model, self.threads)
            content = load_json(text or "{}")
        except DataError:
            raise
        except Exception as error:  # ONNX Runtime raises classes of its own, which are not public
            raise DataError(
                f"{self.path}: cannot be read as an ONNX model ({system_reason(error) or _first_line(error)})"
            ) from None
        if not isinstance(content, dict) or content.get("schema") != SCHEMA:
            raise DataError(f"{self.path}: not written by kpbench export-model, expected schema {SCHEMA!r} inside")
        self.content: dict[str, Any] = content
        with name_source(self.path, DataError):
            table = TomlTable(content, content.keys(), DataError)
            self.name, self.version = (
                table.text("name"),
                f"{table.text('designs')[:8]}-{table.whole_number('samples', 0)}",
            )
            if len(table.entries("patches", "a list of designs")) > MOST_DESIGNS:
                raise DataError(f"patches are {len(content['patches'])} designs, expected at most {MOST_DESIGNS}")
        self.version += "-int8" if "int8" in content else ""
        self.patches = tuple(parse_patch(table, str(self.path)) for table in content["patches"])
        self.verified = self.verified and all(len(set(patch.cells[2][0])) > 1 for patch in self.patches)
        if self.verified:
            self.version += f"-{verifier_version(CANDIDATE_SCORE, self.scales)}"
        self._patch_ids = np.array([patch.patch_id for patch in self.patches], np.int64)

    @property
    def _bytes_per_pixel(self) -> float:
        """Memory that the network needs per pixel of an image, bytes. The factors are measured."""
        try:
            channels = min(max(1, int(self.content["recipe"]["network"]["widths"][0])), 4096)
        except (LookupError, TypeError, ValueError, OverflowError):  # nobody checks this part of the metadata
            channels = 64
        scale = max(self.scales) if self.verified else 1.0
        return scale**2 * channels * (6.5 if "int8" in self.content else 10)

    @property
    def _threshold(self) -> float:
        default = VERIFIED_THRESHOLD if self.verified else Decoding.threshold
        return default if self.threshold is None else self.threshold

    def __call__(self, image: UInt8) -> Detections:
        """Return the detections in one image, uint8 (H, W) or RGB (H, W, 3), best first."""
        return self.batch([image])[0]

    detect = __call__

    def batch(self, images: Sequence[UInt8]) -> list[Detections]:
        """Return the detections in each of several images of one size. The network runs once per scale on all images.

        Raises
        ------
        DataError
            If an array is not an image, or the images differ in size.
        """
        greys = [to_grey(image) for image in images]
        for grey in greys[:1]:
            what = f"{self.name}: {len(greys)} image(s) of {grey.shape[1]} x {grey.shape[0]} pixels"
            require_memory(int(self._bytes_per_pixel * grey.size * len(greys)), what)
        if len({grey.shape for grey in greys}) > 1:
            raise DataError(f"a batch needs images of one size, got {sorted({grey.shape for grey in greys})}")
        if not greys or not greys[0].size:
            return [Detections.none() for _ in greys]
        return [self._decide(grey, *seen) for grey, seen in zip(greys, self.candidates(greys), strict=True)]

    def heads(self, greys: Sequence[UInt8]) -> Sequence[Float32]:
        """Return the logits of the two heads, (B, 65, h, w) and (B, ids + 1, h, w), for B grey images of one size."""
        blob = np.float32(1 / 255) * np.stack([pad_to_cells(grey) for grey in greys])[:, None]
        try:
            outputs: list[Float32] = list(self._session.run(None, {"image": blob}))
        except Exception as error:  # as above
            raise DataError(f"{self.path}: the network cannot be run ({_first_line(error)})") from None
        cells = (blob.shape[2] // CELL_PX, blob.shape[3] // CELL_PX)
        expected = [(len(greys), channels, *cells) for channels in (CELL_PX**2 + 1, len(self.patches) + 1)]
        if [np.shape(output) for output in outputs] != expected:
            shapes = ", ".join(str(np.shape(output)) for output in outputs)
            raise DataError(f"{self.path}: the outputs have the shapes {shapes}, expected {expected[0]}, {expected[1]}")
        return outputs

    def candidates(self, greys: Sequence[UInt8]) -> list[tuple[Float, Float, Float]]:
        """Return the candidates of the network, for each of several grey images of one size.

        Returns
        -------
        list of tuple
            Per image: places (n, 2) px, best first; their scores (n,); and log probabilities (n, ids + 1) of each
            design and of no patch.
        """
        decoding = Decoding(CANDIDATE_SCORE if self.verified else self._threshold)
        height, width = greys[0].shape
        found: list[list[tuple[Float, Float, Float]]] = [[] for _ in greys]
        for scale in self.scales if self.verified else (1.0,):
            size = max(1, round(scale * width)), max(1, round(scale * height))
            exact_scale = np.divide(size, (width, height))  # differs from ``scale`` by the rounding to whole px
            heads = self.heads([resize(grey, *size) for grey in greys])
            for parts, detector, ids in zip(found, *heads, strict=True):
                scaled_xy, score = locate(detector, decoding)
                xy = (scaled_xy + 0.5) / exact_scale - 0.5
                inside = _inside(xy, greys[0])
                parts.append((xy[inside], score[inside], identify(ids, scaled_xy[inside])))
        columns = [[np.concatenate(column) for column in zip(*parts, strict=True)] for parts in found]
        kept = [suppress(xy, score, MERGE_DISTANCE_PX) for xy, score, _ in columns]
        return [(xy[k], score[k], log_id[k]) for (xy, score, log_id), k in zip(columns, kept, strict=True)]

    def _decide(self, grey: UInt8, xy: Float, score: Float, log_id: Float) -> Detections:
        """Return the detections among the candidates of one image."""
        if not self.verified:
            return Detections(xy, score, self._patch_ids[np.argmax(log_id[:, :-1], axis=1)])
        found = verify_candidates(grey, xy, score, log_id, self.patches, self.threads)
        likely = np.flatnonzero((found.score >= self._threshold) & _inside(found.xy, grey))
        xy, score, reach = found.xy[likely], found.score[likely], DISC_SHARE * clipped_semi_axis(found.A[likely])
        kept = suppress(xy, score, np.maximum(Decoding.separation_px, reach))
        rows = likely[kept]
        pose = found.A[rows], found.covariance[rows], found.blur_px[rows]
        return Detections(xy[kept], score[kept], self._patch_ids[found.design[rows]], *pose)


@dataclass
class SmallSuperPointDetector(SuperPointDetector):
    """:class:`SuperPointDetector` with the smaller network, which takes a quarter of the time.

    Examples
    --------
    >>> from kpbench.detectors import SmallSuperPointDetector
    >>> SmallSuperPointDetector(verified=False).threshold is None
    True
    """

    shipped: ClassVar[str] = "superpoint-small"


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0][:200] if str(error) else type(error).__name__
