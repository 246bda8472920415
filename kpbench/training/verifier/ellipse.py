"""Training of the ellipse network (:func:`kpbench.detectors.verification.find_ellipses`).

A place is a point of an image. The ellipse network sees the surroundings of a place at four scales, which are octaves.
The network gives the log odds that the place lies on a patch, the centre of the patch, and the ellipse that the patch
fills. The network does not learn the design of the patch.

1. :func:`collect_places` collects the places of each training image. Some places are candidates of the detector's
   network. The other places are drawn at random around the true keypoints. If an image shows a design that the
   detector's network does not know, the candidates are left out. Most surroundings are rotated and scaled at random.
2. The network is trained on batches of places; each batch is mirrored at random.
3. :func:`calibrate_log_odds` calibrates the log odds on the candidates in a test dataset.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from kpbench.dataset.folder import Dataset
from kpbench.detectors.verification import ELLIPSE
from kpbench.files import make_folder
from kpbench.fitting.pyramid import Pyramids
from kpbench.fitting.templates import VIEW_PX
from kpbench.fitting.views import OCTAVES, sample_surroundings
from kpbench.training.verifier.dataset_images import ImageRef, load_places_detector, map_images
from kpbench.training.verifier.labels import affine_at_centre, log_ellipse
from kpbench.training.verifier.small_networks import (
    BATCHNORM_SAMPLES,
    CONTINUED_LEARNING_RATE,
    LEARNING_RATE,
    NETWORK_KIND,
    Say,
    load_shipped,
    train_one_cycle,
    trunk,
    write_network,
)
from kpbench.types import Float, Float32, Int
from kpbench.writing import require_writable

ON_PATCH, OFF_PATCH = 0.6, 1.0
"""A place within 0.6 short semi-axes of a patch's centre lies on the patch. A place further than 1.0 long semi-axes
from all centres lies on no patch."""
EMPTY_PLACES = 14
"""Largest number of places per training image that lie on no patch."""
MADE_PLACES, MADE_DEVIATION = 3, 0.22
"""Number of places drawn around each keypoint of a training image, and standard deviation of their offsets from the
keypoint: in x and in y, in short semi-axes."""
ROTATED_SHARE, OCTAVES_OF_SCALE = 0.7, 0.35
"""Probability that the surroundings of a training place are rotated and scaled; largest change of scale, octaves."""
OWN_RADIUS_PX = 28.0
"""A patch of this radius is found in the image itself about as often as in the image of half its size, px."""
USUAL_LOG_RADIUS = 2.5
"""Natural logarithm of a usual semi-axis in px. An untrained network predicts semi-axes of about this length."""
RADII_PX = ((0, 5), (5, 8), (8, 12), (12, 20), (20, 1000))
"""Ranges of the short semi-axis, px. The report has one line for each range."""
LOG_ODDS = (-8, -7, -6, -5, -4, -2, 0)
"""Thresholds of the log odds. The report has one line for each threshold."""


class EllipseNetwork(nn.Module):
    """Network that takes the surroundings of places. It returns log odds and ellipses."""

    def __init__(self, width: int = 32) -> None:
        super().__init__()
        self.body = nn.Sequential(
            *trunk(OCTAVES, width),
            nn.Linear(3 * width * (VIEW_PX // 8) ** 2, 192),
            nn.ReLU(),
            nn.Linear(192, 6),
        )

    def forward(self, surroundings: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return log odds (n,), shift (n, 2) and log map (n, 2, 2) of n places.

        ``surroundings`` : (n, OCTAVES, VIEW_PX, VIEW_PX), grey levels.
        :func:`kpbench.detectors.verification.move_poses` defines shift and log map.
        """
        centred = surroundings - surroundings.mean((2, 3), keepdim=True)
        out = self.body(centred / (centred.square().mean((2, 3), keepdim=True).sqrt() + 2.0))
        xx, yy, xy = out[:, 3] + USUAL_LOG_RADIUS, out[:, 4] + USUAL_LOG_RADIUS, out[:, 5]
        return out[:, 0], out[:, 1:3], torch.stack([xx, xy, xy, yy], 1).unflatten(1, (2, 2))  # type: ignore[no-untyped-call]


