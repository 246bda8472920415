"""Write the difference between two datasets as plain text, for a terminal."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from kpbench.drift.datasets import DatasetDifference
from kpbench.drift.images import PixelChanges, TruthChanges
from kpbench.report.tables import Cell, Table, to_plain

SHOWN_CHARACTERS = 60
"""Characters of a value of a config that are shown."""
MOVEMENTS = {"median": "median", "quantile_95": "95 %", "largest": "largest"}
"""What is shown of the distances that keypoints moved, and its label."""


def summarise_difference(difference: DatasetDifference) -> str:
    """Write what differs between two datasets, and the table of the distributions.

    Examples
    --------
    >>> import kpbench
    >>> difference = kpbench.diff("kpbench-data", "kpbench-data")
    >>> print(kpbench.drift.summarise_difference(difference).splitlines()[2])
    config         the same
    """
    lines = [
        f"{letter:<14} {about['path']}: {about['images']} images, {about['keypoints']} keypoints, "
        f"fingerprint {about['fingerprint'][:16]}"
        for letter, about in zip("AB", difference.about, strict=True)
    ]
    fields = difference.config
    lines.append(f"{'config':<14} {'differs' if fields else 'the same'}")
    lines += [f"  {field}: {_shorten(old)} -> {_shorten(new)}" for field, (old, new) in fields.items()]
    lines += [*_describe_truth(difference.truth), *_describe_pixels(difference.pixels)]
    drifted = [d.name.split(",")[0] for d in difference.drifted]
    lines.append(
        f"{'distributions':<14} "
        + (
            f"drift: {', '.join(drifted)}"
            if drifted
            else f"no drift: no shift is shown to be over {difference.max_shift:g}"
        )
    )
    rows: list[tuple[Cell, ...]] = [
        (
            d.name,
            d.count_a,
            d.count_b,
            d.typical_a,
            d.typical_b,
            d.shift,
            d.p_holm,
            "drift" if d in difference.drifted else "",
        )
        for d in difference.distributions
    ]
    columns = ("", "values A", "values B", "typical A", "typical B", "shift", "p (Holm)", "")
    return "\n".join([*lines, "", to_plain(Table("", columns, tuple(rows)))])


def _shorten(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[: SHOWN_CHARACTERS - 1]}…"


def _describe_truth(truth: TruthChanges) -> Iterator[str]:
    only = "".join(
        f", {len(names)} only in {letter}"
        for letter, names in zip("AB", (truth.only_a, truth.only_b), strict=True)
        if names
    )
    yield f"{'images':<14} {truth.common} in both, by {truth.matched_by}{only}"
    if not truth.changed:
        yield f"{'truth':<14} the same in all images of both"
        return
    yield f"{'truth':<14} differs in {truth.changed} of {truth.common} images"
    counts = f"{truth.added} added, {truth.removed} removed, {len(truth.moved_px)} moved"
    yield f"  keypoints: {counts}, {truth.id_changed} with another ID"
    if truth.moved_px:
        moved = truth.to_dict()["moved_px"]
        shown = (f"{moved[name]:.3g} px ({label})" for name, label in MOVEMENTS.items())
        yield f"  moved by {', '.join(shown)}"
    others = [f"{name} of {count}" for name, count in truth.columns.items() if count]
    if others:
        yield f"  other columns: {', '.join(others)}"


def _describe_pixels(pixels: PixelChanges) -> Iterator[str]:
    if pixels.other_size:
        yield f"{'sizes':<14} differ in {pixels.other_size} of {pixels.compared} images"
    if not pixels.changed:
        yield f"{'pixels':<14} the same in {pixels.compared - pixels.other_size} images"
        return
    yield (
        f"{'pixels':<14} differ in {pixels.changed} of {pixels.compared - pixels.other_size} images, by "
        f"{pixels.mean_levels:.3g} grey levels on average (median image), {pixels.largest_levels} at most"
    )
