"""Labelled photographs: a dataset whose truth comes from the reference marks of a board."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.calibration.bundle import Bundle
from kpbench.calibration.camera_solution import FEW_PHOTOS, Halves, compare_halves, require_explained, solve_and_reject
from kpbench.calibration.conditions import measure_condition, name_condition
from kpbench.calibration.labels import PhotoLabels, label_photo
from kpbench.calibration.observe import Observed, board_points_mm, observe_photos
from kpbench.calibration.photos import as_grey, list_photos, read_photo
from kpbench.calibration.shape import SHAPE_NAMES
from kpbench.calibration.start import start_camera
from kpbench.calibration.tripod import Hard, find_hard_photos, is_inside
from kpbench.dataset.folder import Dataset
from kpbench.dataset.generation import generate
from kpbench.dataset.shard import Sample
from kpbench.errors import DataError, GateFailed, KpbenchWarning
from kpbench.geometry.camera import Camera
from kpbench.patches.board import Board
from kpbench.types import UInt8

HALVES_P = 0.001
"""Probability below which the two halves contradict their stated uncertainty."""
COEFFICIENTS = 5
"""Coefficients of the lens that is solved along."""
COMMON_SIGMA_PX = 0.001
"""Standard deviation of what moves all marks of a photograph alike, so that leaving out a mark does not show it."""
SHARD_SIZE = 50
WRONG_RATIO = 0.01
"""Deviation of the ratio of the print's scales, from which a warning tells it."""
Source = Literal["photographs", "simulated photographs"]
Condition = Literal["folders", "scale", "pitch"]


@dataclass(frozen=True)
class LabelResult:
    """The result of :func:`kpbench.label`.

    Attributes
    ----------
    dataset : Dataset
    observed : tuple of Observed
        All photographs, with reason codes of those that were rejected.
    leave_one_out_px : float
        Root mean square error (per coordinate) of marks that are predicted from all other marks. It holds the errors
        of the marks themselves.
    error_px : float
        Root mean square error of the labels that the check predicts, per coordinate.
    halves : Halves or None
        None if there are too few photographs.
    """

    dataset: Dataset
    observed: tuple[Observed, ...]
    leave_one_out_px: float
    error_px: float
    halves: Halves | None


@dataclass(frozen=True, eq=False)
class _LabelConfig:
    """The configuration of a labelled dataset, see :class:`kpbench.dataset.DatasetConfig`."""

    paths: tuple[Path, ...]
    keypoints: tuple[NDArray[Any], ...]
    conditions: tuple[tuple[str, float], ...]
    scenes: tuple[str, ...]
    content: dict[str, Any]

    @property
    def n(self) -> int:
        return len(self.paths)

    @property
    def shard_size(self) -> int:
        return SHARD_SIZE

    @property
    def image_bytes(self) -> int:
        width, height = self.content["size_px"]
        return int(width * height * self.content["channels"] * 0.8)

    @property
    def most_keypoints(self) -> int:
        return max(map(len, self.keypoints), default=0)

    def to_dict(self) -> dict[str, Any]:
        return {**self.content, "n": self.n, "shard_size": self.shard_size}

    def scene_id(self, index: int) -> int:
        return self.scenes.index(self.scenes[index])

    def make(self, index: int) -> tuple[Sample, tuple[str, ...]]:
        image = _read(self.paths[index])
        if image.ndim == 2 and self.content["channels"] == 3:
            image = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), np.uint8)
        condition, rung = self.conditions[index]
        name = self.content["photos"][index]["name"]
        effects = [{"effect": "photograph", "file": name}]
        return Sample(
            index, image, self.keypoints[index], effects, condition=condition, rung=rung, scene_id=self.scene_id(index)
        ), ()


