"""What a synthetic image costs by wall time, on one core: kpbench beside the floor and beside two usual pipelines.

floor      decode and resize one photograph, deflate, write: what no generator of photographs with shards can leave out
kpbench    the command ``kpbench synth --workers 1``: scenes, truth, effects, shards written and synced
careful    what a careful user writes: grey throughout if the images are grey, ``cv2.warpPerspective`` of each patch in
           8 bits over the full frame, albumentations' effects, ``h5py`` with ``compression="gzip"`` (level 4)
naive      what one would write in an afternoon: three colours and floating point throughout, else as ``careful``

All write images of one size from the same photographs, as many of them as give n images the reuse that 800 give
20,000 (the others decode one for every image, kpbench keeps them). Every run is a process of its own, bound to one
core. The time of an image is the difference of two runs, of 50 images and of n + 50, divided by n: start and imports
are left out. Each round runs all pipelines one after the other with the same seed; ratios are medians over the rounds.

    python benchmarks/speed/synth.py --backgrounds photos/ [--n 800] [--rounds 5] [--channels 3] [--workers] [--profile]
"""

from __future__ import annotations

import argparse
import cProfile
import multiprocessing
import os
import pstats
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import deflate
import h5py
import numpy as np

from kpbench import Patch, SynthConfig, generate, shipped_patches
from kpbench.images import decode_photo
from kpbench.render import PhotoFolder
from kpbench.types import UInt8

WIDTH, HEIGHT = 640, 480
PATCH_PX = 512


def floor(photos: PhotoFolder, out: Path, n: int, seed: int, channels: int) -> None:
    rng = np.random.default_rng(seed)
    with (out / "images.bin").open("wb") as file:
        for _ in range(n):
            photo = decode_photo(photos.path / photos.files[rng.integers(len(photos.files))], channels)
            assert photo is not None
            file.write(deflate.zlib_compress(cv2.resize(photo, (WIDTH, HEIGHT)), 1))
        file.flush()
        os.fsync(file.fileno())


def kpbench(photos: PhotoFolder, out: Path, n: int, seed: int, channels: int) -> None:
    config = SynthConfig(n, seed, backgrounds=photos.path, channels=channels, shard_size=n)
    generate(config, out / "set", workers=1)


def drawn(patch: Patch) -> tuple[UInt8, UInt8]:
    """A patch as a picture, and the disc's mask."""
    axis = (np.arange(PATCH_PX) + 0.5) / PATCH_PX * 2 - 1
    points = np.stack(np.meshgrid(axis, axis), axis=-1)
    black = patch.is_black(points.reshape(-1, 2)).reshape(PATCH_PX, PATCH_PX)
    disc = np.hypot(points[..., 0], points[..., 1]) <= 1
    return np.where(black, 0, 255).astype(np.uint8), np.where(disc, 255, 0).astype(np.uint8)


def effects(channels: int) -> Any:
    """Two of the six kinds of effects that the paper names, at albumentations' own strengths."""
    import albumentations as A

    weather: list[Any] = [A.RandomShadow(p=1), A.RandomRain(p=1)]
    if channels == 1:  # these two take colour images alone
        weather = [A.Sequential([A.ToRGB(p=1), effect, A.ToGray(num_output_channels=1, p=1)]) for effect in weather]
    return A.Compose([A.SomeOf(
        [
            *weather, A.MotionBlur(blur_limit=9, p=1), A.Blur(blur_limit=7, p=1),
            A.RandomBrightnessContrast(contrast_limit=0, p=1), A.GaussNoise(std_range=(0.02, 0.12), p=1),
        ],
        n=2,
    )])  # fmt: skip


def random_homography(rng: np.random.Generator) -> Any:
    radius, centre = np.exp(rng.uniform(np.log(5), np.log(80))), rng.uniform(0, 1, 2) * (WIDTH, HEIGHT)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * rng.uniform(0.6, 1.0, (4, 2)) * radius
    flat = np.array([[0, 0], [PATCH_PX, 0], [PATCH_PX, PATCH_PX], [0, PATCH_PX]], np.float32)
    return cv2.getPerspectiveTransform(flat, (corners + centre).astype(np.float32))