class Places(NamedTuple):
    """Surroundings of n places of one image, and the targets of the network.

    Attributes
    ----------
    surroundings : ndarray of shape (n, OCTAVES, VIEW_PX, VIEW_PX), float16
    on_patch : ndarray of shape (n,), bool
    shift, log_map : ndarray of shape (n, 2) and (n, 2, 2), float32
        Shift and log map that the network should return; 0 for places on no patch.
    """

    surroundings: NDArray[np.float16]
    on_patch: NDArray[np.bool_]
    shift: Float32
    log_map: Float32


class PlaceTensors(NamedTuple):
    """:class:`Places` of many images, as tensors."""

    surroundings: Tensor
    on_patch: Tensor
    shift: Tensor
    log_map: Tensor


def train_ellipse(
    datasets: Sequence[Dataset],
    test: Dataset,
    out: Path,
    *,
    detector: Path | None = None,
    epochs: int = 6,
    batch: int = 256,
    from_shipped: bool = False,
    workers: int = 1,
    threads: int | None = None,
    say: Say = lambda line: None,
) -> None:
    """Train the ellipse network and write it as ``ellipse.onnx``.

    Parameters
    ----------
    datasets : sequence of Dataset
        Synthetic images to train on.
    test : Dataset
        Synthetic images on which the log odds are calibrated and the report is measured.
    out : Path
        Folder in which the file is written.
    detector : Path, optional
        File of ``kpbench export-model`` that holds the detector whose candidates become places. None: the detector
        ``superpoint-small``.
    epochs, batch : int
        Number of passes over all places, and number of places per step.
    from_shipped : bool
        Start from the shipped weights. With ``epochs=0``, the weights are only calibrated, reported and written.
    workers : int
        Number of worker processes that collect places; 0: this process collects the places.
    threads : int, optional
        Threads of PyTorch.
    say : callable
        Receives the report, line by line.

    Raises
    ------
    DataError
        If a dataset cannot be read, or the folder cannot be written.

    Examples
    --------
    >>> from pathlib import Path
    >>> import kpbench
    >>> from kpbench.training import train_ellipse
    >>> sets = [kpbench.open_dataset(name) for name in ("set-1", "set-2")]  # doctest: +SKIP
    >>> train_ellipse(sets, kpbench.open_dataset("set-3"), Path("ellipse"), say=print)  # doctest: +SKIP
    """
    require_writable(make_folder(out) / f"{ELLIPSE}.onnx", NETWORK_KIND)
    if threads:
        torch.set_num_threads(threads)
    parts: list[Places] = []
    work = partial(collect_places, detector)
    for dataset in datasets:
        parts += map_images(work, dataset, repeat(True, len(dataset)), workers, str(dataset.path))
    places = _concatenate(parts)
    say(f"train on {len(places.on_patch)} places, {places.on_patch.float().mean():.0%} on patches")
    network = _train(places, epochs, batch, from_shipped)
    test_places = _concatenate(map_images(work, test, repeat(False, len(test)), workers, str(test.path)))
    calibrate_log_odds(network, test_places)
    _report(network, test_places, len(test), say)
    seen = [(some.float(),) for some in torch.split(test_places.surroundings[:4096], 64)]
    write_network(network, ["surroundings"], seen, out / f"{ELLIPSE}.onnx", say)


