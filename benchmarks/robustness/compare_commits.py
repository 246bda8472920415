"""Compare the bytes that two commits write on this machine: datasets, suites, prints, exports, predictions, scores.

    python benchmarks/robustness/compare_commits.py OLD NEW    # two commits, such as main~3 and HEAD

Each commit is checked out into a folder of its own and runs the same commands. Both use the interpreter that runs this
script, so the packages that kpbench needs must be installed there. The exit code is 1 if a file differs or is missing.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(
    subprocess.check_output(["git", "rev-parse", "--show-toplevel"], text=True, cwd=Path(__file__).parent).strip()
)
COMMANDS = """
synth --n 12 --seed 3 --size 320x240 --shard-size 5 --workers 1 --out synth
synth --n 12 --seed 3 --size 320x240 --shard-size 5 --shard-range 0:1 --workers 1 --out parts
synth --n 12 --seed 3 --size 320x240 --shard-size 5 --shard-range 1:3 --workers 1 --out parts
merge parts
synth --n 6 --seed 4 --size 320x240 --channels 3 --deteriorate ladder --distractors 3 --workers 1 --out ladder
suite paper-v1 --images 1 --size 203x155 --only blur,noise --workers 1 --out suite
suite extended-v1 --images 1 --size 203x155 --workers 1 --out extended
suite paper-v1 --images 1 --size 203x155 --only pitch --board charuco --workers 1 --out tags
render-patches --svg --png --pdf --dxf --dpi 150 --out print
render-patches --svg --png --pdf --dxf --dpi 150 --board hexagon --page a3 --out board
render-patches --svg --dxf --board hexagon --patch 0 --diameter-mm 60 --tile --mirror --out tiles
render-patches --svg --board grid --page a3 --landscape --no-labels --out grid
render-patches --measured 99.8,100.1 --out print
preview synth --count 4 --columns 2 --tile-width 160 --out sheet.png
export synth --format coco --out coco
export synth --format yolo --out yolo
export synth --format webdataset --out webdataset
detect --detector sift synth --out preds.json
detect --detector orb synth --out orb.jsonl
score preds.json --gt synth --json scores.json --csv scores.csv
compare orb.jsonl preds.json --gt synth --json compared.json
degrade synth-images --effect motion-blur --level 5 --effect noise --level 20 --out degraded
"""


def outputs(commit: str, folder: Path) -> dict[str, str]:
    """Run the commands of one commit in a folder; return the SHA-256 of each file that they write."""
    code, work = folder / "code", folder / "work"
    work.mkdir(parents=True)
    subprocess.run(["git", "worktree", "add", "--quiet", "--detach", str(code), commit], cwd=ROOT, check=True)
    try:
        (work / "synth-images").mkdir()
        (work / "synth-images" / "0.png").write_bytes((ROOT / "tests" / "golden" / "images" / "00.png").read_bytes())
        for line in COMMANDS.strip().splitlines():
            done = subprocess.run(
                [sys.executable, "-P", "-m", "kpbench", *shlex.split(line)],
                cwd=work, env=os.environ | {"PYTHONPATH": str(code)}, capture_output=True, text=True, check=False,
            )  # fmt: skip
            if done.returncode:
                sys.exit(f"{commit}: kpbench {line}\nexit code {done.returncode}: {done.stderr.strip()}")
    finally:
        subprocess.run(["git", "worktree", "remove", "--force", str(code)], cwd=ROOT, check=True)
    files = sorted(path for path in work.rglob("*") if path.is_file())
    return {path.relative_to(work).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def main() -> None:
    """Compare two commits and print the files that differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old")
    parser.add_argument("new")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        old, new = outputs(arguments.old, Path(folder, "old")), outputs(arguments.new, Path(folder, "new"))
    differing = [name for name in sorted(old.keys() | new.keys()) if old.get(name) != new.get(name)]
    for name in differing:
        only = arguments.old if name not in new else arguments.new if name not in old else None
        print(f"{name}: only of {only}" if only else f"{name}: differs")
    print(
        f"{arguments.old} writes {len(old)} files, {arguments.new} writes {len(new)}, {len(differing)} are not the same"
    )
    sys.exit(bool(differing))


if __name__ == "__main__":
    main()