def careful(photos: PhotoFolder, out: Path, n: int, seed: int, channels: int) -> None:
    pictures = [drawn(patch) for patch in shipped_patches()]
    rng, worn = np.random.default_rng(seed), effects(channels)
    shape = (n, HEIGHT, WIDTH, channels)
    with h5py.File(out / "set.h5", "w") as file:
        images = file.create_dataset("images", shape, "u1", chunks=(1, *shape[1:]), compression="gzip")
        for index in range(n):
            name = str(photos.path / photos.files[rng.integers(len(photos.files))])
            image = cv2.imread(name, cv2.IMREAD_GRAYSCALE if channels == 1 else cv2.IMREAD_COLOR)
            image = cv2.resize(image, (WIDTH, HEIGHT))
            for _ in range(rng.integers(0, 11)):
                picture, mask = pictures[rng.integers(4)]
                H = random_homography(rng)
                there = cv2.warpPerspective(mask, H, (WIDTH, HEIGHT))
                black, white = rng.uniform(0, 120), rng.uniform(180, 255)
                ink = cv2.warpPerspective(picture, H, (WIDTH, HEIGHT))
                ink = cv2.LUT(ink, np.linspace(black, white, 256).astype(np.uint8))
                if channels == 3:
                    there, ink = cv2.merge([there] * 3), cv2.merge([ink] * 3)
                under = cv2.multiply(image, 255 - there, scale=1 / 255)
                image = cv2.add(under, cv2.multiply(ink, there, scale=1 / 255))
            images[index] = worn(image=image)["image"].reshape(shape[1:])
        file.flush()


def naive(photos: PhotoFolder, out: Path, n: int, seed: int, channels: int) -> None:
    pictures = [drawn(patch) for patch in shipped_patches()]
    rng, worn = np.random.default_rng(seed), effects(3)
    shape = (n, HEIGHT, WIDTH, channels)
    with h5py.File(out / "set.h5", "w") as file:
        images = file.create_dataset("images", shape, "u1", chunks=(1, *shape[1:]), compression="gzip")
        for index in range(n):
            image = cv2.imread(str(photos.path / photos.files[rng.integers(len(photos.files))]))
            image = cv2.resize(image, (WIDTH, HEIGHT))
            for _ in range(rng.integers(0, 11)):
                picture, mask = pictures[rng.integers(4)]
                H = random_homography(rng)
                there = cv2.warpPerspective(mask, H, (WIDTH, HEIGHT))[..., None] / 255.0
                black, white = rng.uniform(0, 120), rng.uniform(180, 255)
                ink = black + cv2.warpPerspective(picture, H, (WIDTH, HEIGHT))[..., None] / 255.0 * (white - black)
                image = (image * (1 - there) + ink * there).astype(np.uint8)
            image = worn(image=image)["image"]
            images[index] = image if channels == 3 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)[..., None]
        file.flush()


Pipeline = Callable[[PhotoFolder, Path, int, int, int], None]
PIPELINES: dict[str, Pipeline] = {"floor": floor, "kpbench": kpbench, "careful": careful, "naive": naive}
FEW = 50
"""Images of the short run that is taken from the long run."""


def timed(pipeline: Pipeline, photos: PhotoFolder, n: int, seed: int, channels: int) -> float:
    """Processor time in this process, ms an image."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.process_time()
        pipeline(photos, Path(folder), n, seed, channels)
        return (time.process_time() - start) / n * 1e3


def run_alone(name: str, photos: PhotoFolder, n: int, seed: int, channels: int) -> float:
    """Wall time of a whole run in a process of its own on one core, s."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable]
        if name == "kpbench":
            command += ["-m", "kpbench", "synth", "--n", n, "--workers", 1, "--channels", channels, "--seed", seed]
            command += ["--backgrounds", photos.path, "--out", Path(folder) / "set"]
        else:
            command += [__file__, "--alone", name, "--n", n, "--channels", channels, "--seed", seed]
            command += ["--backgrounds", photos.path, "--out", folder]
        start = time.perf_counter()
        subprocess.run([*map(str, command)], check=True, capture_output=True)
        return time.perf_counter() - start


