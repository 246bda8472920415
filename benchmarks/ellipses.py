"""Train the network of :func:`kpbench.detectors.ellipses` on synthetic sets, and show what it gives on another set.

    python benchmarks/ellipses.py DATASET ... --test DATASET [--go-on] [--write]

The sets must come from photographs that are free for fitting: `kpbench synth --n 1600 --backgrounds training/`.
The network sees the surroundings of a place in four octaves and says whether it lies on a patch, where the patch's
centre is and which ellipse it fills, whatever its design. It is shown the places that the detector's network finds
(in sets of the designs that it knows), and others around every keypoint, all turned, mirrored and scaled at random.
Its log odds are then scaled so that they hold for the places of the test set, of which most are on none.
Prints for the test set, by radius, the share of centres within 0.1 and 0.2 of the major semi-axis, before and after,
and of semi-axes within a tenth and a fifth. `--go-on` starts from the weights that ship (with `--epochs 0`: shows what
they give); `--write` replaces them, `ellipse.onnx` of `kpbench/detectors/weights`.
Needs `pip install 'kpbench[train]'`.
"""

from __future__ import annotations

import argparse
import zlib
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from small_networks import affine, exported, log_of_map, one_cycle, shipped, start_from_shipped, trunk
from torch import nn
from tqdm import tqdm

import kpbench
from kpbench.detectors.superpoint import SmallSuperPointDetector
from kpbench.fitting.pyramid import Picture
from kpbench.fitting.templates import VIEW_PX
from kpbench.fitting.views import OCTAVES, surroundings
from kpbench.images import to_grey
from kpbench.workers import count_cores, use_one_thread

NEAR, FAR = 0.6, 1.0
"""A place within so many short semi-axes of a keypoint is on its patch; one beyond so many long ones of all on none."""
EMPTY_PLACES, MADE_PLACES = 14, 3
"""Places on none, most of an image; places made around each keypoint."""
USUAL = 2.5
"""Log of a usual radius in px, from which the network starts."""