def label(
    photos: str | Path | Sequence[str | Path],
    board: Board,
    out: str | Path,
    *,
    camera: Camera | None = None,
    source: Source = "photographs",
    condition: Condition = "folders",
    tripod: Sequence[str] = (),
    force: bool = False,
    overwrite: bool = False,
    progress: Callable[[int], None] = lambda photos: None,
) -> LabelResult:
    """Make a labelled dataset from photographs of a board with reference marks.

    The truth of each patch comes from the marks and the solved geometry, never from a detector. Each keypoint has the
    standard deviation of its truth.

    Parameters
    ----------
    photos : str, Path or a sequence of them
        Folder of photographs, or files, all of one camera. A folder such as ``blur/7`` gives condition and rung.
    board : Board
        With reference marks.
    out : str or Path
        Folder of the dataset.
    camera : Camera, optional
        Camera of the photographs. Without it, a lens with five coefficients is solved along.
    source : {"photographs", "simulated photographs"}
        What reports say about the images. If kpbench wrote one of them, they are taken for simulated.
    condition : {"folders", "scale", "pitch"}
        Where condition and rung come from: folders, the board's share of the image, or its tilt.
    tripod : sequence of str
        Folders below `photos` whose photographs each show one fixed scene, in which light, focus, exposure or an
        occluder change; "." for all. The easy photographs of such a series give truth to the hard ones: those with few
        marks or none. Easy photographs must be taken before and after; the order is that of the files' names.
    force : bool
        Keep a dataset whose two halves do not agree. The dataset tells it.
    overwrite : bool
        Delete the dataset in the folder first.
    progress : callable
        Called with the number of photographs that were read since its last call; each is read twice.

    Returns
    -------
    LabelResult

    Raises
    ------
    DataError
        If the board has no reference marks, no photograph shows the board, or no camera explains the photographs.
    GateFailed
        If the two halves of the photographs, solved apart, do not agree within their stated uncertainty, or a tripod
        moved.

    Examples
    --------
    >>> import kpbench
    >>> kpbench.label("photos", kpbench.hexagon_board(kpbench.shipped_patches()[0], 200.0), "labelled")
    Traceback (most recent call last):
     ...
    kpbench.errors.DataError: board 'hexagon-checker' has no reference marks, expected some; print it with `reference`
    """
    if not board.references:
        raise DataError(f"board {board.name!r} has no reference marks, expected some; print it with `reference`")
    text, paths = str(photos), dict(list_photos(photos, exclude=Path(out)))
    observed = observe_photos(photos, board, exclude=Path(out), progress=progress)
    observed, bundle = _solve(observed, board, camera, text)
    halves = compare_halves(bundle, board_points_mm(board))
    shown = len(bundle.points) + sum(o.reason in ("does-not-fit", "outliers") for o in observed)
    _judge_halves(halves, shown, text, force)
    if abs(bundle.shape.ratio) > WRONG_RATIO:
        warnings.warn(
            f"{text}: the print is {1 + bundle.shape.ratio:.4f} times as wide as it should be for its height; was it "
            "scaled when it was printed?",
            KpbenchWarning,
            stacklevel=2,
        )
    observed, hard = find_hard_photos(observed, bundle, board_points_mm(board), board.points_mm[:, :2], tripod, text)
    observed, kept, labels, has_colour = _label_all(observed, bundle, board, paths, hard, progress)
    if any(o.photo.is_of_kpbench for o in kept):
        source = "simulated photographs"
    factor, loo_px = _calibrate_sigma(labels)
    drift_px = [hard[o.photo.name].drift_px if o.photo.name in hard else 0.0 for o in kept]
    keypoints = [_scaled(found.keypoints, factor, drift) for found, drift in zip(labels, drift_px, strict=True)]
    sigma = np.concatenate([np.concatenate([table["sigma_x"], table["sigma_y"]]) for table in keypoints])
    error_px = float(np.sqrt((sigma**2).mean()))
    content = _describe(board, bundle, observed, kept, labels, hard, source, has_colour) | {
        "leave_one_out": {
            "marks_rms_px": round(loo_px, 5),
            "sigma_factor": round(factor, 4),
            "error_px": round(error_px, 5),
        },
        "halves": None if halves is None else {"chi2": round(halves.chi2, 3), "p": float(f"{halves.p:.3g}")},
        "forced": bool(force and halves is not None and halves.p < HALVES_P),
    }
    config = _LabelConfig(
        tuple(paths[o.photo.name] for o in kept),
        tuple(np.concatenate([table, found.ignored]) for table, found in zip(keypoints, labels, strict=True)),
        tuple(_condition(o, found, condition, board, bundle) for o, found in zip(kept, labels, strict=True)),
        tuple(next((f"{folder}/" for folder in tripod if is_inside(o.photo.name, folder)), o.photo.name) for o in kept),
        content,
    )
    dataset = generate(config, out, workers=1, overwrite=overwrite).dataset
    return LabelResult(dataset, tuple(observed), loo_px, error_px, halves)


def _solve(observed: list[Observed], board: Board, camera: Camera | None, source: str) -> tuple[list[Observed], Bundle]:
    """Solve the photographs, and the camera if it is not given."""
    board_mm = board_points_mm(board)
    used = [o for o in observed if not o.reason]
    is_solved = camera is None
    if used and camera is None:
        camera = start_camera([o.points for o in used], board_mm, used[0].photo.size_px, "brown", COEFFICIENTS)
    elif used and camera is not None:
        camera = camera.at_size(*used[0].photo.size_px)
    camera = camera or Camera(1, 1, 1.0)
    observed, bundle = solve_and_reject(observed, board_mm, camera, source, solve_camera=is_solved)
    require_explained(bundle, source)
    return observed, bundle


def _judge_halves(halves: Halves | None, photos: int, source: str, force: bool) -> None:
    if halves is not None and halves.p < HALVES_P:
        text = (
            f"{source}: two halves of the photographs, solved apart, do not agree (chi-square {halves.chi2:.0f}, "
            f"p = {halves.p:.1g}); expected one camera with fixed zoom and focus, and one print"
        )
        if not force and photos >= FEW_PHOTOS:
            raise GateFailed(f"{text}; `force` keeps the labels, marked")
        warnings.warn(text, KpbenchWarning, stacklevel=3)


