"""The reference detector: SuperPoint's raw heads from an ONNX file, decoded here in NumPy and OpenCV.

The graph gives logits a cell of 8x8 px. :func:`decode` turns them into keypoints: one probability map
at full resolution, its local maxima, and for each maximum the centre of mass of the probability around
it, whichever cells that lies in.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.detectors import verification as verify
from kpbench.detectors.inference import on_gpu, open_session
from kpbench.detectors.suppression import suppress
from kpbench.errors import DataError
from kpbench.images import resize, to_grey
from kpbench.patches.design import parse_patch
from kpbench.types import Detections, Float, Float32, UInt8

CELL = 8
SCHEMA = "kpbench.superpoint/1"


@dataclass(frozen=True)
class Decoding:
    """How logits become keypoints.

    Attributes
    ----------
    threshold : float
        Least probability that a keypoint lies in the window around a maximum, in [0, 1]; what lies under 0.01 may go.
    separation_px : int
        Of two maxima closer than this the weaker one is dropped. Discs that do not overlap and whose
        short axes measure 10 px have their centres at least so far apart.
    window_px : int
        Reach of the window that is summed up, and averaged for the sub-pixel position: it is
        ``2 · window_px + 1`` wide.
    """

    threshold: float = 0.5
    separation_px: int = 6
    window_px: int = 3


def decode(detector_logits: Float32, id_logits: Float32, decoding: Decoding | None = None) -> Detections:
    """Keypoints from the two heads of one image, as the network alone sees them.

    Parameters
    ----------
    detector_logits : ndarray of shape (65, h, w), float32
        A pixel of the cell each, in row order, then "no keypoint".
    id_logits : ndarray of shape (ids + 1, h, w), float32
        A patch each, then "no patch".
    decoding : Decoding, optional

    Returns
    -------
    Detections
        In the frame of the (8h, 8w) image, best first; ``patch_id`` is the place of the patch in the ID head.
    """
    xy, score = locate(detector_logits, decoding or Decoding())
    return Detections(xy, score, np.argmax(identify(id_logits, xy)[:, :-1], axis=1))


def locate(detector_logits: Float32, how: Decoding) -> tuple[Float, Float]:
    """Places (n, 2) px and scores (n,) of keypoints from the (65, h, w) detector logits, best first."""
    probability = keypoint_probability(detector_logits)
    # a light smoothing ranks neighbours within a blob, so that one blob has one maximum
    ranked = cv2.GaussianBlur(probability, (5, 5), 1.0, borderType=cv2.BORDER_CONSTANT)
    side = 2 * how.separation_px - 1
    highest = cv2.dilate(ranked, np.ones((side, side), np.uint8))
    width, offset = 2 * how.window_px + 1, np.arange(-how.window_px, how.window_px + 1)
    # what holds the threshold in its window has at least the mean of it at its maximum
    found = np.flatnonzero(ranked > 0.5 * how.threshold / width**2)  # of two axes it takes many times as long
    found = found[ranked.ravel()[found] >= highest.ravel()[found]]
    rows, columns = np.divmod(found, probability.shape[1])
    windows = _windows(probability, rows[:, None] + offset, columns[:, None] + offset)
    total = windows.sum(axis=(1, 2))
    likely = total >= how.threshold
    rows, columns, windows, total = rows[likely], columns[likely], windows[likely], total[likely]
    x = columns + windows.sum(axis=1) @ offset / total
    y = rows + windows.sum(axis=2) @ offset / total
    xy = np.column_stack([x, y])
    score = np.minimum(total, 1.0).astype(np.float64)
    kept = suppress(xy, score, how.separation_px)
    return xy[kept], score[kept]


def _windows(image: Float32, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Float32:
    """Parts (n, k, k) of an image at rows (n, k) and columns (n, k); 0 outside."""
    height, width = image.shape
    inside = ((rows >= 0) & (rows < height))[:, :, None] & ((columns >= 0) & (columns < width))[:, None]
    part = image[np.clip(rows, 0, height - 1)[:, :, None], np.clip(columns, 0, width - 1)[:, None]]
    return np.asarray(part * inside, np.float32)


def identify(id_logits: Float32, xy: Float) -> Float:
    """Log-probabilities (n, ids + 1) of each patch and of "no patch" at places (n, 2) px."""
    logits = _at(id_logits, xy)
    logits = logits - logits.max(axis=1, keepdims=True)
    return np.asarray(logits - np.log(np.exp(logits).sum(axis=1, keepdims=True)))


FAINT = float(np.log(2e-4))
"""Log of how much less likely than "no keypoint" every pixel of an empty cell is: nearly all cells are."""


def keypoint_probability(detector_logits: Float32) -> Float32:
    """Softmax over each cell, laid out as an image: (65, h, w) to (8h, 8w); 0 in empty cells."""
    _, h, w = detector_logits.shape
    rows, columns = np.nonzero(detector_logits[:-1].max(axis=0) - detector_logits[-1] > FAINT)
    logits = detector_logits[:, rows, columns]
    share = np.exp(logits - logits.max(axis=0))
    share = share[:-1] / share.sum(axis=0)
    probability = np.zeros((h, CELL, w, CELL), np.float32)
    probability[rows, :, columns] = share.T.reshape(-1, CELL, CELL)
    return probability.reshape(CELL * h, CELL * w)


def _at(cells: Float32, xy: Float) -> Float:
    """Bilinear values of a cell map at pixels: (C, h, w) and (n, 2) to (n, C); cell centres at 3.5 + 8i px."""
    _, h, w = cells.shape
    u = np.clip((xy - (CELL - 1) / 2) / CELL, 0, (w - 1, h - 1))
    low = np.minimum(u.astype(int), np.maximum((w - 2, h - 2), 0))
    (fx, fy), (j, i) = (u - low).T, low.T
    j1, i1 = np.minimum(j + 1, w - 1), np.minimum(i + 1, h - 1)
    top = cells[:, i, j] * (1 - fx) + cells[:, i, j1] * fx
    bottom = cells[:, i1, j] * (1 - fx) + cells[:, i1, j1] * fx
    return np.asarray((top * (1 - fy) + bottom * fy).T)


def _inside(xy: Float, image: UInt8) -> NDArray[np.bool_]:
    """Whether places (n, 2) px lie in the image."""
    return np.asarray(np.all((xy > -0.5) & (xy < np.subtract(image.shape[1::-1], 0.5)), axis=1))


def pad_to_cells(grey: UInt8) -> UInt8:
    """Repeat the last row and column until both sides are multiples of 8; (0, 0) stays where it is."""
    height, width = grey.shape
    return np.pad(grey, ((0, -height % CELL), (0, -width % CELL)), mode="edge")


CANDIDATE = 0.015
"""Least score of the network from which a place is worth verifying."""
SCALES = (1.2, 0.5, 0.25)
"""Scales of the image at which candidates are looked for: small patches are found better enlarged, large shrunk."""
LIKELY = 0.3
"""Least probability of a verified detection: on training photographs few false alarms have as much at 1624x1240."""
SAME_PX = 3.0
"""Candidates of two scales that are nearer to each other than this are one."""


@dataclass
class SuperPointDetector:
    """SuperPoint on ONNX Runtime; call it with an image.

    Attributes
    ----------
    path : Path, optional
        ONNX file written by ``kpbench export-model``; None: the weights that ship with kpbench, in 8-bit
        integers for a processor, float32 for a GPU.
    threshold : float, optional
        Least score of a detection, in [0, 1]; None: 0.5 of the network alone, 0.3 where it is verified.
    verified : bool
        Whether the network's candidates are compared with the designs, which the file holds
        (:mod:`kpbench.detectors`): that gives centre, identity and score. False: the network alone decides, at
        the image's own scale; so it is also for designs without an edge at the centre, whose pose shows nowhere.
    threads : int
        Threads of the network's runtime; 0 means as many as OpenCV may use.
    scales : tuple of float
        Scales of the image at which candidates are looked for, where they are verified.

    Raises
    ------
    DataError
        If the file cannot be read or was not written by kpbench, or the scales are none.
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
        ours = Path(__file__).parent / "weights" / f"{self.shipped}{'' if on_gpu() else '-int8'}.onnx"
        self.path = ours if self.path is None else Path(self.path)
        try:
            self._session, text = open_session(self.path.read_bytes(), self.threads)
            content = json.loads(text or "{}")
        except DataError:
            raise
        except Exception as error:  # ONNX Runtime raises classes of its own, which are not public
            raise DataError(f"{self.path}: cannot be read as an ONNX model ({_first_line(error)})") from None
        if content.get("schema") != SCHEMA:
            raise DataError(f"{self.path}: not written by kpbench export-model, expected schema {SCHEMA!r} inside")
        self.content: dict[str, Any] = content
        self.name, self.version = str(content["name"]), f"{content['designs'][:8]}-{content['samples']}"
        self.version += "-int8" if "int8" in content else ""
        self.patches = tuple(parse_patch(table, str(self.path)) for table in content["patches"])
        self.verified = self.verified and all(len(set(patch.cells[2][0])) > 1 for patch in self.patches)
        if self.verified:
            self.version += f"-{verify.version(CANDIDATE, self.scales)}"
        self._patch_ids = np.array([patch.patch_id for patch in self.patches], np.int64)

    @property
    def _least(self) -> float:
        return self.threshold if self.threshold is not None else LIKELY if self.verified else Decoding.threshold

    def __call__(self, image: UInt8) -> Detections:
        """Detections of one image, uint8 (H, W) or RGB (H, W, 3), best first."""
        return self.batch([image])[0]

    detect = __call__

    def batch(self, images: Sequence[UInt8]) -> list[Detections]:
        """Detections of several images of one size, which pass the network in one call.

        Raises
        ------
        DataError
            If one is no image, or they differ in size.
        """
        greys = [to_grey(image) for image in images]
        if len({grey.shape for grey in greys}) > 1:
            raise DataError(f"a batch needs images of one size, got {sorted({grey.shape for grey in greys})}")
        if not greys or not greys[0].size:
            return [Detections.none() for _ in greys]
        return [self._decoded(grey, *seen) for grey, seen in zip(greys, self.candidates(greys), strict=True)]

    def heads(self, greys: Sequence[UInt8]) -> Sequence[Float32]:
        """The two raw heads of several grey images of one size: (B, 65, h, w) and (B, ids + 1, h, w)."""
        blob = np.float32(1 / 255) * np.stack([pad_to_cells(grey) for grey in greys])[:, None]
        return self._session.run(None, {"image": blob})

    def candidates(self, greys: Sequence[UInt8]) -> list[tuple[Float, Float, Float]]:
        """Where the network sees something, for each of several grey images of one size.

        Returns
        -------
        Places (n, 2) px, their scores (n,), and log-probabilities (n, ids + 1) of each design and of none; best first.
        """
        how = Decoding(CANDIDATE if self.verified else self._least)
        height, width = greys[0].shape
        found: list[list[tuple[Float, Float, Float]]] = [[] for _ in greys]
        for scale in self.scales if self.verified else (1.0,):
            size = max(1, round(scale * width)), max(1, round(scale * height))
            exact = np.divide(size, (width, height))  # what rounding to whole pixels makes of the scale
            heads = self.heads([resize(grey, *size) for grey in greys])
            for parts, detector, ids in zip(found, *heads, strict=True):
                there, score = locate(detector, how)
                xy = (there + 0.5) / exact - 0.5
                inside = _inside(xy, greys[0])
                parts.append((xy[inside], score[inside], identify(ids, there[inside])))
        columns = [[np.concatenate(column) for column in zip(*parts, strict=True)] for parts in found]
        once = [suppress(xy, score, SAME_PX) for xy, score, _ in columns]
        return [(xy[k], score[k], log_id[k]) for (xy, score, log_id), k in zip(columns, once, strict=True)]

    def _decoded(self, grey: UInt8, xy: Float, score: Float, log_id: Float) -> Detections:
        if not self.verified:
            return Detections(xy, score, self._patch_ids[np.argmax(log_id[:, :-1], axis=1)])
        found = verify.examine(grey, xy, score, log_id, self.patches, self.threads)
        sure = np.flatnonzero((found.score >= self._least) & _inside(found.xy, grey))
        xy, score, apart = found.xy[sure], found.score[sure], 0.6 * found.minor_px[sure]
        # discs do not overlap: of two centres within one disc the likelier stays
        kept = suppress(xy, score, np.maximum(Decoding.separation_px, apart))
        return Detections(xy[kept], score[kept], self._patch_ids[found.which[sure[kept]]])


@dataclass
class SmallSuperPointDetector(SuperPointDetector):
    """The same with the smaller network."""

    shipped: ClassVar[str] = "superpoint-small"


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0][:200] if str(error) else type(error).__name__
