"""The leaderboard, its figures and the table of the findings from the scores in benchmarks/results.

    python benchmarks/publish/leaderboard.py                        # writes four files of docs/results
    python benchmarks/publish/leaderboard.py --take kpbench-bench --verified verified.json   # first copy these scores

The table of the findings and the figure show `paper-v1` at 640x480 over procedural backgrounds; results of another
size or over photographs are kept apart.
Of a scores file only what the tables need is kept: all images, and every condition and rung.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kpbench.report import (
    PAPER,
    Cell,
    Estimate,
    Panel,
    Series,
    Table,
    draw_panels,
    to_markdown,
)
from kpbench.scoring import LABELS

ROOT = Path(__file__).parents[2]
RESULTS, DOCS = ROOT / "benchmarks" / "results", ROOT / "docs" / "results"
PAGE, FINDINGS, FIGURE = DOCS / "leaderboard.md", DOCS / "findings.md", DOCS / "severity.svg"
ORDER = ("template", "superpoint-small", "superpoint", "apriltag", "napa", "locus", "aruco", "charuco", "sift", "orb")
SHOWN_METRICS = ("detection_score", "id_matching_score", "average_false_alarm", "error_median_px")
PAPER_STYLE = 7
QUICK_PX = (640, 480)
"""The size of `kpbench bench --quick`."""

HEAD = """\
# Leaderboard

Made by `python benchmarks/publish/leaderboard.py` from the scores in `benchmarks/results`, which `kpbench bench` wrote.
All images are **simulated**. Brackets hold 95 % intervals from resampled scenes; how few scenes there are stands over
each table. What boards of tags are, and how far they compare with patches:
[patches against tags](../explanation/fairness-to-tags.md).

To enter a detector: run the command below a heading with `--detector` yours, and send the folders `scores` and
`predictions` of `kpbench-bench`. `kpbench leaderboard verify kpbench-bench --json verified.json` makes the images anew,
and runs the detector again on a random 2 % of them. `python benchmarks/publish/leaderboard.py --take kpbench-bench
--verified verified.json` puts the scores into `benchmarks/results`. The column *verified* says on how many images the
rerun found the same; *no* means that nobody has rerun the detector.

