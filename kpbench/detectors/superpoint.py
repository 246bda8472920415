"""The reference detector: SuperPoint's raw heads from an ONNX file, decoded here in NumPy and OpenCV.

The graph gives logits a cell of 8x8 px. :func:`decode` turns them into keypoints: one probability map
at full resolution, its local maxima, and for each maximum the centre of mass of the probability around
it, whichever cells that lies in.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench import match, refine
from kpbench.design import Patch, shipped_patches
from kpbench.detect import suppress, to_grey
from kpbench.errors import DataError
from kpbench.keypoints import Detections, Float, UInt8

__all__ = [
    "Decoding",
    "SmallSuperPointDetector",
    "SuperPointDetector",
    "decode",
    "fit_designs",
    "open_session",
    "pad_to_cells",
]

CELL = 8
SCHEMA = "kpbench.superpoint/1"
Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class Decoding:
    """How logits become keypoints.

    Attributes
    ----------
    threshold : float
        Least probability that a keypoint lies in the window around a maximum, in [0, 1].
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
    """Keypoints from the two heads of one image.

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
    how = decoding or Decoding()
    probability = keypoint_probability(detector_logits)
    reach = how.window_px
    # a light smoothing ranks neighbours within a blob, so that one blob has one maximum
    ranked = cv2.GaussianBlur(probability, (0, 0), 1.0, borderType=cv2.BORDER_CONSTANT)
    mass = cv2.boxFilter(probability, -1, (2 * reach + 1,) * 2, normalize=False, borderType=cv2.BORDER_CONSTANT)
    side = 2 * how.separation_px - 1
    highest = cv2.dilate(ranked, np.ones((side, side), np.uint8))
    rows, columns = np.nonzero((ranked >= highest) & (mass >= how.threshold))
    if not len(rows):
        return Detections.none()
    padded = np.pad(probability, reach)
    offset = np.arange(2 * reach + 1)
    windows = padded[rows[:, None, None] + offset[:, None], columns[:, None, None] + offset]
    total = windows.sum(axis=(1, 2))
    x = columns + windows.sum(axis=1) @ (offset - reach) / total
    y = rows + windows.sum(axis=2) @ (offset - reach) / total
    xy = np.column_stack([x, y])
    score = np.minimum(total, 1.0).astype(np.float64)
    kept = suppress(xy, score, how.separation_px)
    ids = np.argmax(_at(id_logits, xy[kept])[:, :-1], axis=1)
    return Detections(xy[kept], score[kept], ids)


def keypoint_probability(detector_logits: Float32) -> Float32:
    """Softmax over each cell, laid out as an image: (65, h, w) to (8h, 8w)."""
    _, h, w = detector_logits.shape
    share = np.exp(detector_logits - detector_logits.max(axis=0))
    share = share[:-1] / share.sum(axis=0)
    return np.ascontiguousarray(share.reshape(CELL, CELL, h, w).transpose(2, 0, 3, 1).reshape(CELL * h, CELL * w))


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


def pad_to_cells(grey: UInt8) -> UInt8:
    """Repeat the last row and column until both sides are multiples of 8; (0, 0) stays where it is."""
    height, width = grey.shape
    return np.pad(grey, ((0, -height % CELL), (0, -width % CELL)), mode="edge")


def open_session(model: bytes, threads: int = 0) -> Any:
    """An ``onnxruntime.InferenceSession`` on the processor; 0 threads leaves their number to it."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])


LEAST_FIT = 0.8
"""Correlation of design and pixels from which a fitted centre is trusted more than the network's."""


