"""What the evaluator costs on synthetic tables: 5 true keypoints and 6 detections an image, 5 % missed, 15 % doubled.

    python benchmarks/speed/score.py [IMAGES ...]           # growth; default 10000 100000 1000000
    python benchmarks/speed/score.py 100000 --files [json]  # instead: write and read every file format, or one
    python benchmarks/speed/score.py 100000 --rivals        # instead: beside hotcoco and faster-coco-eval

Times are CPU seconds after the imports. Every measurement runs in a process of its own, so that its peak memory is its
own.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import io
import multiprocessing
import resource
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from kpbench import KEYPOINT_DTYPE, Predictions, Truth, read_predictions, score, write_predictions
from kpbench.predictions import open_coco
from kpbench.scoring import Settings, compute_scores, match_predictions

KEYPOINTS, CONDITIONS, RUNGS = 5, 5, 4
LANE_PX = 640 / KEYPOINTS  # each keypoint of an image has its own, so none are within reach of one detection
RADII_PX = (8, 40)
SIGMA = 0.1 / (2 * np.sqrt(2 * np.log(2)))  # with area = radius squared, OKS is 0.5 at a distance of 0.1 radii
FORMATS = ("json", "jsonl", "csv", "parquet", "h5")


def tables(n: int, rng: np.random.Generator) -> tuple[Truth, Predictions]:
    """One patch type an image as in the suites; see the top; 14 % of places are outside reach."""
    t = n * KEYPOINTS
    keypoints = np.zeros(t, KEYPOINT_DTYPE)
    xy = rng.uniform([RADII_PX[1], 0], [LANE_PX - RADII_PX[1], 480], (t, 2))
    xy[:, 0] += LANE_PX * (np.arange(t) % KEYPOINTS)
    keypoints["x"], keypoints["y"] = xy.T
    keypoints["patch_id"] = np.repeat(rng.integers(0, 4, n), KEYPOINTS)
    keypoints["radius_major"] = rng.uniform(*RADII_PX, t)
    keypoints["radius_minor"] = 0.8 * keypoints["radius_major"]
    image = np.arange(n)
    truth = Truth(
        image_id=image,
        offsets=np.arange(n + 1) * KEYPOINTS,
        keypoints=keypoints,
        condition=np.array(["blur", "dimming", "noise", "pitch", "scale"])[image % CONDITIONS],
        rung=(image // CONDITIONS % RUNGS).astype(float),
        scene_id=image // (CONDITIONS * RUNGS),
    )
    found = xy + rng.normal(0, 0.05, (t, 2)) * keypoints["radius_major"][:, None]
    lost = rng.random(t) < 0.05
    found[lost] = rng.uniform([0, 0], [640, 480], (int(lost.sum()), 2))
    extra = rng.uniform([0, 0], [640, 480], (n, 2))
    double = rng.random(n) < 0.15
    extra[double] = found[::KEYPOINTS][double] + 0.1
    xy = np.concatenate([found.reshape(n, KEYPOINTS, 2), extra[:, None]], axis=1).reshape(-1, 2)
    ids = np.concatenate([keypoints["patch_id"].reshape(n, KEYPOINTS), rng.integers(0, 4, (n, 1))], axis=1).ravel()
    offsets = np.arange(n + 1) * (KEYPOINTS + 1)
    return truth, Predictions(image, offsets, xy, rng.random(len(xy)), ids)


def cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def alone(function: Callable[..., None], *args: Any) -> None:
    """Call a function in a new process."""
    process = multiprocessing.get_context("spawn").Process(target=function, args=args)
    process.start()
    process.join()
    if process.exitcode:
        raise SystemExit(f"{function.__name__}{args} failed")


# --- growth -----------------------------------------------------------------------------------------------------


def growth(n: int) -> None:
    truth, predictions = tables(n, np.random.default_rng(0))
    before = peak_mb()
    times = [cpu_s()]
    outcomes = match_predictions(truth, predictions, Settings(resamples=0))
    times.append(cpu_s())
    compute_scores(outcomes)
    times.append(cpu_s())
    scores = score(truth, predictions)
    times.append(cpu_s())
    matching, metrics, whole = np.diff(times)
    print(
        f"{n:>8} images: matching {matching:6.2f} s, metrics of {1 + len(scores.by)} groups {metrics:6.2f} s, "
        f"both with intervals {whole:6.2f} s, {1e6 * whole / n:5.1f} us an image; "
        f"peak {peak_mb():5.0f} MB, {before:.0f} MB of it the tables; detection score {scores['detection_score']:.4f}"
    )


# --- files ------------------------------------------------------------------------------------------------------


def write(path: Path, n: int) -> None:
    predictions = tables(n, np.random.default_rng(0))[1]
    start = cpu_s()
    write_predictions(path, predictions)
    print(
        f"{path.suffix:>16}: {path.stat().st_size / 1e6:7.1f} MB, write {cpu_s() - start:6.2f} s",
        end="",
        flush=True,
    )


def read(path: Path) -> None:
    before, start = peak_mb(), cpu_s()
    read_predictions(path)
    more = peak_mb() - before
    print(f", read {cpu_s() - start:6.2f} s with {more:5.0f} MB = {more * 2**20 / path.stat().st_size:.2f} x the file")


# --- rivals -----------------------------------------------------------------------------------------------------


def write_coco(folder: Path, n: int) -> None:
    """The same tables as COCO annotations and results, all of one category."""
    truth, p = tables(n, np.random.default_rng(0))
    places = np.stack([truth.keypoints[name].astype(float) for name in ("x", "y", "radius_major")], axis=1).tolist()
    annotations = [
        {"id": i + 1, "image_id": i // KEYPOINTS, "category_id": 1, "keypoints": [x, y, 2], "num_keypoints": 1}
        | {"area": r * r, "bbox": [x - r, y - r, 2 * r, 2 * r], "iscrowd": 0, "radius": r}
        for i, (x, y, r) in enumerate(places)
    ]
    images = [{"id": i, "width": 640, "height": 480} for i in range(n)]
    category = {"id": 1, "name": "patch", "keypoints": ["centre"], "skeleton": []}
    content = {"images": images, "annotations": annotations, "categories": [category]}
    (folder / "truth.json").write_bytes(msgspec.json.encode(content))
    results = [
        {"image_id": i // (KEYPOINTS + 1), "category_id": 1, "keypoints": [x, y, 2], "score": s}
        for i, ((x, y), s) in enumerate(zip(p.xy.tolist(), p.score.tolist(), strict=True))
    ]
    (folder / "results.json").write_bytes(msgspec.json.encode(results))


def rival(name: str, folder: Path) -> None:
    """Print what ``name`` takes to read the COCO files, to match, and in all, and the recall that it finds."""
    truth, results = str(folder / "truth.json"), str(folder / "results.json")
    module = importlib.import_module(name.replace("-", "_"))
    times = [cpu_s()]
    if name == "kpbench":
        dataset, predictions = open_coco(truth), read_predictions(results)
        times.append(cpu_s())
        outcomes = match_predictions(dataset.truth, predictions, Settings(resamples=0), allow_missing=True)
        times.append(cpu_s())
        recall = compute_scores(outcomes)["recall"]
    else:
        with contextlib.redirect_stdout(io.StringIO()):
            coco = module.COCO(truth)
            found = (coco.load_res if name == "hotcoco" else coco.loadRes)(results)
            times.append(cpu_s())
            evaluation = (module.COCOeval if name == "hotcoco" else module.COCOeval_faster)(coco, found, "keypoints")
            p = evaluation.params
            p.kpt_oks_sigmas, p.iouThrs, p.maxDets = np.array([SIGMA]), [0.5], [20]
            p.areaRng, p.areaRngLbl = [[0, 1e10]], ["all"]
            evaluation.evaluate()
            times.append(cpu_s())
            evaluation.accumulate()
            recall = np.asarray(evaluation.eval["recall"]).item()
    times.append(cpu_s())
    reading, matching, _ = np.diff(times)
    print(
        f"{name:>16}: read {reading:6.2f} s, matching {matching:6.2f} s, whole {times[-1] - times[0]:6.2f} s, "
        f"peak {peak_mb():5.0f} MB, recall {recall:.6f}"
    )


def compare(n: int, folder: Path) -> None:
    print(f"{n} images")
    alone(write_coco, folder, n)
    for name in ("kpbench", "hotcoco", "faster-coco-eval"):
        if importlib.util.find_spec(name.replace("-", "_")):
            alone(rival, name, folder)
        else:
            print(f"{name:>16}: not installed")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("images", nargs="*", type=int, default=[10_000, 100_000, 1_000_000])
    parser.add_argument("--files", nargs="*", choices=FORMATS, help="write and read the predictions, in every format")
    parser.add_argument(
        "--rivals", action="store_true", help="read and match the same COCO files with other evaluators"
    )
    args = parser.parse_args()
    for n in args.images:
        with tempfile.TemporaryDirectory() as folder:
            if args.rivals:
                compare(n, Path(folder))
            elif args.files is None:
                alone(growth, n)
            else:
                print(f"{n} images")
                for suffix in args.files or FORMATS:
                    path = Path(folder) / f"preds.{suffix}"
                    alone(write, path, n)
                    alone(read, path)


if __name__ == "__main__":
    main()