def collect_places(detector_path: Path | None, image: ImageRef, train: bool) -> Places:
    """Return the places of one image, each in the picture of its own scale.

    The detector's candidates become places. A candidate that lies neither on a patch (``ON_PATCH``) nor on no patch
    (``OFF_PATCH``) is left out.

    ``detector_path`` : see :func:`load_places_detector`.
    ``train`` : True adds places around the keypoints, keeps at most ``EMPTY_PLACES`` places on no patch, and rotates
    and scales most surroundings. False does none of these three things.
    """
    grey, keypoints = image.read()
    rng = image.rng()
    detector = load_places_detector(detector_path)
    known = {patch.patch_id for patch in detector.patches} >= set(keypoints["patch_id"].tolist())
    xy, _, _, octave = detector.candidates([grey])[0]
    if not known:
        xy, octave = xy[:0], octave[:0]
    own, on, off = _match_places(xy, keypoints)
    centres = np.column_stack([keypoints["x"], keypoints["y"]])
    if train:
        off[rng.permutation(np.flatnonzero(off))[EMPTY_PLACES:]] = False
        repeated = np.tile(np.arange(len(keypoints)), MADE_PLACES)
        offset = rng.normal(0, MADE_DEVIATION, (len(repeated), 2)) * keypoints["radius_minor"][repeated, None]
        xy = np.concatenate([xy[on], xy[off], centres[repeated] + offset])
        own_octave = np.log2(keypoints["radius_major"] / OWN_RADIUS_PX) + rng.uniform(-0.5, 0.5, len(keypoints))
        own_octave = np.clip(np.rint(own_octave), 0, None).astype(np.int64)
        octave = np.concatenate([octave[on], octave[off], own_octave[repeated]])
        own = np.concatenate([own[on], own[off], repeated])
        on = np.repeat([True, False, True], [on.sum(), off.sum(), len(repeated)])
    else:
        xy, octave, own, on = xy[on | off], octave[on | off], own[on | off], on[on | off]
    frame = np.tile(np.eye(2), (len(xy), 1, 1))
    for k in np.flatnonzero(rng.random(len(xy)) < ROTATED_SHARE) if train else ():
        angle = rng.uniform(0, 2 * np.pi)
        c, s = np.array([np.cos(angle), np.sin(angle)]) * 2 ** rng.uniform(-OCTAVES_OF_SCALE, OCTAVES_OF_SCALE)
        frame[k] = [[c, -s], [s, c]]
    smooth = Pyramids(grey).smooth
    octave = np.minimum(octave, len(smooth) - 1)
    surroundings = sample_surroundings(smooth, xy, frame, octave).astype(np.float16)
    frame *= 2.0 ** octave[:, None, None]
    shift, log_map = np.zeros((len(xy), 2)), np.zeros((len(xy), 2, 2))
    to_frame = np.linalg.inv(frame[on])
    log_map[on] = log_ellipse(to_frame @ affine_at_centre(keypoints["H_patch2image"][own[on]]))
    size, axes = np.linalg.eigh(log_map[on])
    to_unit = np.einsum("nij,nj,nkj->nik", axes, np.exp(-size), axes)
    shift[on] = np.einsum("nij,njk,nk->ni", to_unit, to_frame, centres[own[on]] - xy[on])
    return Places(surroundings, on, shift.astype(np.float32), log_map.astype(np.float32))


