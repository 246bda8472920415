"""Verify the scores of a submission: make its images anew, and run its detector again on a random part of them.

A submission is the folder of a `kpbench bench`, or its parts ``scores`` and ``predictions``. It is not trusted: only
detectors that ship with kpbench are loaded by the name in the submission.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from kpbench.benchmark.run import make_suite_dataset
from kpbench.dataset.folder import Dataset
from kpbench.detectors.interface import DETECTORS, load_detector
from kpbench.detectors.prediction import detect_images
from kpbench.errors import DataError
from kpbench.files import load_json, read_bytes, sha256_of, shipped_files
from kpbench.predictions.files import read_predictions
from kpbench.scoring.groups import GroupKey
from kpbench.scoring.scores import SCHEMA, score
from kpbench.synth.suite import SuiteConfig
from kpbench.synth.suite_file import load_suite
from kpbench.types import Detections, Predictions
from kpbench.workers import Progress

LARGEST_SHIFT_PX = 0.01
"""Largest distance between a detection of the submission and the same detection of the rerun, px. Processors round
differently."""
LARGEST_SCORE_CHANGE = 1e-3
"""Largest difference of their scores, relative to the larger of 1 and the score."""

OTHER_IDENTITY_PX = 1e6
"""A length beyond every image: detections of two identities are this far apart."""


@dataclass(frozen=True)
class Verification:
    """The result of verifying one scores file.

    Attributes
    ----------
    suite, detector : str
    scores : Path
        The scores file.
    images : tuple of int
        IDs of the images on which the detector ran again.
    seed : int
        Seed of the choice of these images.
    problem : str
        What refutes the scores; "" if they are verified.

    Examples
    --------
    >>> import kpbench
    >>> from pathlib import Path
    >>> kpbench.Verification("paper-v1", "orb", Path("orb.json"), (3, 9), 7, "").problem
    ''
    """

    suite: str
    detector: str
    scores: Path
    images: tuple[int, ...]
    seed: int
    problem: str

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of a verification file."""
        about = {"suite": self.suite, "detector": self.detector, "seed": self.seed, "problem": self.problem}
        return about | {"scores_sha256": sha256_of(self.scores), "images": len(self.images)}


def verify_submission(
    submission: str | Path,
    out: str | Path,
    *,
    percent: float = 2.0,
    seed: int | None = None,
    detectors: Mapping[str, str] | None = None,
    backgrounds: Path | None = None,
    workers: int | None = None,
    progress: Progress = lambda images: None,
) -> list[Verification]:
    """Verify every scores file of a submission.

    Scores are refuted if the images, made anew, have another fingerprint; if the scores do not follow from the
    predictions; or if the detector, run again, finds something else in an image of the sample.

    Parameters
    ----------
    submission : str or Path
        Folder with ``scores/SUITE/DETECTOR.json`` and ``predictions/*/*.json``, as ``kpbench bench`` writes them.
    out : str or Path
        Folder for the images, which are made anew; finished images in it are kept.
    percent : float
        Share of the images on which the detector runs again; at least one image.
    seed : int, optional
        Seed of the choice of images. None: a number that nobody can foresee.
    detectors : mapping, optional
        How to load detectors that do not ship with kpbench: name in the submission → name as for
        :func:`kpbench.load_detector`. Names of a submission are never loaded as code.
    backgrounds : Path, optional
        Folder of photographs, for results over photographs.
    workers : int or None
        Number of processes that make images; None for one per core.
    progress : callable
        Called with the number of images made since the last call.

    Returns
    -------
    list of Verification

    Raises
    ------
    DataError
        If the folder holds no scores, or a scores file cannot be read.

    Examples
    --------
    >>> import kpbench
    >>> suite = kpbench.SuiteConfig(kpbench.load_suite("paper-v1"), images=1, size_px=(203, 155), only=("blur",))
    >>> runs = kpbench.bench([suite], ["orb"], "bench", workers=1)
    >>> _ = kpbench.write_suite_reports(runs, "bench")
    >>> [found] = kpbench.verify_submission("bench", "again", workers=1)
    >>> found.detector, len(found.images), found.problem
    ('orb', 1, '')
    """
    if not 0 < percent <= 100:
        raise DataError(f"`percent` is {percent:g}, expected more than 0, at most 100")
    files = sorted(Path(submission).glob("scores/*/*.json"))
    if not files:
        raise DataError(
            f"{submission}: holds no scores, expected scores/SUITE/DETECTOR.json as kpbench bench writes it"
        )
    seed = secrets.randbits(32) if seed is None else seed
    found = []
    for file in files:
        content = read_scores_json(file)
        suite, detector = content["provenance"]["config"]["suite"], content["detector"]["name"]
        config = _suite_config(content["provenance"]["config"], file, backgrounds)
        images: tuple[int, ...] = ()
        if not (problem := _find_config_fault(config, content)):
            dataset = make_suite_dataset(config, Path(out, "suites"), workers, progress)
            images, problem = _rerun(content, Path(submission), dataset, percent, seed, detectors or {})
        found.append(Verification(suite, detector, file, images, seed, problem))
    return found


