"""Train the judges of :mod:`kpbench.detectors` on synthetic sets, and show what they give on another set.

    python benchmarks/verification.py DATASET ... --test DATASET [--model FILE.onnx] [--go-on] [--write]

The sets must come from photographs that are free for fitting: `kpbench synth --n 1600 --backgrounds training/`.
Two judges, one before the fit and one after it, of the same small network. Before the fit a hypothesis is right if its
centre lies within a fifth of the radius of a keypoint and its design is right; after it, within a tenth; of two
rotations at one place the better one is. Each also
learns by how much the pose of a hypothesis of the right design is off, if that is less than half a radius.
What the first one is to see at its second look is what the shipped one makes of the first look; hypotheses that the
shipped one is sure of, and rightly, are shown seldom and with more weight.
Prints the detection score of the test set at several rates of false alarms an image: of the network's candidates as
they are, and by each judge; the second one is what the detector reports. `--go-on` starts from the weights that ship
(with `--epochs 0` it shows what they give); `--write` replaces them, `posed.onnx` and `fitted.onnx` of
`kpbench/detectors/weights`. Needs `pip install 'kpbench[train]'`.
"""

from __future__ import annotations

import argparse
import zlib
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from small_networks import affine, exported, log_of_map, one_cycle, shipped, start_from_shipped, trunk
from torch import nn
from tqdm import tqdm

import kpbench
from kpbench.detectors import verification as verify
from kpbench.detectors.superpoint import Decoding, SmallSuperPointDetector, SuperPointDetector
from kpbench.detectors.suppression import suppress
from kpbench.fitting.align import short_axis
from kpbench.fitting.pyramid import Picture
from kpbench.fitting.templates import VIEW_PX, bank
from kpbench.images import to_grey
from kpbench.workers import count_cores, use_one_thread

MORE = 1.0
"""Log odds by which more hypotheses are looked at again and fitted, to train."""
KNOWN = 12.0
"""A hypothesis of which a judge is rightly sure, with odds over the square of this, is not shown in every epoch."""
RATES = (0.03, 0.05, 0.1, 0.15, 0.25, 0.5, 0.73)