def _match_places(xy: Float, keypoints: NDArray[Any]) -> tuple[Int, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the nearest keypoint of each place, whether the place is on a patch, and whether it is on no patch."""
    if not len(keypoints):
        return np.zeros(len(xy), np.int64), np.zeros(len(xy), bool), np.ones(len(xy), bool)
    distance = np.hypot(xy[:, :1] - keypoints["x"], xy[:, 1:] - keypoints["y"])
    on = distance <= ON_PATCH * keypoints["radius_minor"]
    nearest = (distance / keypoints["radius_minor"]).argmin(axis=1)
    return nearest, on.any(axis=1), (distance > OFF_PATCH * keypoints["radius_major"]).all(axis=1)


def _concatenate(parts: Sequence[Places]) -> PlaceTensors:
    return PlaceTensors(*(torch.from_numpy(np.concatenate(column)) for column in zip(*parts, strict=True)))


def _train(places: PlaceTensors, epochs: int, batch: int, from_shipped: bool) -> EllipseNetwork:
    """Train with cross-entropy for the log odds, and with smooth L1 loss for shift and log map of places on patches."""
    torch.manual_seed(0)
    network = EllipseNetwork().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    count = len(places.on_patch)
    if from_shipped:
        load_shipped(network, ELLIPSE, (places.surroundings[torch.randperm(count)[:BATCHNORM_SAMPLES]].float(),))

    def loss(rows: Tensor) -> Tensor:
        surroundings, on, shift, log_map = _mirror(PlaceTensors(*(column[rows] for column in places)))
        other_contrast = surroundings * torch.exp(0.2 * torch.randn(len(surroundings), 1, 1, 1))
        odds, predicted_shift, predicted_map = (part.float() for part in network(other_contrast))
        return (
            nn.functional.binary_cross_entropy_with_logits(odds, on.float())
            + 4 * nn.functional.smooth_l1_loss(predicted_shift[on], shift[on], beta=0.03)
            + 3 * nn.functional.smooth_l1_loss(predicted_map[on], log_map[on], beta=0.05)
        )

    learning_rate = CONTINUED_LEARNING_RATE if from_shipped else LEARNING_RATE
    train_one_cycle(network, loss, lambda: torch.randperm(count), epochs, batch, learning_rate)
    return cast(EllipseNetwork, network)


def calibrate_log_odds(network: EllipseNetwork, places: PlaceTensors) -> None:
    """Replace the network's log odds z by a·z + b, with a and b of maximum likelihood on places.

    The method is Platt scaling (Platt, *Probabilistic outputs for support vector machines*, 1999).
    """
    with torch.inference_mode():
        odds = torch.cat([network(part.float())[0] for part in torch.split(places.surroundings, 1024)])
    odds, on = odds.clone(), places.on_patch.float()
    line = torch.tensor([1.0, 0.0], requires_grad=True)
    optimizer = torch.optim.LBFGS([line], max_iter=100, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimizer.zero_grad()
        value = nn.functional.binary_cross_entropy_with_logits(line[0] * odds + line[1], on)
        value.backward()  # type: ignore[no-untyped-call]
        return value

    optimizer.step(loss)  # type: ignore[no-untyped-call]
    last, (scale, shift) = cast(nn.Linear, network.body[-1]), line.detach()
    with torch.no_grad():
        last.weight[0] *= scale
        last.bias[0] = scale * last.bias[0] + shift


def _mirror(places: PlaceTensors) -> PlaceTensors:
    """Mirror a batch in x, mirror it in y, and exchange x and y, each with probability 0.5."""
    surroundings, on, shift, log_map = places
    surroundings = surroundings.float()
    for axis in (0, 1):
        if torch.rand(()) < 0.5:
            sign = torch.ones(2)
            sign[axis] = -1
            surroundings, shift, log_map = surroundings.flip(3 - axis), shift * sign, log_map * sign * sign[:, None]
    if torch.rand(()) < 0.5:
        surroundings, shift, log_map = surroundings.transpose(2, 3), shift.flip(1), log_map.flip(1, 2)
    return PlaceTensors(surroundings, on, shift, log_map)


@torch.inference_mode()
def _report(network: EllipseNetwork, places: PlaceTensors, images: int, say: Say) -> None:
    """Report the errors of the ellipses, and how many places each threshold of the log odds keeps.

    The report has a line for each range of the short semi-axis. All shares are shares of the places on patches.
    "before": share of places within 0.1, and within 0.2, long semi-axes of the true centre. "after": the same two
    shares for the predicted centres. "semi-axes": share of ellipses whose semi-axes are wrong by less than about a
    tenth, and by less than about a fifth.
    """
    surroundings, on, shift, log_map = places
    out = [network(part.float()) for part in torch.split(surroundings, 1024)]
    odds, predicted_shift, predicted_log_map = (torch.cat(column) for column in zip(*out, strict=True))
    true_map, predicted_map = torch.linalg.matrix_exp(log_map[on]), torch.linalg.matrix_exp(predicted_log_map[on])
    size = torch.linalg.eigvalsh(true_map)
    before = torch.linalg.vector_norm(true_map @ shift[on, :, None], dim=1)[:, 0] / size[:, 1]
    error_px = predicted_map @ predicted_shift[on, :, None] - true_map @ shift[on, :, None]
    after = torch.linalg.vector_norm(error_px, dim=1)[:, 0] / size[:, 1]
    shape = torch.linalg.eigvalsh(predicted_log_map[on] - log_map[on]).abs().amax(1)
    say("short semi-axis   places   centre within 0.1, 0.2: before  after          semi-axes within a tenth, a fifth")
    for low, high in RADII_PX:
        m = (size[:, 0] >= low) & (size[:, 0] < high)
        shares = [float((v[m] < limit).float().mean()) for v in (before, after, shape) for limit in (0.1, 0.2)]
        say(f"{low:5} to {high:4} px   {int(m.sum()):6}" + "".join(f"{share:12.3f}" for share in shares))
    for limit in LOG_ODDS:
        kept, others = float((odds[on] >= limit).float().mean()), int((odds[~on] >= limit).sum()) / images
        say(f"log odds from {limit}: {kept:.4f} of the places on patches, {others:.1f} others per image")
