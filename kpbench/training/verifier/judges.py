"""Training of the two judges (:func:`kpbench.detectors.verification.judge`).

Both judges are small networks with the same layers, but different widths. A judge learns to tell right hypotheses from
wrong hypotheses, and to correct their poses. :func:`kpbench.training.verifier.labels.label_hypotheses` defines "right".

1. :func:`kpbench.training.verifier.judge_samples.collect_looks` collects the hypotheses that the first judge sees at
   its first look and at its second look. Before the second look, an earlier first judge corrects the poses, because
   the new first judge does not exist yet. Without an earlier judge, there is a first look alone.
2. The new first judge is trained on these hypotheses, before the fit. The centre of a right hypothesis may be 0.2 long
   semi-axes away from the keypoint. Most hypotheses are easy: the earlier first judge rates them correctly, with high
   certainty. Easy hypotheses are drawn rarely, and each drawn easy hypothesis gets more weight.
3. :func:`kpbench.training.verifier.judge_samples.collect_fits` fits the hypotheses that the new first judge finds
   likely.
4. The second judge is trained on the fitted hypotheses. The centre of a right hypothesis may now be 0.1 long semi-axes
   away from the keypoint.
5. The log odds of the second judge are shifted, so that a score of 0.5 gives a wanted rate of false alarms on the test
   dataset (:func:`kpbench.training.verifier.judge_report.place_threshold`).
"""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from kpbench.dataset.folder import Dataset
from kpbench.detectors.hypotheses import Hypotheses
from kpbench.detectors.verification import FIRST_JUDGE, SECOND_JUDGE, WEIGHTS
from kpbench.files import make_folder
from kpbench.patches.design import Patch
from kpbench.training.verifier.dataset_images import load_places_detector, map_images
from kpbench.training.verifier.judge_network import Judge, input_tensors
from kpbench.training.verifier.judge_report import place_threshold, report_judges
from kpbench.training.verifier.judge_samples import ImageLooks, collect_fits, collect_looks
from kpbench.training.verifier.labels import FIT_TOLERANCE, POSE_TOLERANCE, label_hypotheses, pose_errors
from kpbench.training.verifier.small_networks import (
    BATCHNORM_SAMPLES,
    CONTINUED_LEARNING_RATE,
    LEARNING_RATE,
    NETWORK_KIND,
    Say,
    load_shipped,
    train_one_cycle,
    write_network,
)
from kpbench.types import Float
from kpbench.writing import require_writable

FIRST_WIDTH, SECOND_WIDTH = 32, 48
"""Number of channels of the first layers: of the first judge, and of the second judge."""
KNOWN_SHARE = 12.0
"""In an epoch, a hypothesis is drawn with the probability min(KNOWN_SHARE · exp(-z/2), 1). z are the log odds that the
earlier first judge gives to the true label of the hypothesis."""


