"""What the images of a dataset are: simulated, simulated photographs, or photographs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

IMAGE_SOURCES = ("simulated", "simulated photographs", "photographs")
"""What images can be. Simulated photographs are images that a simulated camera took, labelled as photographs are."""
UNKNOWN_SOURCE = "not told"
"""What tables say of images of which nothing tells what they are."""
SIMULATORS = ("suite", "synth")
"""Kinds of config from which kpbench simulates images."""


def image_source(config: Mapping[str, Any]) -> str:
    """Return what the images of a dataset are, from the dataset's config: one of ``IMAGE_SOURCES``, or "" if unknown.

    Every copy of a dataset carries the answer along: a degraded dataset, a merged one, an export, a report.

    Examples
    --------
    >>> from kpbench.provenance import image_source
    >>> image_source({"kind": "synth"}), image_source({"source": "photographs"}), image_source({})
    ('simulated', 'photographs', '')
    """
    if config.get("kind") in SIMULATORS:
        return "simulated"
    source = config.get("source")
    return str(source) if source in IMAGE_SOURCES else ""


def describe_images(count: int, source: str) -> str:
    """Return a number of images with what they are.

    Examples
    --------
    >>> from kpbench.provenance import describe_images
    >>> [describe_images(3, source) for source in ("simulated", "photographs", "")]
    ['3 simulated images', '3 photographs', '3 images']
    """
    return f"{count} {source}" if source.endswith("photographs") else f"{count} {source} images".replace("  ", " ")
