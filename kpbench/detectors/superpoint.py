"""The reference detector: a SuperPoint network from an ONNX file, decoded with NumPy and OpenCV.

The network divides the image into cells of 8x8 px and has two heads. The detector head gives a logit for each pixel of
a cell and for "no keypoint". The ID head gives a logit for each design and for "no patch", one set per cell.
:mod:`kpbench.detectors.heads` decodes both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from kpbench.detectors.heads import CELL_PX, Decoding, identify, locate
from kpbench.detectors.hypotheses import UNUSED_COLUMNS, Evidence, clipped_semi_axis
from kpbench.detectors.inference import open_session, runs_on_gpu, try_network
from kpbench.detectors.suppression import suppress
from kpbench.detectors.verification import (
    ELLIPSE,
    FIRST_JUDGE,
    SECOND_JUDGE,
    VERIFIER_NETWORKS,
    WEIGHTS,
    verifier_version,
    verify_candidates,
)
from kpbench.errors import DataError, system_reason
from kpbench.files import load_json, read_bytes
from kpbench.fitting.templates import VIEW_PX
from kpbench.fitting.views import OCTAVES
from kpbench.images import resize, to_grey
from kpbench.memory import require_memory
from kpbench.patches.design import parse_patch
from kpbench.toml import TomlTable, name_source
from kpbench.types import Detections, Float, Float32, Int, UInt8

SCHEMA = "kpbench.superpoint/1"
"""Schema of the metadata in the ONNX file."""
MOST_DESIGNS = 256
"""Largest number of designs of a network."""

# Settings of the verified detector. The source of DISC_SHARE is not recorded. CANDIDATE_SCORE and the first scale were
# chosen on synthetic images with training photographs as backgrounds, see notebook/training-log.md, "Weaker places,
# longer ellipses, and judges on their poses".
CANDIDATE_SCORE = 0.015
"""Least network score of a place that is verified."""
SCALES = (1.2, 0.5)
"""Scales of the image that the network sees: enlarged for small patches, shrunk for large patches. The last scale is
halved again and again as long as the shorter side of the picture keeps ``LEAST_SHORT_SIDE_PX``."""
LEAST_SHORT_SIDE_PX = 50
"""Length of the shorter side of the smallest picture that the network sees, px."""
BYTES_PER_PIXEL = 25
"""Memory that the detector needs per pixel of the largest picture, besides the network, bytes. Measured."""
STRIP_PIXELS, STRIP_MARGIN_PX = 3_000_000, 64
"""The network sees a picture with more pixels than ``STRIP_PIXELS`` in horizontal strips, which bounds the memory. Each
strip overlaps the next by twice the margin. The outputs of the shipped networks do not depend on pixels that are
further away than the margin."""
VERIFIED_THRESHOLD = 0.5
"""Least score of a verified detection. The rule: the least multiple of 0.1 with at most 0.05 false alarms per image
on 600 deteriorated synthetic images over training photographs."""
DISC_SHARE = 0.6
"""If two detections are nearer than this, in short semi-axes of the better detection, only the better is kept."""


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
        CPU and as float32 on a GPU. If ``ellipse.onnx``, ``first-judge.onnx`` and ``second-judge.onnx`` lie beside the
        file, they verify its candidates in place of the shipped ones.
    threshold : float, optional
        Least score of a detection, in [0, 1]. None: 0.5.
    verified : bool
        Whether the candidates of the network are compared with the designs in the file. The verification then gives
        centre, identity and score. False: the network alone decides, at the image's own scale. A design without an
        edge at its centre cannot be verified; ``verified`` becomes False if the file has such a design.
    threads : int
        Threads of the networks. 0 means the number of OpenCV's threads.
    scales : tuple of float, optional
        Scales of the image that the network sees, if candidates are verified. None: 1.2 and 0.5, and the halves of the
        last scale down to a picture with a shorter side of 50 px.
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
    scales: tuple[float, ...] | None = None
    shipped: ClassVar[str] = "superpoint"

    def __post_init__(self) -> None:
        if self.scales is not None and not (self.scales and all(0 < scale <= 16 for scale in self.scales)):
            raise DataError(f"scales are {self.scales}, expected at least one, each over 0 and up to 16")
        ours = WEIGHTS / f"{self.shipped}{'' if runs_on_gpu() else '-int8'}.onnx"
        self.path = ours if self.path is None else Path(self.path)
        try:
            model = read_bytes(self.path)
            if self.path != ours:
                try_network(model, str(self.path))
            if self._weights != WEIGHTS:
                _try_verifier(self._weights)
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
            self.version += (
                f"-{verifier_version(self._weights, CANDIDATE_SCORE, self.scales or (*SCALES, LEAST_SHORT_SIDE_PX))}"
            )
        self._patch_ids = np.array([patch.patch_id for patch in self.patches], np.int64)

    @property
    def _weights(self) -> Path:
        """Folder of the networks that verify: beside ``path`` if all of them lie there, else the shipped ones."""
        folder = Path(self.path or WEIGHTS).parent
        return folder if all((folder / f"{name}.onnx").is_file() for name in VERIFIER_NETWORKS) else WEIGHTS

    @property
    def _bytes_per_pixel(self) -> float:
        """Memory that the network needs per pixel of a picture, bytes. The factors are measured."""
        try:
            channels = min(max(1, int(self.content["recipe"]["network"]["widths"][0])), 4096)
        except (LookupError, TypeError, ValueError, OverflowError):  # nobody checks this part of the metadata
            channels = 64
        return channels * (6.5 if "int8" in self.content else 10)

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
            pixels = max(self.view_scales(*grey.shape)) ** 2 * grey.size
            needed = self._bytes_per_pixel * min(pixels, STRIP_PIXELS) + BYTES_PER_PIXEL * pixels
            require_memory(int(needed * len(greys)), what)
        if len({grey.shape for grey in greys}) > 1:
            raise DataError(f"a batch needs images of one size, got {sorted({grey.shape for grey in greys})}")
        if not greys or not greys[0].size:
            return [Detections.none() for _ in greys]
        return [self._decide(grey, *seen) for grey, seen in zip(greys, self.candidates(greys), strict=True)]

    def heads(self, greys: Sequence[UInt8]) -> Sequence[Float32]:
        """Return the logits of the two heads, (B, 65, h, w) and (B, ids + 1, h, w), for B grey images of one size."""
        height, width = pad_to_cells(greys[0]).shape
        rows = max(1, STRIP_PIXELS // (width * CELL_PX)) * CELL_PX
        if height <= rows:
            return self._run_network(greys)
        parts = []
        for first in range(0, height, rows):
            start = max(0, first - STRIP_MARGIN_PX)
            outputs = self._run_network([grey[start : first + rows + STRIP_MARGIN_PX] for grey in greys])
            parts.append([output[:, :, (first - start) // CELL_PX :][:, :, : rows // CELL_PX] for output in outputs])
        return [np.concatenate(strips, axis=2) for strips in zip(*parts, strict=True)]

    def _run_network(self, greys: Sequence[UInt8]) -> Sequence[Float32]:
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

    def view_scales(self, height: int, width: int) -> tuple[float, ...]:
        """Return the scales at which the network sees an image of ``height`` x ``width`` px."""
        if not self.verified:
            return (1.0,)
        if self.scales is not None:
            return self.scales
        octaves = int(max(0, np.log2(SCALES[-1] * min(height, width) / LEAST_SHORT_SIDE_PX)))
        return *SCALES, *(SCALES[-1] * 0.5**n for n in range(1, octaves + 1))

    def candidates(self, greys: Sequence[UInt8]) -> list[tuple[Float, Float, Float, Int]]:
        """Return the candidates of the network, for each of several grey images of one size.

        Returns
        -------
        list of tuple
            Per image: places (n, 2) px; their scores (n,); log probabilities (n, ids + 1) of each design and of no
            patch; and the pyramid levels (n,) of the pictures in which they were found.
        """
        decoding = Decoding(CANDIDATE_SCORE if self.verified else self._threshold)
        height, width = greys[0].shape
        found: list[list[tuple[Float, Float, Float, Int]]] = [[] for _ in greys]
        for scale in self.view_scales(height, width):
            size = max(1, round(scale * width)), max(1, round(scale * height))
            exact_scale = np.divide(size, (width, height))  # differs from ``scale`` by the rounding to whole px
            heads = self.heads([resize(grey, *size) for grey in greys])
            for parts, detector, ids in zip(found, *heads, strict=True):
                scaled_xy, score = locate(detector, decoding)
                xy = (scaled_xy + 0.5) / exact_scale - 0.5
                inside = _inside(xy, greys[0])
                octave = np.full(np.count_nonzero(inside), max(0, round(-np.log2(scale))))
                parts.append((xy[inside], score[inside], identify(ids, scaled_xy[inside]), octave))
        return [tuple(map(np.concatenate, zip(*parts, strict=True))) for parts in found]  # type: ignore[misc]

    def _decide(self, grey: UInt8, xy: Float, score: Float, log_id: Float, octave: Int) -> Detections:
        """Return the detections among the candidates of one image."""
        if not self.verified:
            return Detections(xy, score, self._patch_ids[np.argmax(log_id[:, :-1], axis=1)])
        found = verify_candidates(grey, xy, score, log_id, self.patches, self.threads, octave, self._weights)
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


def _try_verifier(weights: Path) -> None:
    """Run the three networks of a folder once on zeros, within limits.

    Raises
    ------
    DataError
        If a file cannot be read or is no such network.
    """
    view = np.zeros((1, 2, VIEW_PX, VIEW_PX), np.float32)
    for name, inputs in (
        (ELLIPSE, {"surroundings": np.zeros((1, OCTAVES, VIEW_PX, VIEW_PX), np.float32)}),
        (FIRST_JUDGE, {"view": view, "evidence": np.zeros((1, Evidence.RADIUS + 1), np.float32)}),
        (SECOND_JUDGE, {"view": view, "evidence": np.zeros((1, len(Evidence) + UNUSED_COLUMNS), np.float32)}),
    ):
        file = weights / f"{name}.onnx"
        try:
            try_network(read_bytes(file), str(file), inputs)
        except DataError:
            raise
        except Exception as error:  # ONNX Runtime raises classes of its own, which are not public
            raise DataError(f"{file}: cannot be read as an ONNX model ({_first_line(error)})") from None


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0][:200] if str(error) else type(error).__name__