def train_judges(
    datasets: Sequence[Dataset],
    test: Dataset,
    out: Path,
    *,
    detector: Path | None = None,
    weights: Path | None = None,
    epochs: int = 10,
    alarms_per_image: float = 0.04,
    batch: int = 256,
    from_shipped: bool = False,
    workers: int = 1,
    threads: int | None = None,
    say: Say = lambda line: None,
) -> None:
    """Train the two judges and write them as ``first-judge.onnx`` and ``second-judge.onnx``.

    Parameters
    ----------
    datasets, test, out, epochs, batch, from_shipped, workers, threads, say
        See :func:`kpbench.training.train_ellipse`. The report gives detection scores at several rates of false alarms.
    detector : Path, optional
        File of ``kpbench export-model`` that holds the detector whose candidates are judged. None: the detector
        ``superpoint-small``.
    weights : Path, optional
        Folder of the ellipse network, and of the earlier first judge, if there is one. None: the shipped networks.
    alarms_per_image : float
        Largest number of false alarms per test image at a score of 0.5, from which on a detector reports.

    Raises
    ------
    DataError
        If a dataset or the detector cannot be read, or the folder cannot be written.

    Examples
    --------
    >>> from pathlib import Path
    >>> import kpbench
    >>> from kpbench.training import train_judges
    >>> sets = [kpbench.open_dataset(name) for name in ("set-1", "set-2")]  # doctest: +SKIP
    >>> train_judges(sets, kpbench.open_dataset("set-3"), Path("judges"), say=print)  # doctest: +SKIP
    """
    for name in (FIRST_JUDGE, SECOND_JUDGE):
        require_writable(make_folder(out) / f"{name}.onnx", NETWORK_KIND)
    if threads:
        torch.set_num_threads(threads)
    patches, sets = load_places_detector(detector).patches, [*datasets, test]
    look = partial(collect_looks, detector, weights or WEIGHTS)
    looks = [
        map_images(look, part, repeat(part is not test, len(part)), workers, f"look {n}") for n, part in enumerate(sets)
    ]
    settings = _Settings(patches, epochs, batch, from_shipped, say)
    first = _train_first([image for part in looks[:-1] for image in part], settings)
    packed = pickle.dumps(first)
    fits = []
    for n, (part, of_part) in enumerate(zip(sets, looks, strict=True)):
        work = partial(collect_fits, detector, packed, part is not test)
        fits.append(map_images(work, part, [image.first_look for image in of_part], workers, f"fit {n}"))
    truths = [image.keypoints for part in looks[:-1] for image in part]
    second = _train_second([image.fitted for part in fits[:-1] for image in part], truths, settings)
    place_threshold(looks[-1], fits[-1], second, patches, alarms_per_image, say)
    report_judges(looks[-1], fits[-1], second, patches, say)
    for name, network, seen in (
        (FIRST_JUDGE, first, [image.first_look for image in looks[-1]]),
        (SECOND_JUDGE, second, [image.fitted for image in fits[-1]]),
    ):
        inputs = [input_tensors(hypotheses, patches) for hypotheses in seen if len(hypotheses)][:100]
        write_network(network, ["view", "evidence"], inputs, out / f"{name}.onnx", say)


@dataclass(frozen=True)
class _Settings:
    """Settings that the trainings of both judges share; see :func:`train_judges`."""

    patches: Sequence[Patch]
    epochs: int
    batch: int
    from_shipped: bool
    say: Say


@dataclass(frozen=True)
class LabelledHypotheses:
    """Hypotheses of many images, with the targets of a judge.

    Attributes
    ----------
    hypotheses : Hypotheses
    right, near : ndarray of shape (n,), bool
        Whether each hypothesis is right, and whether the judge learns the pose from this hypothesis.
    shift, log_map : ndarray of shape (n, 2) and (n, 2, 2)
        Corrections that turn the poses into the true poses, see :func:`kpbench.detectors.verification.move_poses`.
    share : ndarray of shape (n,)
        Probability that a hypothesis is drawn in an epoch. The weight of the hypothesis is 1 / ``share``.
    """

    hypotheses: Hypotheses
    right: NDArray[np.bool_]
    near: NDArray[np.bool_]
    shift: Float
    log_map: Float
    share: Float


def _label(
    hypotheses: Sequence[Hypotheses],
    patches: Sequence[Patch],
    truths: Sequence[NDArray[Any]],
    known_log_odds: Float,
    tolerance: float,
) -> LabelledHypotheses:
    """Label the hypotheses of many images.

    ``known_log_odds`` : log odds (n,) that an earlier judge gave to the hypotheses; 0 without an earlier judge.
    ``tolerance`` : largest distance of a right hypothesis from its keypoint, in long semi-axes.
    """
    pairs = list(zip(hypotheses, truths, strict=True))
    right = np.concatenate([label_hypotheses(part, patches, truth, tolerance) for part, truth in pairs])
    errors = zip(*(pose_errors(part, patches, truth) for part, truth in pairs), strict=True)
    near, shift, log_map = (np.concatenate(column) for column in errors)
    share = np.minimum(KNOWN_SHARE * np.exp(np.where(right, -known_log_odds, known_log_odds) / 2), 1.0)
    return LabelledHypotheses(Hypotheses.concatenate(hypotheses), right, near, shift, log_map, share)


