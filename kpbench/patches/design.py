"""Patch designs: TOML in, frozen :class:`Patch` out, with its exact outline.

A patch is a disc of radius 1 in one ink, on which semi-circles that share its centre are painted one
after the other, each in black, white, or inverting what lies below. What results is always a polar
chequer: rings between the radii, sectors between the angles, each cell black or white
(:meth:`Patch.cells`). Everything else (outline, ink at a point) is read off those cells.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kpbench.errors import DesignError
from kpbench.files import shipped_folder
from kpbench.geometry.outline import Region, circle, flatten
from kpbench.patches.contour import trace_contours
from kpbench.toml import TomlTable, name_source, read_toml
from kpbench.types import Float

SCHEMA = "kpbench.patch/1"
INKS = ("black", "white", "invert")
PATCH_KEYS = ("schema", "name", "id", "disc", "semicircles", "rim", "quiet_zone")


@dataclass(frozen=True)
class SemiCircle:
    """Half a disc about the shared centre: the angles from ``start_deg`` to ``start_deg + 180``."""

    radius: float
    start_deg: float
    ink: str


@dataclass(frozen=True)
class Patch:
    """One keypoint patch, in the patch frame (unit disc, u right, v down, angles clockwise).

    Attributes
    ----------
    name : str
    patch_id : int
        The identity that detectors report.
    disc : str
        Ink of the disc below the semi-circles, "black" or "white".
    semicircles : tuple of SemiCircle
        Painted in order.
    rim : float
        Width of a ring around the disc, as a fraction of the disc's radius; 0 for none.
    rim_ink : str
        "black" or "white".
    quiet_zone : float
        Width of a white ring outside the rim, as a fraction of the disc's radius.
    """

    name: str
    patch_id: int
    disc: str
    semicircles: tuple[SemiCircle, ...]
    rim: float = 0.0
    rim_ink: str = "white"
    quiet_zone: float = 0.0

    @property
    def extent(self) -> float:
        """Radius of all that belongs to the patch, rim and quiet zone included, in disc radii."""
        return 1.0 + self.rim + self.quiet_zone

    @cached_property
    def cells(self) -> tuple[Float, Float, NDArray[np.bool_]]:
        """The polar chequer: (radii, angles_deg, black).

        ``radii`` of shape (R + 1,) starts at 0; ``angles_deg`` of shape (A,) is sorted in [0, 360);
        ``black[i, j]`` says whether the cell between radii i and i + 1 and between angles j and
        j + 1 (cyclic) is black. Borders between cells of equal ink are already removed where they
        run through all sectors or all rings.
        """
        radii = np.unique([0.0, 1.0, *(s.radius for s in self.semicircles)])
        angles = np.unique(np.round([(s.start_deg + a) % 360.0 for s in self.semicircles for a in (0, 180)], 9))
        if not len(angles):
            angles = np.array([0.0])
        middle_radius = (radii[1:] + radii[:-1]) / 2
        middle_angle = (angles + np.append(angles[1:], angles[0] + 360)) / 2
        black = np.full((len(middle_radius), len(angles)), self.disc == "black")
        for s in self.semicircles:
            inside = np.outer(middle_radius < s.radius, (middle_angle - s.start_deg) % 360.0 < 180.0)
            black = np.where(inside, ~black if s.ink == "invert" else s.ink == "black", black)
        keep = np.append(np.any(black[1:] != black[:-1], axis=1), True)
        radii, black = np.append(0.0, radii[1:][keep]), black[keep]
        keep = np.any(black != np.roll(black, 1, axis=1), axis=0)
        if not keep.any():
            keep[0] = True
        angles, black = angles[keep], black[:, keep]
        for width, ink in ((self.rim, self.rim_ink), (self.quiet_zone, "white")):
            if width:
                radii = np.append(radii, radii[-1] + width)
                black = np.vstack([black, np.full((1, black.shape[1]), ink == "black")])
        return radii, angles, black

    def is_black(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Ink at points of the patch frame, shape (..., 2) to (...); outside the patch is white."""
        u, v = np.moveaxis(np.asarray(points, np.float64), -1, 0)
        radii, angles, black = self.cells
        ring = np.searchsorted(radii, np.hypot(u, v), side="right") - 1
        sector = (np.searchsorted(angles, np.degrees(np.arctan2(v, u)) % 360.0, side="right") - 1) % len(angles)
        padded = np.vstack([black, np.zeros((1, black.shape[1]), bool)])
        return cast(NDArray[np.bool_], padded[np.minimum(ring, len(black)), sector])

    @cached_property
    def black_region(self) -> Region:
        """Exact outline of all black ink: cells that touch along an edge are merged, so no seams."""
        return trace_contours(*self.cells)

    @property
    def disc_region(self) -> Region:
        """Exact outline of the whole patch, rim and quiet zone included."""
        return circle(0.0, 0.0, self.extent)

    @property
    def centre_is_crossing(self) -> bool:
        """Whether straight edges of at least two directions meet at the centre.

        Such a centre is the meeting point of image lines under any perspective; one edge alone
        leaves the centre loose along itself, and a centre of arcs only is biased under tilt.
        """
        _, angles, black = self.cells
        edges = angles[black[0] != np.roll(black[0], 1)]
        return len(np.unique(np.round(edges % 180.0, 6))) >= 2

    @property
    def digest(self) -> str:
        """SHA-256 of the ink itself: designs that print alike have the same digest."""
        radii, angles, black = self.cells
        content = (np.round(radii, 9).tolist(), np.round(angles, 9).tolist(), black.astype(int).tolist())
        return hashlib.sha256(repr(content).encode()).hexdigest()

    def to_dict(self) -> dict[str, Any]:
        """The design as its TOML table; ``parse_patch(patch.to_dict(), ...)`` gives it back."""
        table: dict[str, Any] = {"schema": SCHEMA, "name": self.name, "id": self.patch_id, "disc": self.disc}
        table["semicircles"] = [{"radius": s.radius, "start_deg": s.start_deg, "ink": s.ink} for s in self.semicircles]
        if self.rim:
            table["rim"] = {"width": self.rim, "ink": self.rim_ink}
        if self.quiet_zone:
            table["quiet_zone"] = self.quiet_zone
        return table