class Judge(nn.Module):
    """A view and its design (n, 2, 32, 32), and evidence (n, columns), to log odds and how far the pose is off."""

    def __init__(self, evidence: np.ndarray, width: int) -> None:
        """``evidence``: some, for the usual range of each column."""
        super().__init__()
        self.register_buffer("mean", torch.from_numpy(evidence.mean(axis=0)).float())
        self.register_buffer("deviation", torch.from_numpy(evidence.std(axis=0) + 1e-6).float())
        self.view = nn.Sequential(*trunk(2, width))
        size = 3 * width * (VIEW_PX // 8) ** 2
        self.likeness = nn.Sequential(nn.Dropout(0.3), nn.Linear(size, 64))
        self.evidence = nn.Linear(evidence.shape[1], 64)
        self.odds = nn.Sequential(nn.ReLU(), nn.Dropout(0.3), nn.Linear(64, 32), nn.ReLU(), nn.Linear(32, 1))
        self.pose = nn.Sequential(nn.Linear(size, 64), nn.ReLU(), nn.Linear(64, 5))

    def forward(self, view: torch.Tensor, evidence: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Log odds (n,), shift (n, 2), log map (n, 2, 2)."""
        standard = ((evidence - self.mean) / self.deviation).clamp(-4, 4)  # no further than what it was trained on
        if self.training:
            standard = standard + 0.05 * torch.randn_like(standard)
        seen = self.view(view)
        odds = self.odds(self.likeness(seen) + self.evidence(standard))[:, 0]
        x, y, xx, yy, xy = self.pose(seen).unbind(1)
        return odds, torch.stack([x, y], 1), torch.stack([xx, xy, xy, yy], 1).unflatten(1, (2, 2))


@dataclass
class Looked:
    """What is known of one image: the truth, the candidates' scores and whether they are right, the hypotheses."""

    keypoints: np.ndarray
    score: np.ndarray
    right: np.ndarray
    posed: verify.Hypotheses
    again: verify.Hypotheses
    """The posed ones, as the shipped judge would have them."""
    odds: np.ndarray
    """Of both, one after the other, by the shipped judge."""


@dataclass
class Fitted:
    """What the first judge makes of one image, and what the fit makes of that."""

    odds: np.ndarray
    """By the first judge, at its second look."""
    corrected: verify.Hypotheses
    fitted: verify.Hypotheses


_detector: SuperPointDetector
_judge: Judge


def start(model: str | None, judge: Judge | None = None) -> None:
    """What each worker process keeps."""
    global _detector, _judge
    use_one_thread()
    _detector = SuperPointDetector(Path(model)) if model else SmallSuperPointDetector()
    if judge is not None:
        torch.set_num_threads(1)
        _judge = judge


def look(path: str, strewn: bool, n: int) -> Looked:
    """Candidates of one image, posed."""
    grey, keypoints = shown(path, strewn, n)
    xy, score, log_id = _detector.candidates([grey])[0]
    ids = np.array([patch.patch_id for patch in _detector.patches])[log_id[:, :-1].argmax(axis=1)]
    right = explains(xy, ids, keypoints, 0.1)
    picture = Picture(grey)
    posed = verify.posed(picture, xy, score, log_id, _detector.patches)
    odds, corrected = verify.judged("posed", posed, _detector.patches)
    again = verify.again(picture, corrected[odds >= verify.DIM - MORE], _detector.patches)
    odds = np.concatenate([odds, verify.judged("posed", again, _detector.patches)[0]])
    return Looked(keypoints, score, right, _small(posed), _small(again), odds)


def _small(found: verify.Hypotheses) -> verify.Hypotheses:
    """The same in half the memory."""
    return replace(found, view=found.view.astype(np.float16))


def fit(path: str, strewn: bool, n: int, posed: verify.Hypotheses) -> Fitted:
    """Hypotheses of one image, judged twice and fitted.

    What it was trained on the first judge knows too well: of that, more is left for the second.
    """
    picture, more = Picture(shown(path, strewn, n)[0]), MORE if strewn else 0.0
    odds, corrected = judged(_judge, posed)
    odds, corrected = judged(_judge, verify.again(picture, corrected[odds >= verify.DIM - more], _detector.patches))
    chosen = verify.distinct(corrected, odds, verify.HOPELESS - more)
    odds, corrected = odds[chosen], corrected[chosen]
    return Fitted(odds, _small(corrected), _small(verify.fitted(picture, corrected, odds, _detector.patches)))


def shown(path: str, strewn: bool, n: int) -> tuple[np.ndarray, np.ndarray]:
    """One image of a set, grey, and its keypoints; of a strewn set every third one has specks beside its patches.

    Specks, of 1 to 6 px, are hot pixels, dust, and leaves and windows far away: what a small patch looks most like.
    """
    image, keypoints = kpbench.open_dataset(path)[n]
    grey = to_grey(image).copy()
    if not strewn or n % 3:
        return grey, keypoints
    rng = np.random.default_rng([zlib.crc32(Path(path).name.encode()), n])
    at = rng.uniform(0, grey.shape[::-1], (rng.integers(1, 40) * grey.size // 200_000, 2))
    away = np.hypot(at[:, :1] - keypoints["x"], at[:, 1:] - keypoints["y"]) > keypoints["radius_major"] + 4
    for x, y in np.rint(16 * at[away.all(axis=1)]).astype(int).tolist():
        axes = np.rint(16 * rng.uniform(0.4, 3.0, 2)).astype(int).tolist()
        level = float(rng.choice([0, 255, rng.integers(256)]))
        cv2.ellipse(grey, (x, y), axes, float(rng.uniform(0, 180)), 0, 360, level, -1, cv2.LINE_AA, 4)
    return grey, keypoints


def explains(xy: np.ndarray, ids: np.ndarray, keypoints: np.ndarray, tolerance: float) -> np.ndarray:
    """Whether each place lies within so many radii of a keypoint, and is of its design."""
    if not len(keypoints):
        return np.zeros(len(xy), bool)
    distance = np.hypot(xy[:, :1] - keypoints["x"], xy[:, 1:] - keypoints["y"]) / keypoints["radius_major"]
    nearest = distance.argmin(axis=1)
    return (distance.min(axis=1) <= tolerance) & (keypoints["patch_id"][nearest] == ids)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", nargs="+")
    parser.add_argument("--test", required=True)
    parser.add_argument("--model")
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--go-on", action="store_true")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(count_cores())
    go_on = ("posed", "fitted") if options.go_on else (None, None)
    start(options.model)
    paths = [*options.datasets, options.test]
    with ProcessPoolExecutor(count_cores(), initializer=start, initargs=(options.model,)) as pool:
        sets = [
            list(tqdm(pool.map(partial(look, path, path != options.test), range(count)), f"look {path}", count))
            for path in paths
            for count in [len(kpbench.open_dataset(path))]
        ]
    seen = [one for part in sets[:-1] for one in part]
    truths = [one.keypoints for one in seen]
    found, known = [look for one in seen for look in (one.posed, one.again)], [kp for kp in truths for _ in range(2)]
    before = trained(found, known, np.concatenate([one.odds for one in seen]), 0.2, 32, options.epochs, go_on[0])
    fits = []
    with ProcessPoolExecutor(count_cores(), initializer=start, initargs=(options.model, before)) as pool:
        for path, part in zip(paths, sets, strict=True):
            found = pool.map(partial(fit, path, path != options.test), range(len(part)), [one.posed for one in part])
            fits.append(list(tqdm(found, f"fit {path}", len(part))))
    found = [one.fitted for part in fits[:-1] for one in part]
    after = trained(found, truths, np.zeros(sum(map(len, found))), 0.1, 48, options.epochs, go_on[1])
    report(sets[-1], fits[-1], after)
    if options.write:
        ranges = [one.posed for one in sets[-1]], [one.fitted for one in fits[-1]]
        for name, judge, found in zip(("posed", "fitted"), (before, after), ranges, strict=True):
            target = shipped(name)
            target.write_bytes(to_onnx(judge, found))
            print(f"{target.name}: {target.stat().st_size} bytes")


def _ids(found: verify.Hypotheses) -> np.ndarray:
    return np.array([patch.patch_id for patch in _detector.patches])[found.which]


def trained(
    found: list[verify.Hypotheses],
    truths: list[np.ndarray],
    odds: np.ndarray,
    tolerance: float,
    width: int,
    epochs: int,
    name: str | None,
) -> Judge:
    """A judge of these hypotheses, from the shipped one of that name if any: cross-entropy, one cycle.

    What a judge before it already knew, whose ``odds`` they have, teaches little: of that a share is drawn, other ones
    in every epoch, and weighs as much as the whole.
    """
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    whole = verify.Hypotheses.joined(found)
    right = np.concatenate([right_ones(f, t, tolerance) for f, t in zip(found, truths, strict=True)])
    off = [errors(f, t) for f, t in zip(found, truths, strict=True)]
    near, shift, log_map = (torch.from_numpy(np.concatenate(parts)) for parts in zip(*off, strict=True))
    target, shift, log_map = torch.from_numpy(right).float(), shift.float(), log_map.float()
    share = np.minimum(KNOWN * np.exp(np.where(right, -odds, odds) / 2), 1.0)
    weight = torch.from_numpy(1 / share).float()

    def drawn() -> torch.Tensor:
        return torch.from_numpy(rng.permutation(np.flatnonzero(rng.random(len(share)) < share)))

    usual = whole.evidence[:: max(1, len(whole) // 100_000)]
    judge = Judge(usual, width).to(memory_format=torch.channels_last)
    if name:
        start_from_shipped(judge, name, _tensors(whole[rng.permutation(len(whole))[:4096]]))

    def loss(rows: torch.Tensor) -> torch.Tensor:
        view, evidence = _tensors(whole[rows.numpy()])
        logit, shifted, mapped = (part.float() for part in judge(_disturbed(view), evidence))
        value = nn.functional.binary_cross_entropy_with_logits(logit, target[rows], weight[rows])
        if (at := near[rows]).any():
            value = value + nn.functional.smooth_l1_loss(shifted[at], shift[rows][at], beta=0.02)
            value = value + nn.functional.smooth_l1_loss(mapped[at], log_map[rows][at], beta=0.05)
        return value

    print(f"train on {len(right)} hypotheses, {right.mean():.0%} right, {share.sum():.0f} an epoch")
    one_cycle(judge, loss, drawn, epochs, 256, 2e-3 if name else 3e-3)
    return judge


def _tensors(found: verify.Hypotheses) -> tuple[torch.Tensor, torch.Tensor]:
    given = verify.inputs(found, _detector.patches)
    return torch.from_numpy(given["view"]), torch.from_numpy(given["evidence"])


def _disturbed(view: torch.Tensor) -> torch.Tensor:
    """Other inks and a little noise for the image; the design stays."""
    shape = (len(view), 1, 1, 1)
    gain, offset = torch.exp(0.15 * torch.randn(shape)), 0.1 * torch.randn(shape)
    image = view[:, :1] * gain + offset + 0.1 * torch.rand(shape) * torch.randn_like(view[:, :1])
    return torch.cat([torch.where(view.any(dim=1, keepdim=True), image, 0.0), view[:, 1:]], dim=1)


def right_ones(found: verify.Hypotheses, keypoints: np.ndarray, tolerance: float) -> np.ndarray:
    """Whether each is of a keypoint: so near, of its design, and of two rotations at a place the one turned better."""
    right = explains(found.xy, _ids(found), keypoints, tolerance)
    rows = np.flatnonzero(right)
    if len(rows):
        own = _nearest(found.xy[rows], keypoints)
        relative = np.linalg.inv(found.A[rows]) @ affine(keypoints["H_patch2image"][own])
        angle = np.arctan2(relative[:, 1, 0] - relative[:, 0, 1], relative[:, 0, 0] + relative[:, 1, 1])
        # a design that looks the same after half a turn has half of the rotations
        turns = np.bincount(bank(_detector.patches).whole.turned_which)
        period = (2 * np.pi * turns / turns.max())[found.which[rows]]
        off = np.abs((angle + period / 2) % period - period / 2)
        order = np.lexsort((off, found.which[rows], found.place[rows]))
        key = np.column_stack([found.place[rows], found.which[rows]])[order]
        right[rows[order[1:][(key[1:] == key[:-1]).all(axis=1)]]] = False
    return right


def _nearest(xy: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
    """The keypoint that each place is nearest to, in its radii."""
    distance = np.hypot(xy[:, :1] - keypoints["x"], xy[:, 1:] - keypoints["y"])
    return (distance / keypoints["radius_major"]).argmin(axis=1)


def errors(found: verify.Hypotheses, keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which hypotheses are of a keypoint, of its design and less than half a radius off, and their pose's error.

    Returns
    -------
    (n,) bool, and for those that are (n, 2) and (n, 2, 2) what :func:`verify.moved` takes; 0 for the others.
    """
    shift, log_map = np.zeros((len(found), 2)), np.zeros((len(found), 2, 2))
    near = explains(found.xy, _ids(found), keypoints, 0.5)
    if near.any():
        centres = np.column_stack([keypoints["x"], keypoints["y"]])
        own = _nearest(found.xy[near], keypoints)
        relative = np.linalg.inv(found.A[near]) @ affine(keypoints["H_patch2image"][own])
        log_map[near] = log_of_map(relative)
        _, true = verify.moved(found.xy[near], found.A[near], shift[near], log_map[near])
        shift[near] = np.linalg.solve(true, (centres[own] - found.xy[near])[:, :, None])[:, :, 0]
        near[near] = np.abs(log_map[near]).max(axis=(1, 2)) < 1.0
    return near, shift, log_map


@torch.inference_mode()
def judged(judge: Judge, found: verify.Hypotheses) -> tuple[np.ndarray, verify.Hypotheses]:
    """What :func:`verify.judged` gives, by a judge in PyTorch."""
    if not len(found):
        return np.zeros(0), found
    odds, shift, log_map = (part.numpy() for part in judge(*_tensors(found)))
    xy, A = verify.moved(found.xy, found.A, shift, log_map)
    return odds.astype(np.float64), replace(found, xy=xy, A=A)


def report(test: list[Looked], fits: list[Fitted], after: Judge) -> None:
    """Detection score at several rates of false alarms."""
    truths, images = sum(len(one.keypoints) for one in test), len(test)
    print(f"{images} images, {truths} keypoints\nfalse alarms an image      " + "".join(f"{rate:8}" for rate in RATES))
    known = [one.keypoints for one in test]
    last = [judged(after, one.fitted)[0] for one in fits]
    fitted = [one.fitted for one in fits]
    rows = {
        "candidates": [(np.log(one.score / (1.0001 - one.score)), one.right) for one in test],
        "first judge": map(_reported, [one.odds for one in fits], [one.corrected for one in fits], known),
        "second judge": map(_reported, last, fitted, known),
    }
    for name, pairs in rows.items():
        score, right = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
        order = np.argsort(-score, kind="stable")
        alarms, found = np.cumsum(~right[order]) / images, np.cumsum(right[order]) / truths
        line = [found[max(np.searchsorted(alarms, rate, side="right") - 1, 0)] for rate in RATES]
        print(f"{name:27}" + "".join(f"{value:8.3f}" for value in line))
        for limit in (0.3, 0.5):
            sure = score >= np.log(limit / (1 - limit))
            hits, misses = (right & sure).sum() / truths, (~right & sure).sum() / images
            print(f"    at {limit}: detection {hits:.3f}, alarms {misses:.3f}")
    print(
        f"fitted: {sum(map(len, fitted)) / images:.1f} of "
        f"{sum(one.posed.place.max(initial=-1) + 1 for one in test) / images:.1f} places"
    )
    for name, column, reach in (
        ("posed", [one.posed for one in test], 0.2),
        ("corrected", [one.corrected for one in fits], 0.1),
        ("fitted", fitted, 0.1),
    ):
        right = sum(map(_truths_explained, column, known, [reach] * images))
        print(f"keypoints that a {name} hypothesis explains: {right / truths:.3f}")


def _truths_explained(found: verify.Hypotheses, keypoints: np.ndarray, tolerance: float) -> int:
    ids = _ids(found)
    return sum(explains(found.xy, ids, keypoints[k : k + 1], tolerance).any() for k in range(len(keypoints)))


def _reported(odds: np.ndarray, found: verify.Hypotheses, keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Log odds, and whether they are right, of what stays: the likeliest of a place, as the detector suppresses it."""
    best = verify.likeliest(found.place, odds)
    found, odds = found[best], odds[best]
    kept = suppress(found.xy, odds, np.maximum(Decoding.separation_px, 0.6 * short_axis(found.A)))
    return odds[kept], explains(found.xy, _ids(found), keypoints, 0.1)[kept]


def to_onnx(judge: Judge, found: list[verify.Hypotheses]) -> bytes:
    """A judge as ONNX: inputs ``view`` and ``evidence``, outputs ``odds``, ``shift``, ``log_map``."""
    return exported(judge, [_tensors(some) for some in found if len(some)][:100], ["view", "evidence"])


if __name__ == "__main__":
    main()