def read_scores_json(file: Path) -> dict[str, Any]:
    """Read a scores file of a suite as plain data.

    Raises
    ------
    DataError
        If the file is no scores file, or tells no suite.
    """
    try:
        content = load_json(read_bytes(file))
        schema, config, detector = content["schema"], content["provenance"]["config"], content["detector"]
        digest = content["provenance"]["predictions"][0]["sha256"]
        texts = (config["suite"], detector["name"], content["dataset"]["fingerprint"], digest)
        if not all(isinstance(text, str) for text in texts):
            raise TypeError("a name or digest is no text")
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise DataError(f"{file}: {type(error).__name__}: {error}, expected the scores of a suite") from None
    if schema != SCHEMA:
        raise DataError(f"{file}: schema is {schema!r}, expected {SCHEMA!r}")
    return dict(content)


def _suite_config(recorded: Mapping[str, Any], file: Path, backgrounds: Path | None) -> SuiteConfig:
    """Return the configuration that makes the images of the recorded one."""
    try:
        if recorded["suite"] not in shipped_files("suites"):  # such as the path of a file
            raise ValueError(f"suite is {recorded['suite']!r}, which does not ship with kpbench")
        width, height = recorded["size_px"]
        names = tuple(str(condition["name"]) for condition in recorded["conditions"])
        board = recorded["board"]["name"] if "board" in recorded else None
        photos = backgrounds if recorded["backgrounds"]["kind"] == "photographs" else None
        return SuiteConfig(
            load_suite(str(recorded["suite"])),
            int(recorded["images"]),
            int(recorded["seed"]),
            (int(width), int(height)),
            names,
            photos,
            board=board,
            shard_size=int(recorded["shard_size"]),
        )
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{file}: provenance.config: {type(error).__name__}: {error}, expected a suite's") from None


def _find_config_fault(config: SuiteConfig, content: Mapping[str, Any]) -> str:
    """Return how the suite of kpbench differs from the recorded one; "" if it does not."""
    recorded, made = content["provenance"]["config"], json.loads(json.dumps(config.to_dict()))
    wrong = [key for key in made if made[key] != recorded.get(key)]
    return f"its suite differs from {config.suite.name} of kpbench: {', '.join(sorted(wrong))}" if wrong else ""


