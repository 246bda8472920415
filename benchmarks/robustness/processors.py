"""Datasets made as on other processors: each library is told to leave out some of the processor's instructions.

    python benchmarks/robustness/processors.py [--n 60] [--backgrounds photos/]

Each row is a process of its own that makes the same datasets: scenes over photographs and over procedural backgrounds,
every deterioration, grey and colour, look-alikes, and both shipped suites, with and without lens distortion. The digest
covers all pixels and the whole truth. The last line says whether all rows agree; the exit code is 1 if not.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import subprocess
import sys
from pathlib import Path

from kpbench import SuiteConfig, SynthConfig, load_suite

GLIBC = "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX2_Usable,-FMA_Usable"
PROCESSORS: dict[str, dict[str, str]] = {
    "this processor": {},
    "OpenCV without AVX2": {"OPENCV_CPU_DISABLE": "AVX2"},
    "OpenCV without AVX-512": {"OPENCV_CPU_DISABLE": "AVX512-SKX,AVX512-ICL"},
    "OpenCV without FMA3": {"OPENCV_CPU_DISABLE": "FMA3"},
    "OpenCV without any of them": {"OPENCV_CPU_DISABLE": "SSE4.1,SSE4.2,AVX,FP16,AVX2,FMA3,AVX512-SKX,AVX512-ICL"},
    "OpenCV without Intel's library": {"OPENCV_IPP": "disabled"},
    "C library without AVX2 and FMA": {"GLIBC_TUNABLES": GLIBC},
    "NumPy without AVX-512": {"NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL"},
    "NumPy without AVX2": {"NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL"},
    "BLAS of an old processor": {"OPENBLAS_CORETYPE": "Nehalem"},
    "all of these": {
        "OPENCV_CPU_DISABLE": "SSE4.1,SSE4.2,AVX,FP16,AVX2,FMA3,AVX512-SKX,AVX512-ICL",
        "OPENCV_IPP": "disabled",
        "GLIBC_TUNABLES": GLIBC,
        "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL",
        "OPENBLAS_CORETYPE": "Nehalem",
    },
}
"""Environment variables by the processor that they imitate."""


def digest(n: int, backgrounds: Path | None) -> str:
    """Return the SHA-256 of pixels and truth of ``n`` images per kind of dataset."""
    whole = hashlib.sha256()
    synth = [
        SynthConfig(n, seed=3, deteriorate=mode, backgrounds=folder, channels=channels, distractors=3)
        for mode in ("none", "paper", "ladder")
        for folder in dict.fromkeys((None, backgrounds))
        for channels in (1, 3)
    ]
    suites = [
        SuiteConfig(load_suite(name), images=1, size_px=(406, 310), backgrounds=backgrounds, distortion=distortion)
        for name in ("paper-v1", "extended-v1")
        for distortion in ((), (-0.1, 0.02))
    ]
    for config in (*synth, *suites):
        for index in range(0, config.n, max(1, config.n // n)):
            sample, _ = config.make(index)
            for part in (sample.image, sample.keypoints, repr(sample.effects).encode()):
                whole.update(memoryview(part).cast("B") if isinstance(part, bytes) else part.tobytes())
    return whole.hexdigest()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=60)
    parser.add_argument("--backgrounds", type=Path)
    parser.add_argument("--here", action="store_true", help="print the digest of this process")
    options = parser.parse_args()
    if options.here:
        print(digest(options.n, options.backgrounds))
        return
    found = {}
    for name, variables in PROCESSORS.items():
        command = [sys.executable, __file__, "--here", f"--n={options.n}"]
        if options.backgrounds:
            command.append(f"--backgrounds={options.backgrounds}")
        done = subprocess.run(command, env={**os.environ, **variables}, capture_output=True, text=True)
        found[name] = done.stdout.strip() or "refused to start"
        print(f"{name:32} {found[name][:16]}", flush=True)
    print("all agree" if len(set(found.values())) == 1 else "they differ")
    sys.exit(len(set(found.values())) != 1)


if __name__ == "__main__":
    main()