def _train_first(looks: Sequence[ImageLooks], settings: _Settings) -> Judge:
    """Train the first judge on the hypotheses of both looks, with the log odds from the earlier first judge."""
    hypotheses = [look for image in looks for look in (image.first_look, image.second_look)]
    truths = [image.keypoints for image in looks for _ in range(2)]
    known = np.concatenate([image.earlier_log_odds for image in looks])
    training = _label(hypotheses, settings.patches, truths, known, POSE_TOLERANCE)
    return _train(training, FIRST_JUDGE, FIRST_WIDTH, settings)


def _train_second(fitted: Sequence[Hypotheses], truths: Sequence[NDArray[Any]], settings: _Settings) -> Judge:
    """Train the second judge on the fitted hypotheses, without log odds from an earlier judge."""
    unknown = np.zeros(sum(map(len, fitted)))
    training = _label(fitted, settings.patches, truths, unknown, FIT_TOLERANCE)
    return _train(training, SECOND_JUDGE, SECOND_WIDTH, settings)


def _train(training: LabelledHypotheses, name: str, width: int, settings: _Settings) -> Judge:
    """Train a judge with two losses.

    The first loss is the cross-entropy of the log odds. The second loss is the smooth L1 loss of shift and log map, and
    counts only hypotheses where ``training.near`` is true.
    """
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    whole, share, patches = training.hypotheses, training.share, settings.patches
    target, near = torch.from_numpy(training.right).float(), torch.from_numpy(training.near)
    shift, log_map = torch.from_numpy(training.shift).float(), torch.from_numpy(training.log_map).float()
    weight = torch.from_numpy(1 / share).float()

    def draw_rows() -> Tensor:
        return torch.from_numpy(rng.permutation(np.flatnonzero(rng.random(len(share)) < share)))

    some_evidence = whole.evidence[:: max(1, len(whole) // 100_000)]
    network = Judge(some_evidence, width).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if settings.from_shipped:
        seen = whole[rng.permutation(len(whole))[:BATCHNORM_SAMPLES]]
        load_shipped(network, name, input_tensors(seen, patches))

    def loss(rows: Tensor) -> Tensor:
        view, evidence = input_tensors(whole[rows.numpy()], patches)
        odds, predicted_shift, predicted_map = (part.float() for part in network(_disturb(view), evidence))
        value = nn.functional.binary_cross_entropy_with_logits(odds, target[rows], weight[rows])
        if (taught := near[rows]).any():
            value = value + nn.functional.smooth_l1_loss(predicted_shift[taught], shift[rows][taught], beta=0.02)
            value = value + nn.functional.smooth_l1_loss(predicted_map[taught], log_map[rows][taught], beta=0.05)
        return value

    settings.say(f"train on {len(share)} hypotheses, {training.right.mean():.0%} right, {share.sum():.0f} per epoch")
    learning_rate = CONTINUED_LEARNING_RATE if settings.from_shipped else LEARNING_RATE
    train_one_cycle(network, loss, draw_rows, settings.epochs, settings.batch, learning_rate)
    return cast(Judge, network)


def _disturb(view: Tensor) -> Tensor:
    """Change the contrast and the brightness of the image in each view, and add a little noise.

    The second channel of a view, which shows the design, is not changed.
    """
    shape = (len(view), 1, 1, 1)
    gain, offset = torch.exp(0.15 * torch.randn(shape)), 0.1 * torch.randn(shape)
    image = view[:, :1] * gain + offset + 0.1 * torch.rand(shape) * torch.randn_like(view[:, :1])
    return torch.cat([torch.where(view.any(dim=1, keepdim=True), image, 0.0), view[:, 1:]], dim=1)