def _rerun(
    content: Mapping[str, Any],
    submission: Path,
    dataset: Dataset,
    percent: float,
    seed: int,
    detectors: Mapping[str, str],
) -> tuple[tuple[int, ...], str]:
    """Return the images on which the detector ran again, and what refutes the scores."""
    if dataset.fingerprint != content["dataset"]["fingerprint"]:
        return (
            (),
            f"its images have the fingerprint {content['dataset']['fingerprint'][:16]}, made anew they have another",
        )
    named = content["provenance"]["predictions"][0]["sha256"]
    file = next((f for f in sorted(submission.glob("predictions/*/*.json")) if sha256_of(f) == named), None)
    if file is None:
        return (), f"no predictions file has the SHA-256 that the scores name, {str(named)[:16]}"
    predictions = read_predictions(file)
    again = json.loads(json.dumps(score(dataset, predictions).to_dict()))
    if not _are_alike(again, content):
        return (), "its scores do not follow from its predictions"
    recorded = content["detector"]
    name = detectors.get(recorded["name"], recorded["name"])
    if name not in DETECTORS and recorded["name"] not in detectors:
        return (), f"the detector {name!r} does not ship with kpbench; say with `detectors` how to load it"
    loaded = load_detector(name)
    if loaded.version != recorded.get("version"):
        return (), f"its detector is {recorded.get('version')!r}, the one here {loaded.version!r}"
    return _compare_sample(predictions, dataset, name, percent, seed)


def _are_alike(one: Mapping[str, Any], two: Mapping[str, Any]) -> bool:
    """Return whether two scores have the same groups, and in all groups the same metrics and intervals."""

    def parts(scores: Mapping[str, Any]) -> Iterator[Any]:
        yield scores["settings"]
        for group in (scores, *scores["by"]):
            yield {key: group.get(key) for key in GroupKey._fields}
            yield _rounded(group["metrics"])

    try:
        return list(parts(one)) == list(parts(two))
    except (KeyError, TypeError, AttributeError):
        return False


def _rounded(value: Any) -> Any:
    """Return numbers to seven digits, as machines and versions of NumPy sum in different orders."""
    if isinstance(value, dict):
        return {key: _rounded(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_rounded(part) for part in value]
    return f"{value:.7g}" if isinstance(value, float) else value


def _compare_sample(
    predictions: Predictions, dataset: Dataset, detector: str, percent: float, seed: int
) -> tuple[tuple[int, ...], str]:
    rng = np.random.default_rng(seed)
    count = max(1, round(percent / 100 * len(dataset)))
    sample = sorted(rng.choice(len(dataset), count, replace=False).tolist())
    ids = tuple(int(dataset.truth.image_id[n]) for n in sample)
    of_image = dict(zip(predictions.image_id.tolist(), predictions.detections(), strict=True))
    for n, result in detect_images(dataset, detector, None, sample, lambda images: None).items():
        image_id = int(dataset.truth.image_id[n])
        if problem := _find_difference(of_image[image_id], result.detections):
            return ids, f"image_id {image_id}: {problem}"
    return ids, ""


def _find_difference(told: Detections, found: Detections) -> str:
    """Return how the detections of a rerun differ from those of a submission; "" if they do not."""
    if len(told) != len(found):
        return f"{len(told)} detections, its detector finds {len(found)}"
    distance = np.linalg.norm(told.xy[:, None] - found.xy[None], axis=2)
    if told.patch_id is not None and found.patch_id is not None:
        distance += OTHER_IDENTITY_PX * (told.patch_id[:, None] != found.patch_id[None])
    a, b = linear_sum_assignment(distance)
    shift = float(distance[a, b].max(initial=0.0))
    if shift >= OTHER_IDENTITY_PX:
        return "a detection has another identity than its detector gives it"
    if shift > LARGEST_SHIFT_PX:
        return f"a detection lies {shift:.3g} px from where its detector finds it"
    change = abs(told.score[a] - found.score[b]) / np.maximum(1.0, abs(found.score[b]))
    if float(change.max(initial=0.0)) > LARGEST_SCORE_CHANGE:
        return "a detection has another score than its detector gives it"
    if (told.patch_id is None) != (found.patch_id is None):
        return "only one of the submission and its detector gives identities"
    return ""