def some_of(photos: PhotoFolder, count: int, folder: str) -> PhotoFolder:
    """A folder of links to evenly spaced photographs of another."""
    for name in photos.files[:: max(1, len(photos.files) // count)][:count]:
        (Path(folder) / Path(name).name).symlink_to((photos.path / name).resolve())
    return PhotoFolder.open(folder)


def compare(photos: PhotoFolder, n: int, rounds: int, channels: int) -> None:
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})  # inherited by the runs
    rows = []
    for seed in range(rounds):
        row = []
        for name in PIPELINES:
            count = n if name in ("floor", "kpbench") else n // 4
            short, long = (run_alone(name, photos, images, seed, channels) for images in (FEW, count + FEW))
            row.append((long - short) / count * 1e3)
        rows.append(row)
        print("  ".join(f"{name} {ms:.2f}" for name, ms in zip(PIPELINES, row, strict=True)), flush=True)
    table = np.array(rows)
    for name, column in zip(PIPELINES, table.T, strict=True):
        print(f"{name:8} {np.median(column):7.2f} ms an image  ({column.min():.2f} to {column.max():.2f})")
    print(f"kpbench / floor   {np.median(table[:, 1] / table[:, 0]):.2f}")
    print(f"careful / kpbench {np.median(table[:, 2] / table[:, 1]):.2f}")
    print(f"naive / kpbench   {np.median(table[:, 3] / table[:, 1]):.2f}")


def profile(photos: PhotoFolder, n: int, channels: int) -> None:
    """Where kpbench's time goes: cumulative time of its stages, then the functions by their own time."""
    run: Any = cProfile.Profile()
    timed(kpbench, photos, 20, 10**6, channels)
    run.runcall(timed, kpbench, photos, n, 0, channels)
    stats = pstats.Stats(run).strip_dirs()
    stats.sort_stats("cumulative").print_stats("synth.py|scene.py|degrade.py|store.py|background.py|raster.py|hash")
    stats.sort_stats("tottime").print_stats(25)


def scaling(photos: PhotoFolder, n: int, rounds: int, channels: int) -> None:
    """One and two workers as whole commands, in turn; the peak memory of the largest process of each."""
    code = (
        "import resource, sys; from kpbench.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "print(*(resource.getrusage(w).ru_maxrss / 1024 for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)))"
    )
    spent: dict[tuple[int, int], list[float]] = {}
    for _ in range(rounds):
        for images, workers in ((n, 1), (n, 2), (2 * n, 2)):
            with tempfile.TemporaryDirectory() as folder:
                words = ["synth", "--n", images, "--workers", workers, "--channels", channels, "--shard-size", n // 10]
                words += ["--backgrounds", photos.path, "--out", Path(folder) / "set"]
                start = time.perf_counter()
                done = subprocess.run(
                    [sys.executable, "-c", code, *map(str, words)], check=True, capture_output=True, text=True
                )
                spent.setdefault((images, workers), []).append(time.perf_counter() - start)
                own, child = (float(v) for v in done.stdout.split()[-2:])
                took = spent[images, workers][-1]
                print(f"n {images}, workers {workers}: {took:.1f} s, peak {own:.0f} / {child:.0f} MB")
    ratio = np.median(np.array(spent[n, 1]) / np.array(spent[n, 2]))
    print(f"one worker / two workers {ratio:.2f}")
    print(f"what two processes of the floor alone gain on this machine {ceiling(photos, n, rounds, channels):.2f}")


def ceiling(photos: PhotoFolder, n: int, rounds: int, channels: int) -> float:
    """The same ratio for two processes that share nothing: two threads of one core are less than two cores."""
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:

        def both(count: int) -> float:
            start = time.perf_counter()
            list(pool.map(timed, *zip(*[(floor, photos, count // 2, seed, channels) for seed in (0, 1)], strict=True)))
            return time.perf_counter() - start

        both(40)  # imports, caches
        ratios = []
        for seed in range(rounds):
            start = time.perf_counter()
            pool.submit(timed, floor, photos, n, seed, channels).result()
            ratios.append((time.perf_counter() - start) / both(n))
    return float(np.median(ratios))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backgrounds", type=Path, required=True)
    parser.add_argument("--n", type=int, default=800)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--channels", type=int, default=1, choices=(1, 3))
    parser.add_argument("--workers", action="store_true", help="time one worker and two instead")
    parser.add_argument("--profile", action="store_true", help="profile kpbench instead")
    parser.add_argument("--alone", choices=PIPELINES, help="run one pipeline and measure nothing")
    parser.add_argument("--out", type=Path, help="folder for --alone")
    parser.add_argument("--seed", type=int, default=0, help="for --alone")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    folder = PhotoFolder.open(given.backgrounds)
    if given.alone:
        PIPELINES[given.alone](folder, given.out, given.n, given.seed, given.channels)
    elif given.profile:
        profile(folder, given.n, given.channels)
    elif given.workers:
        scaling(folder, given.n, given.rounds, given.channels)
    else:
        with tempfile.TemporaryDirectory() as kept:
            compare(some_of(folder, max(1, given.n // 25), kept), given.n, given.rounds, given.channels)


if __name__ == "__main__":
    main()
