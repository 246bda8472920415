"""Trace every command: which network addresses it connects to, and what it writes outside its folders.

    python benchmarks/robustness/trace_commands.py             # every command, about ten minutes
    python benchmarks/robustness/trace_commands.py detect      # the commands that begin so

Needs strace. Each command runs in an empty home folder. The folder of the command and the temporary folder are allowed;
so are devices, and shared memory of this machine. The exit code is 1 if a command connects or writes elsewhere, or if
a command of kpbench is missing from the list.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

COMMANDS = """
--help
render-patches --pdf --svg --png --dxf --dpi 100 --out print
render-patches --board hexagon --page a3 --out board
render-patches --measured 99.8,100.1 --out print
synth --n 6 --size 320x240 --shard-size 3 --out set
synth --n 2 --size 320x240 --channels 3 --camera phone --out taken
synth --n 6 --size 320x240 --shard-size 3 --shard-range 0:1 --out parts
synth --n 6 --size 320x240 --shard-size 3 --shard-range 1:2 --out parts
synth --n 2 --size 320x240 --channels 3 --deteriorate ladder --distractors 2 --augment pipeline.json --out ladder
merge parts
suite paper-v1 --images 1 --size 203x155 --only blur,noise --out suite
suite extended-v1 --images 1 --size 203x155 --out extended
suite paper-v1 --images 1 --size 203x155 --only pitch --board charuco --out tags
inspect set
verify set
diff set set --json diff.json
preview set --count 4 --out sheet.png
export set --format coco --out coco
export set --format yolo --out yolo
export set --format webdataset --out webdataset
degrade coco/images --effect rain --level 500 --effect shadow-edge --level 50 --out degraded
detect set --detector template --out template.json
detect set --detector superpoint-small --out small.csv
detect set --detector superpoint --workers 1 --out large.h5
detect set --detector sift --out sift.jsonl
detect set --detector orb --out orb.parquet
detect tags --detector charuco --out charuco.json
detect tags --detector aruco --out aruco.json
detect tags --detector apriltag --out apriltag.json
detect coco/images --detector template --overlay drawn --out drawn.json
detect coco/images --detector template --overlay drawn.mp4 --out drawn2.json
detect drawn.mp4 --detector template --out film.json
detect set --detector mine:find --out mine.json
score small.csv --gt set --json scores.json --csv scores.csv --report report.html
score small.csv --gt coco/annotations.json --report report.md
score small.csv --gt set --report report.tex
plan --pilot small.csv --gt set --margin 0.1 --json plan.json
compare small.csv template.json --gt set --json compared.json --report compared.html
bench --suite paper-v1 --images 1 --size 203x155 --only blur --detector orb --detector aruco --out bench
leaderboard verify bench --out again --json verified.json
suite video-v1 --images 1 --frames 3 --size 406x310 --only speed --out films
track films --poses poses.jsonl --overlay tracked.mp4
score poses.jsonl --gt films
calibrate sheet/photos --board sheet/board/truth.json --report camera.html
label sheet/photos --board sheet/board/truth.json --camera camera.yaml --out labelled
print-check sheet/photos --board sheet/board/truth.json
train --config recipe.toml --out run
export-model run/checkpoint.safetensors --out weights.onnx
detect set --detector weights.onnx --out weights.json
train --config recipe.toml --init weights.onnx --tensorboard --out run2
export-model small.onnx --int8 --out small-int8.onnx
train --verifier ellipse set --test set --epochs 0 --workers 1 --out ellipse
train --verifier judges set --test set --epochs 0 --workers 1 --out judges
analyze-patches --json measures.json --figure measures.svg
ui --help
live --help
demo --n 2
"""
"""Each line is a command line; a command may read what the commands before it wrote."""
CALLS = (
    "connect,sendto,sendmsg,bind,open,openat,creat,mkdir,mkdirat,rename,renameat,renameat2,unlink,unlinkat,rmdir,link,"
    "linkat,symlink,symlinkat,truncate,mknod,mknodat"
)
DEVICES = ("/dev/null", "/dev/tty", "/dev/shm", "/proc/self", "/proc/thread-self")
"""What every folder may hold besides: devices, shared memory, and what a process tells about itself."""
PATH = re.compile(r'(?:(?:AT_FDCWD|\d+)<([^>]*)>, )?"((?:[^"\\]|\\.)*)"')
"""A path in a line of strace: the folder that it is relative to, and the path."""


def trace(command: Sequence[str], work: Path, place: Path) -> tuple[subprocess.CompletedProcess[str], list[str]]:
    """Run a command in the folder ``work``, with a home and a temporary folder in ``place``; return also its trace."""
    home, temporary, log = place / "home", place / "temporary", place / "trace.txt"
    for folder in (home, temporary):
        folder.mkdir(parents=True, exist_ok=True)
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("XDG_", "ORT_", "NO_ALBUM"))}
    set_here = {"HOME": str(home), "TMPDIR": str(temporary), "PYTHONDONTWRITEBYTECODE": "1"}
    strace = ["strace", "--seccomp-bpf", "-f", "-qq", "-y", "-s", "4096", "-e", f"trace={CALLS}", "-o", str(log)]
    done = subprocess.run(
        [*strace, *command], cwd=work, env=kept | set_here, capture_output=True, text=True, check=False
    )
    return done, log.read_text(errors="replace").splitlines()


def connections(lines: Iterable[str]) -> list[str]:
    """Return the lines that name an address of the internet."""
    return [line for line in lines if "sa_family=AF_INET" in line]


def written_outside(lines: Iterable[str], work: Path, allowed: Sequence[Path]) -> list[str]:
    """Return the paths, outside the allowed folders, that were opened for writing, made, renamed or removed."""
    inside = (*(os.path.realpath(folder) for folder in allowed), *DEVICES)
    found = set()
    for line in lines:
        name = line.split(maxsplit=1)[-1].partition("(")[0]
        if name in ("connect", "sendto", "sendmsg", "bind") or " = -1 " in line:
            continue
        if name in ("open", "openat") and not re.search("O_WRONLY|O_RDWR|O_CREAT", line):
            continue
        paths = [os.path.normpath(work / (folder or "") / path) for folder, path in PATH.findall(line)]
        # the first path of a link is only read
        for path in paths[name in ("link", "linkat", "symlink", "symlinkat") :]:
            if not any(path == folder or path.startswith(folder + "/") for folder in inside):
                found.add(path)
    return sorted(found)


def prepare(work: Path) -> None:
    """Write the files that the commands read."""
    (work / "pipeline.json").write_text('{"transform": {"__class_fullname__": "Rotate", "limit": [-20, 20], "p": 1.0}}')
    (work / "mine.py").write_text("from kpbench import Detections\ndef find(image): return Detections.none()\n")
    recipe = (
        'name = "tiny"\nbatch = 1\nphases = [{ samples = 1 }]\n[samples]\nkind = "crops"\nsize = [32, 32]\n[network]\n'
    )
    recipe += "widths = [4, 4, 8, 8]\ndepths = [1, 1, 1, 1]\nhead_width = 8\ndescriptor_width = 8\n"
    (work / "recipe.toml").write_text(recipe)
    from kpbench.detectors.superpoint import WEIGHTS

    (work / "small.onnx").write_bytes((WEIGHTS / "superpoint-small.onnx").read_bytes())
    photograph = Path(__file__).parents[1] / "accuracy" / "truth_board_photos.py"
    photos = ("--photos", "8", "--size", "812", "620")
    subprocess.run([sys.executable, photograph, work / "sheet", *photos], check=True)


def main() -> int:
    from kpbench.cli import COMMANDS as KNOWN

    wanted = shlex.split(" ".join(sys.argv[1:]))
    lines = [shlex.split(line) for line in COMMANDS.strip().splitlines()]
    missing = set(KNOWN) - {line[0] for line in lines}
    bad = bool(missing)
    print(*(f"{name} is not traced\n" for name in sorted(missing)), sep="", end="")
    print("exit  connections  written outside  command")
    with tempfile.TemporaryDirectory() as folder:
        place, work = Path(folder), Path(folder) / "work"
        work.mkdir()
        prepare(work)
        for line in lines:
            if wanted and line[: len(wanted)] != wanted:
                continue
            done, log = trace([sys.executable, "-P", "-m", "kpbench", *line], work, place)
            calls, paths = connections(log), written_outside(log, work, [work, place / "temporary"])
            bad |= bool(calls or paths or done.returncode)
            print(f"{done.returncode:4}  {len(calls):11}  {len(paths):15}  {shlex.join(line)}", flush=True)
            print(*(f"      {text}\n" for text in (*calls[:5], *paths[:20])), sep="", end="")
            if done.returncode:
                print(done.stderr[-500:])
    return int(bad)


if __name__ == "__main__":
    sys.exit(main())