@lru_cache(maxsize=256)
def unit_polygons(patch: Patch, tolerance: float) -> tuple[tuple[Float, ...], tuple[Float, ...]]:
    """(black, whole patch) as polygons of the patch frame, see :func:`kpbench.geometry.outline.flatten`."""
    return tuple(flatten(patch.black_region, tolerance)), tuple(flatten(patch.disc_region, tolerance))


def parse_patch(content: Mapping[str, Any], source: str) -> Patch:
    """Build a patch from its TOML table.

    Raises
    ------
    DesignError
        One line that names ``source``, the key and what was expected.
    """
    with name_source(source, DesignError):
        table = TomlTable(content, PATCH_KEYS, DesignError)
        table.require_schema(SCHEMA, optional=True)
        rim = table.table("rim", ("width", "ink"), {})
        return Patch(
            name=table.text("name"),
            patch_id=table.whole_number("id", 0, 32767),
            disc=table.choice("disc", ("black", "white"), "white"),
            semicircles=tuple(
                SemiCircle(
                    entry.number("radius", 0.01, 1.0, 1.0),
                    entry.number("start_deg", -360.0, 360.0),
                    entry.choice("ink", INKS),
                )
                for entry in table.tables("semicircles", ("radius", "start_deg", "ink"))
            ),
            rim=rim.number("width", 0.0, 2.0, 0.0),
            rim_ink=rim.choice("ink", ("black", "white"), "white"),
            quiet_zone=table.number("quiet_zone", 0.0, 2.0, 0.0),
        )


def load_patch(path: str | Path) -> Patch:
    """Read one design file.

    Raises
    ------
    DesignError
        If it cannot be read, is no TOML, or is no design.
    """
    return parse_patch(read_toml(path, DesignError), str(path))


def load_patches(paths: Sequence[str | Path]) -> tuple[Patch, ...]:
    """Read several design files, in order of their ids; a folder stands for the .toml files in it.

    Raises
    ------
    DesignError
        As :func:`load_patch`, or if two designs share an id, or if a folder holds none.
    """
    patches: dict[int, tuple[str | Path, Patch]] = {}
    for path in itertools.chain.from_iterable(map(_design_files, paths)):
        patch = load_patch(path)
        if patch.patch_id in patches:
            raise DesignError(f"{path}: id {patch.patch_id} is taken by {patches[patch.patch_id][0]}")
        patches[patch.patch_id] = (path, patch)
    return tuple(patches[key][1] for key in sorted(patches))


def _design_files(path: str | Path) -> list[Path]:
    folder = Path(path)
    if not folder.is_dir():
        return [folder]
    files = sorted(folder.glob("*.toml"))
    if not files:
        raise DesignError(f"{folder}: no designs in it, expected files ending in .toml")
    return files


@lru_cache(maxsize=1)
def shipped_patches() -> tuple[Patch, ...]:
    """The four designs that ship with kpbench, in order of their ids."""
    return load_patches([shipped_folder("patches")])