`extended-v2`, and the boards of tags on `extended-v1`, were measured on 2026-12-01, the tags at their
[tuned settings](../explanation/fairness-to-tags.md#each-tag-has-its-best-detector). All other scores are older: they
were made with version 1 of the pixels and version 7 of the verification, and the boards of tags on `paper-v1` with
settings that were not tuned. What has changed since then, and how little it moved on 250 images, stands at the head of
the [findings](findings.md).
"""


def take(folder: Path, verified: Path | None) -> None:
    """Copy scores, and into them on how many images a rerun of the detector found the same."""
    entries = json.loads(verified.read_text())["results"] if verified else []
    images = {entry["scores_sha256"]: entry["images"] for entry in entries if not entry["problem"]}
    for path in sorted(folder.glob("scores/*/*.json")):
        scores = json.loads(path.read_text())
        scores["verified_images"] = images.get(hashlib.sha256(path.read_bytes()).hexdigest(), 0)
        scores["by"] = [group for group in scores["by"] if group["patch_id"] is None and group["radius_px"] is None]
        for key in ("confusion", "curve", "slices"):
            scores.pop(key, None)
        scores["detector"].pop("failures", None)
        known = scores["provenance"]  # whose folder the photographs lie in is nobody's business
        known["command"] = re.sub(r"(--backgrounds[ =])\S+", r"\1PHOTOS", known["command"])
        known["command"] = re.sub(r" --out[ =]\S+", "", known["command"])
        known["predictions"] = [{**entry, "file": Path(entry["file"]).name} for entry in known["predictions"]]
        known["dataset"]["path"] = Path(known["dataset"]["path"]).name
        target = RESULTS / folder_name(known["config"]) / path.name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(json.dumps(scores, sort_keys=True) + "\n")


def folder_name(config: dict[str, Any]) -> str:
    """Results that do not compare are in folders of their own."""
    width, height = config["size_px"]
    size = f"-{width}x{height}" if (width, height) != QUICK_PX else ""
    return config["suite"] + size + ("-photographs" if config["backgrounds"]["kind"] == "photographs" else "")


def load(suite: Path) -> list[dict[str, Any]]:
    """Scores of one suite, in the order of the tables."""
    runs = [json.loads(path.read_text()) for path in sorted(suite.glob("*.json"))]
    return sorted(runs, key=lambda run: (place(run), run["detector"]["name"]))


def place(run: dict[str, Any]) -> int:
    name = run["detector"]["name"]
    return ORDER.index(name) if name in ORDER else len(ORDER)


def estimate(metrics: dict[str, Any], name: str) -> Estimate:
    interval = metrics["intervals"].get(name)
    return Estimate(metrics[name], interval and tuple(interval))


def rungs(run: dict[str, Any], condition: str) -> list[tuple[float, dict[str, Any]]]:
    return sorted((g["rung"], g["metrics"]) for g in run["by"] if g["condition"] == condition)


def overall(runs: list[dict[str, Any]]) -> Table:
    rows = []
    for run in runs:
        board = run["provenance"]["config"].get("board", {"name": "patches"})["name"]
        images = run["metrics"]["counts"]["images"]
        about = (run["detector"]["name"], run["detector"]["version"], board, images)
        verified = run.get("verified_images")
        rows.append(
            (
                *about,
                *(estimate(run["metrics"], name) for name in SHOWN_METRICS),
                f"on {verified} images" if verified else "no",
            )
        )
    columns = ("detector", "version", "board", "images", *(LABELS[name] for name in SHOWN_METRICS), "verified")
    return Table("All conditions", columns, tuple(rows))


def by_rung(runs: list[dict[str, Any]], condition: dict[str, Any]) -> Table:
    name = condition["name"]
    rows = [
        (run["detector"]["name"], *(estimate(m, "detection_score") for _, m in rungs(run, name)), crossing(run, name))
        for run in runs
    ]
    columns = ("detection score", *(f"{rung:g}" for rung in sorted(condition["rungs"])), "crosses 0.9")
    return Table(name, columns, tuple(rows))


def summary(runs: list[dict[str, Any]]) -> Table:
    """The table of the findings: the mean over the rungs of each of the paper's conditions."""

    def mean(values: Sequence[float]) -> float:
        return sum(values) / len(values)

    rows: list[tuple[Cell, ...]] = [
        ("the paper's network", "photographs", *(mean(t.detection_score) for t in PAPER.values()), None),
        *(
            (
                run["detector"]["name"],
                "simulated",
                *(mean([m["detection_score"] for _, m in rungs(run, name)]) for name in PAPER),
                estimate(run["metrics"], "average_false_alarm"),
            )
            for run in runs
        ),
    ]
    return Table("", ("detection score, mean of the rungs", "images", *PAPER, "false alarms per image"), tuple(rows))


def findings(text: str, runs: list[dict[str, Any]]) -> str:
    """The page of the findings with its table made anew."""
    table = to_markdown(summary(runs)).partition("\n\n")[2]
    return re.sub(r"(?s)(<!-- benchmarks/publish/leaderboard.py -->\n).*?(?=<!-- end -->)", rf"\g<1>{table}", text)


def crossing(run: dict[str, Any], condition: str) -> str:
    found = [b for b in run["breakpoints"] if b["condition"] == condition]
    return "; ".join(b["crossing"] + (f" at {b['rung']:.3g}" if b["rung"] is not None else "") for b in found)


def figure(runs: list[dict[str, Any]]) -> list[Panel]:
    """Detection score over the paper's five conditions."""
    panels = []
    for table in PAPER.values():
        series = []
        for n, run in enumerate(runs):
            found = [(rung, estimate(metrics, "detection_score")) for rung, metrics in rungs(run, table.condition)]
            x, y = [rung for rung, _ in found], [e.value for _, e in found]
            series.append(Series(run["detector"]["name"], x, y, [e.interval for _, e in found], n + (n >= PAPER_STYLE)))
        name = "the paper, photographs (all others: simulated)"
        paper = Series(name, table.rungs, table.detection_score, style=PAPER_STYLE, dashed=True)
        label = f"{table.title} ({table.unit})" if table.unit else table.title
        is_log = table.condition == "scale"
        panels.append(Panel((*series, paper), label, "detection score", (0, 1), table.rungs, is_log))
    return panels


def page(results: Path) -> tuple[str, list[Panel]]:
    """The page as Markdown, and the panels of its figure."""
    parts, picture = [HEAD], list[Panel]()
    for suite in sorted(results.iterdir(), reverse=True):
        runs = load(suite)
        config = runs[0]["provenance"]["config"]
        if suite.name == "paper-v1":
            parts.append("![Detection score over severity](severity.svg)\n\nAlso as [PDF](severity.pdf).\n")
            picture = figure(runs)
        size = "x".join(map(str, config["size_px"]))
        command = f"kpbench bench --suite {config['suite']} --images {config['images']} --size {size}"
        kind = config["backgrounds"]["kind"]
        command += " --backgrounds PHOTOS" if kind == "photographs" else ""
        parts.append(f"## `{config['suite']}`, {size}, {config['images']} scenes\n")
        parts.append(
            f"Seed {config['seed']}, {'photographs as' if kind == 'photographs' else kind} backgrounds: `{command}`\n"
        )
        parts.append(to_markdown(overall(runs)))
        parts += [to_markdown(by_rung(runs, condition)) for condition in config["conditions"]]
    return "\n".join(parts), picture


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--take", type=Path, metavar="FOLDER", help="copy the scores of a `kpbench bench` folder first")
    parser.add_argument(
        "--verified", type=Path, metavar="FILE", help="of `kpbench leaderboard verify FOLDER --json FILE`"
    )
    options = parser.parse_args()
    if options.take:
        take(options.take, options.verified)
    text, picture = page(RESULTS)
    FINDINGS.write_text(findings(FINDINGS.read_text(), load(RESULTS / "paper-v1")))
    PAGE.write_text(text)
    for suffix in (".svg", ".pdf"):
        FIGURE.with_suffix(suffix).write_bytes(draw_panels(picture, suffix))


if __name__ == "__main__":
    main()