def _label_all(
    observed: list[Observed],
    bundle: Bundle,
    board: Board,
    paths: dict[str, Path],
    hard: dict[str, Hard],
    progress: Callable[[int], None],
) -> tuple[list[Observed], list[Observed], list[PhotoLabels], bool]:
    """Label every photograph of a bundle, and the hard ones of series. Those without a label are rejected."""
    board_mm = board_points_mm(board)
    labels, kept, done, has_colour = list[PhotoLabels](), list[Observed](), list[Observed](), False
    at, easy = 0, dict[str, UInt8]()
    for o in observed:
        progress(1)
        row, at = at, at + (not o.reason)
        series = hard.get(o.photo.name)
        if series or not o.reason:
            image = _read(paths[o.photo.name])
            if series:
                if series.series not in easy:  # one image at a time, as photographs are large
                    easy = {series.series: as_grey(_read(paths[series.easy.photo.name]))}
                found = label_photo(bundle, series.row, board, board_mm, as_grey(image), easy[series.series])
                o = replace(o, reason="")
            else:
                found = label_photo(bundle, row, board, board_mm, as_grey(image))
            if len(found.keypoints):
                has_colour |= image.ndim == 3
                labels.append(found)
                kept.append(o)
            else:
                o = replace(o, reason="no-labels")
        done.append(o)
    if not labels:
        raise DataError(f"{next(iter(paths.values())).parent}: no patch can be labelled in any photograph")
    return done, kept, labels, has_colour


def _condition(
    o: Observed, found: PhotoLabels, condition: Condition, board: Board, bundle: Bundle
) -> tuple[str, float]:
    if condition == "folders":
        return name_condition(o.photo.name)
    return measure_condition(condition, board, bundle.camera, found.pose, bundle.shape)


def _calibrate_sigma(labels: Sequence[PhotoLabels]) -> tuple[float, float]:
    """Return the factor of all standard deviations that the check of every mark tells, and the errors of the check."""
    nees = np.concatenate([found.leave_one_out.nees for found in labels])
    error = np.concatenate([found.leave_one_out.error for found in labels])
    return float(np.sqrt(np.clip(nees.mean() / 2, 0.25, 100.0))), float(np.sqrt((error**2).mean()))


def _scaled(keypoints: NDArray[Any], factor: float, drift_px: float) -> NDArray[Any]:
    """Return keypoints with all standard deviations times a factor, and ``COMMON_SIGMA_PX`` and a drift added."""
    table = keypoints.copy()
    for name in ("sigma_x", "sigma_y"):
        table[name] = np.hypot(factor * keypoints[name], np.hypot(COMMON_SIGMA_PX, drift_px))
    table["rho"] *= factor**2 * keypoints["sigma_x"] * keypoints["sigma_y"] / (table["sigma_x"] * table["sigma_y"])
    return table


def _describe(
    board: Board,
    bundle: Bundle,
    observed: Sequence[Observed],
    kept: Sequence[Observed],
    labels: Sequence[PhotoLabels],
    hard: dict[str, Hard],
    source: Source,
    has_colour: bool,
) -> dict[str, Any]:
    """Return the configuration of the dataset: what made the truth, and what was left out."""
    width, height = kept[0].photo.size_px
    photos = [
        o.photo.to_dict()
        | {
            "marks": len(o.points),
            "rms_px": round(found.rms_px, 4),
            "unlabelled": found.unlabelled,
            "rolling_px": round(found.rolling_px, 3),
        }
        | ({"truth_of": hard[o.photo.name].easy.photo.name} if o.photo.name in hard else {})
        for o, found in zip(kept, labels, strict=True)
    ]
    return {
        "kind": "photographs",
        "source": source,
        "size_px": [width, height],
        "channels": 3 if has_colour else 1,
        "patches": [patch.to_dict() for patch in board.patches],
        "board": {"name": board.name, "digest": board.digest, "points_mm": board.points_mm.tolist()},
        "print": {name: float(f"{value:.6g}") for name, value in zip(SHAPE_NAMES, bundle.shape.values, strict=True)},
        "camera": bundle.camera.to_dict(),
        "pixels_turned": False,
        "photos": photos,
        "rejected": [{"name": o.photo.name, "reason": o.reason} for o in observed if o.reason],
    }


def _read(path: Path) -> UInt8:
    _, image = read_photo(path.name, path)
    if image is None:
        raise DataError(f"{path}: cannot be decoded any more")
    return image


def summarise_unlabelled(config: dict[str, Any]) -> dict[str, int]:
    """Return how many keypoints of a labelled dataset have no label, by reason."""
    total = Counter[str]()
    for photo in config["photos"]:
        total.update(photo["unlabelled"])
    return dict(total)