class Ellipse(nn.Module):
    """Surroundings (n, 4, 32, 32), grey levels, to log odds and what :func:`kpbench.detectors.moved` takes."""

    def __init__(self, width: int = 32) -> None:
        super().__init__()
        self.body = nn.Sequential(
            *trunk(OCTAVES, width),
            nn.Linear(3 * width * (VIEW_PX // 8) ** 2, 192),
            nn.ReLU(),
            nn.Linear(192, 6),
        )

    def forward(self, surroundings: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Log odds, shift, log map."""
        centred = surroundings - surroundings.mean((2, 3), keepdim=True)
        out = self.body(centred / (centred.square().mean((2, 3), keepdim=True).sqrt() + 2.0))
        xx, yy, xy = out[:, 3] + USUAL, out[:, 4] + USUAL, out[:, 5]
        return out[:, 0], out[:, 1:3], torch.stack([xx, xy, xy, yy], 1).unflatten(1, (2, 2))


class Places(NamedTuple):
    """n places: surroundings (n, 4, 32, 32) float16, whether on a patch, and its shift (n, 2) and log map (n, 2, 2)."""

    surroundings: np.ndarray
    on_patch: np.ndarray
    shift: np.ndarray
    log_map: np.ndarray


_detector: SmallSuperPointDetector


def start() -> None:
    """What each worker process keeps."""
    global _detector
    use_one_thread()
    _detector = SmallSuperPointDetector()


def places(path: str, disturbed: bool, n: int) -> Places:
    """Places of one image; those of the detector alone and as they are, or disturbed and more of them."""
    image, keypoints = kpbench.open_dataset(path)[n]
    grey = to_grey(image)
    rng = np.random.default_rng([zlib.crc32(path.encode()), n])
    known = {patch.patch_id for patch in _detector.patches} >= set(keypoints["patch_id"].tolist())
    at = _detector.candidates([grey])[0][0] if known else np.zeros((0, 2))
    which, on, off = _explained(at, keypoints)
    centres = np.column_stack([keypoints["x"], keypoints["y"]])
    if disturbed:
        off[rng.permutation(np.flatnonzero(off))[EMPTY_PLACES:]] = False
        again = np.tile(np.arange(len(keypoints)), MADE_PLACES)
        made = centres[again] + rng.normal(0, 0.22, (len(again), 2)) * keypoints["radius_minor"][again, None]
        at = np.concatenate([at[on], at[off], made])
        which = np.concatenate([which[on], which[off], again])
        on = np.repeat([True, False, True], [on.sum(), off.sum(), len(again)])
    else:
        at, which, on = at[on | off], which[on | off], on[on | off]
    turn = np.tile(np.eye(2), (len(at), 1, 1))
    for k in np.flatnonzero(rng.random(len(at)) < 0.7) if disturbed else ():
        angle = rng.uniform(0, 2 * np.pi)
        c, s = np.array([np.cos(angle), np.sin(angle)]) * 2 ** rng.uniform(-0.35, 0.35)
        turn[k] = [[c, -s], [s, c]]
    around = surroundings(Picture(grey).smooth, at, turn).astype(np.float16)
    shift, log_map = np.zeros((len(at), 2)), np.zeros((len(at), 2, 2))
    back = np.linalg.inv(turn[on])
    log_map[on] = log_of_map(back @ affine(keypoints["H_patch2image"][which[on]]))
    size, axes = np.linalg.eigh(log_map[on])
    smaller = np.einsum("nij,nj,nkj->nik", axes, np.exp(-size), axes)
    shift[on] = np.einsum("nij,njk,nk->ni", smaller, back, centres[which[on]] - at[on])
    return Places(around, on, shift.astype(np.float32), log_map.astype(np.float32))


def _explained(at: np.ndarray, keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The keypoint of each place, whether it is on its patch, and whether it is on none."""
    if not len(keypoints):
        return np.zeros(len(at), np.int64), np.zeros(len(at), bool), np.ones(len(at), bool)
    distance = np.hypot(at[:, :1] - keypoints["x"], at[:, 1:] - keypoints["y"])
    on = distance <= NEAR * keypoints["radius_minor"]
    which = (distance / keypoints["radius_minor"]).argmin(axis=1)
    return which, on.any(axis=1), (distance > FAR * keypoints["radius_major"]).all(axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", nargs="+")
    parser.add_argument("--test", required=True)
    parser.add_argument("--epochs", type=int, default=6)
    parser.add_argument("--go-on", action="store_true")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(count_cores())
    with ProcessPoolExecutor(count_cores(), initializer=start) as pool:
        parts = []
        for path in options.datasets:
            count = len(kpbench.open_dataset(path))
            parts += tqdm(pool.map(partial(places, path, True), range(count), chunksize=4), path, count, leave=False)
        network = trained(_together(parts), options.epochs, options.go_on)
        count = len(kpbench.open_dataset(options.test))
        test = _together(list(pool.map(partial(places, options.test, False), range(count), chunksize=4)))
    calibrate(network, test)
    report(network, test, count)
    if options.write:
        target = shipped("ellipse")
        seen = [(some.float(),) for some in test[0][:4096].split(64)]
        target.write_bytes(exported(network, seen, ["surroundings"]))
        print(f"{target.name}: {target.stat().st_size} bytes")


def _together(parts: list[Places]) -> list[torch.Tensor]:
    return [torch.from_numpy(np.concatenate(column)) for column in zip(*parts, strict=True)]


def trained(data: list[torch.Tensor], epochs: int, go_on: bool) -> Ellipse:
    """Cross-entropy of the log odds, smooth L1 of shift and log map on patches; AdamW, one cycle of learning rates."""
    torch.manual_seed(0)
    network = Ellipse().to(memory_format=torch.channels_last)
    if go_on:
        start_from_shipped(network, "ellipse", (data[0][torch.randperm(len(data[0]))[:4096]].float(),))

    def loss(rows: torch.Tensor) -> torch.Tensor:
        around, on, shift, log_map = _mirrored(*(column[rows] for column in data))
        disturbed = around * torch.exp(0.2 * torch.randn(len(around), 1, 1, 1))
        odds, shifted, mapped = (part.float() for part in network(disturbed))
        return (
            nn.functional.binary_cross_entropy_with_logits(odds, on.float())
            + 4 * nn.functional.smooth_l1_loss(shifted[on], shift[on], beta=0.03)
            + 3 * nn.functional.smooth_l1_loss(mapped[on], log_map[on], beta=0.05)
        )

    print(f"train on {len(data[0])} places, {data[1].float().mean():.0%} on patches")
    one_cycle(network, loss, lambda: torch.randperm(len(data[0])), epochs, 256, 2e-3 if go_on else 3e-3)
    return network


def calibrate(network: Ellipse, test: list[torch.Tensor]) -> None:
    """Scale and shift the log odds so that they are the most probable ones (Platt, *Probabilistic outputs*, 1999)."""
    with torch.inference_mode():
        odds = torch.cat([network(part.float())[0] for part in test[0].split(1024)])
    odds, on = odds.clone(), test[1].float()
    line = torch.tensor([1.0, 0.0], requires_grad=True)
    optimizer = torch.optim.LBFGS([line], max_iter=100, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimizer.zero_grad()
        value = nn.functional.binary_cross_entropy_with_logits(line[0] * odds + line[1], on)
        value.backward()
        return value

    optimizer.step(loss)
    last, (scale, shift) = network.body[-1], line.detach()
    with torch.no_grad():
        last.weight[0] *= scale
        last.bias[0] = scale * last.bias[0] + shift


def _mirrored(around: torch.Tensor, on: torch.Tensor, shift: torch.Tensor, log_map: torch.Tensor) -> list[torch.Tensor]:
    """A batch with x, y, or both mirrored, and x and y exchanged, at random."""
    around = around.float()
    for axis in (0, 1):
        if torch.rand(()) < 0.5:
            sign = torch.ones(2)
            sign[axis] = -1
            around, shift, log_map = around.flip(3 - axis), shift * sign, log_map * sign * sign[:, None]
    if torch.rand(()) < 0.5:
        around, shift, log_map = around.transpose(2, 3), shift.flip(1), log_map.flip(1, 2)
    return [around, on, shift, log_map]


@torch.inference_mode()
def report(network: Ellipse, test: list[torch.Tensor], images: int) -> None:
    """How near the ellipses are to the truth, by short semi-axis, and what the log odds tell."""
    around, on, shift, log_map = test
    out = [network(part.float()) for part in around.split(1024)]
    odds, shifted, mapped = (torch.cat(column) for column in zip(*out, strict=True))
    true_map, map_ = torch.linalg.matrix_exp(log_map[on]), torch.linalg.matrix_exp(mapped[on])
    size = torch.linalg.eigvalsh(true_map)
    start = torch.linalg.vector_norm(true_map @ shift[on, :, None], dim=1)[:, 0] / size[:, 1]
    missed = map_ @ shifted[on, :, None] - true_map @ shift[on, :, None]
    error = torch.linalg.vector_norm(missed, dim=1)[:, 0] / size[:, 1]
    shape = torch.linalg.eigvalsh(mapped[on] - log_map[on]).abs().amax(1)
    print("short semi-axis   places   centre within 0.1, 0.2: before  after          semi-axes within a tenth, a fifth")
    for low, high in ((0, 5), (5, 8), (8, 12), (12, 20), (20, 1000)):
        m = (size[:, 0] >= low) & (size[:, 0] < high)
        shares = [float((v[m] < limit).float().mean()) for v in (start, error, shape) for limit in (0.1, 0.2)]
        print(f"{low:5} to {high:4} px   {int(m.sum()):6}" + "".join(f"{share:12.3f}" for share in shares))
    for limit in (-8, -7, -6, -5, -4, -2, 0):
        kept, others = float((odds[on] >= limit).float().mean()), int((odds[~on] >= limit).sum()) / images
        print(f"log odds from {limit}: {kept:.4f} of those on patches, {others:.1f} others an image")


if __name__ == "__main__":
    main()