def fit_designs(grey: UInt8, found: Detections, patches: Sequence[Patch]) -> Detections:
    """Move each detection to the centre of its design, fitted to the pixels around it.

    Where the design does not fit (:data:`LEAST_FIT`), or its centre is further off than a network errs
    (3 px, or a quarter of the patch's short semi-axis), the detection stays where it was.

    Parameters
    ----------
    grey : ndarray of shape (H, W), uint8
    found : Detections
        With ``patch_id``; scores and identities are not changed.
    patches : sequence of Patch
    """
    if found.patch_id is None or min(grey.shape) < 2 * CELL:
        return found
    patches = [patch for patch in patches if patch.patch_id in found.patch_id]
    if not patches:
        return found
    known = match.bank(patches)
    raw, smooth = match.pyramid(grey, 0), match.pyramid(grey)
    octaves = min(4, len(smooth))
    level = np.tile(np.arange(octaves), len(found))
    poses = match.search(smooth, np.repeat(found.xy, octaves, axis=0), level, known, margin=2.0)
    designs = len(patches)  # a margin of 2 keeps a pose of every design at every place and octave
    owner = np.repeat(np.arange(len(found)), octaves * designs)
    ids = np.array([patch.patch_id for patch in patches])
    own = ids[poses.which] == found.patch_id[owner]
    poses, owner = poses[own], owner[own]
    poses = match.align(smooth, poses, known.core, 3, 0.9 * match.RING_PX)
    order = np.lexsort((-poses.ncc, owner))
    owner, first = np.unique(owner[order], return_index=True)
    whole = match.align(smooth, match.extend(smooth, poses[order[first]], known), known.whole, 4, 5.6)
    fit = refine.fit(raw, whole.xy, whole.A, [patches[n] for n in whole.which])
    moved = np.linalg.norm(fit.xy - found.xy[owner], axis=1)
    good = (fit.ncc >= LEAST_FIT) & (moved <= np.maximum(3.0, 0.25 * match.short_axis(fit.A)))
    xy = found.xy.copy()
    xy[owner[good]] = fit.xy[good]
    return Detections(xy, found.score, found.patch_id)


@dataclass
class SuperPointDetector:
    """SuperPoint on ONNX Runtime; call it with an image.

    Attributes
    ----------
    path : Path, optional
        ONNX file written by ``kpbench export-model``; None: the weights that ship with kpbench.
    decoding : Decoding
    patches : sequence of Patch, optional
        The designs: each detection is then fitted to its design, see :func:`fit_designs`. None: it is not.
    threads : int
        Threads of ONNX Runtime; 0 leaves the choice to it.

    Raises
    ------
    DataError
        If the file cannot be read or was not written by kpbench.
    """

    path: Path | None = None
    decoding: Decoding = field(default_factory=Decoding)
    patches: Sequence[Patch] | None = field(default_factory=shipped_patches)
    threads: int = 0
    shipped: ClassVar[str] = "superpoint.onnx"

    def __post_init__(self) -> None:
        self.path = Path(__file__).parent.parent / "weights" / self.shipped if self.path is None else Path(self.path)
        try:
            self._session = open_session(self.path.read_bytes(), self.threads)
            content = json.loads(self._session.get_modelmeta().custom_metadata_map.get("kpbench", "{}"))
        except Exception as error:  # ONNX Runtime raises classes of its own, which are not public
            raise DataError(f"{self.path}: cannot be read as an ONNX model ({_first_line(error)})") from None
        if content.get("schema") != SCHEMA:
            raise DataError(f"{self.path}: not written by kpbench export-model, expected schema {SCHEMA!r} inside")
        self.content: dict[str, Any] = content
        self.name, self.version = str(content["name"]), f"{content['designs'][:8]}-{content['samples']}"
        self._patch_ids = np.array([p["id"] for p in content["patches"]], np.int64)

    def __call__(self, image: UInt8) -> Detections:
        """Detections of one image, uint8 (H, W) or RGB (H, W, 3), best first."""
        grey = to_grey(image)
        blob = np.float32(1 / 255) * pad_to_cells(grey)[None, None]
        detector, ids = self._session.run(None, {"image": blob})
        found = decode(detector[0], ids[0], self.decoding)
        height, width = grey.shape
        inside = np.all((found.xy > -0.5) & (found.xy < (width - 0.5, height - 0.5)), axis=1)
        found = found[inside]
        found = Detections(found.xy, found.score, self._patch_ids[found.patch_id])
        return found if self.patches is None else fit_designs(grey, found, self.patches)

    detect = __call__


@dataclass
class SmallSuperPointDetector(SuperPointDetector):
    """The same with the smaller network."""

    shipped: ClassVar[str] = "superpoint-small.onnx"


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0][:200] if str(error) else type(error).__name__
