"""The numbers of the paper's tables (arXiv:2410.00521).

The paper's images are photographs, and kpbench's images are simulated. A table that shows numbers from both says so in
its title.
"""

from __future__ import annotations

from dataclasses import dataclass

from kpbench.scoring.metrics import PAPER_METRICS

Row = tuple[float, ...]


@dataclass(frozen=True)
class PaperTable:
    """One experiment of the paper: a value per rung for each of the three metrics.

    Attributes
    ----------
    number : int
        Number of the table in the paper.
    condition : str
        Name of the same condition in the suite ``paper-v1``.
    title, unit : str
        Name and unit of the quantity that changes from rung to rung.
    rungs : tuple of float
    detection_score, id_matching_score, average_false_alarm : tuple of float
        One value per rung.
    images : str
        How the paper's images were made.

    Examples
    --------
    >>> import kpbench
    >>> table = kpbench.report.PAPER["blur"]
    >>> table.rungs, table.detection_score
    ((3, 7, 11, 15), (1, 0.986, 0.882, 0.605))
    """

    number: int
    condition: str
    title: str
    unit: str
    rungs: tuple[float, ...]
    detection_score: Row
    id_matching_score: Row
    average_false_alarm: Row
    images: str = "photographs"


PAPER = {
    table.condition: table
    for table in (
        PaperTable(
            3,
            "scale",
            "Board's share of the image",
            "%",
            (0.5, 1, 2, 4, 8, 16, 32),
            (1, 1, 1, 1, 1, 1, 0.999),
            (1, 1, 1, 1, 1, 1, 1),
            (0, 0.436, 0.246, 1.032, 0.164, 0.715, 0.533),
        ),
        PaperTable(
            4,
            "pitch",
            "Pitch",
            "°",
            (0, 10, 20, 30, 40, 50, 60),
            (1, 0.999, 0.996, 1, 1, 1, 1),
            (1, 1, 1, 1, 1, 1, 1),
            (0.344, 0.486, 0.3385, 0.569, 0.592, 0.245, 0.284),
        ),
        PaperTable(
            5,
            "blur",
            "Blur kernel",
            "px",
            (3, 7, 11, 15),
            (1, 0.986, 0.882, 0.605),
            (1, 1, 1, 1),
            (0.257, 0.266, 0.111, 0.034),
        ),
        PaperTable(
            6,
            "dimming",
            "Dimming k",
            "",
            (10, 20, 30, 40),
            (1, 1, 0.988, 0.783),
            (1, 1, 1, 1),
            (0.037, 0, 0, 0),
        ),
        PaperTable(
            7,
            "noise",
            "Gaussian noise",
            "grey levels",
            (15, 30, 45, 60),
            (1, 0.872, 0.332, 0.071),
            (1, 0.998, 0.892, 0),
            (0.916, 0.302, 0.296, 0.556),
        ),
    )
}
"""The paper's tables 3 to 7, by condition."""

SYNTHETIC = {
    "none": dict(zip(PAPER_METRICS, (0.985, 0.999, 0.379), strict=True)),
    "paper": dict(zip(PAPER_METRICS, (0.950, 0.993, 0.727), strict=True)),
}
"""The paper's table 2 (synthetic validation set), by the value of `deteriorate` in :class:`kpbench.SynthConfig`."""
SYNTHETIC_RADIUS_PX = (5.0, 80.0)
"""Default limits of the radius, px. Only a synthetic set with these limits is comparable with table 2."""


def paper_value(condition: str | None, rung: float | None, metric: str) -> float | None:
    """Return a value from the paper's tables 3 to 7, or None if the tables have no such value.

    Examples
    --------
    >>> import kpbench
    >>> kpbench.report.paper_value("blur", 15, "detection_score")
    0.605
    """
    table = PAPER.get(condition or "")
    if table is None or rung not in table.rungs or metric not in PAPER_METRICS:
        return None
    row: Row = getattr(table, metric)
    return row[table.rungs.index(rung)]
