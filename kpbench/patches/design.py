"""Designs of patches: read from TOML, and turned into exact outlines.

A patch starts as a disc of radius 1 in a single ink. Semi-circles about the disc's centre are painted onto the disc
one after the other. A semi-circle is black, or white, or inverts the ink below. The result is always a polar chequer
(:attr:`Patch.cells`). Radii divide the chequer into rings, and angles divide the chequer into sectors. Each cell is
black or white.
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
SEMICIRCLES_LIMIT = 100
"""Largest number of semi-circles of a design: its cells grow with the square of the number."""
INKS = ("black", "white", "invert")
PATCH_KEYS = ("schema", "name", "id", "disc", "semicircles", "rim", "quiet_zone")


@dataclass(frozen=True)
class SemiCircle:
    """Half of a disc about the centre of the patch.

    Attributes
    ----------
    radius : float
        Radius as a fraction of the disc's radius.
    start_deg : float
        The semi-circle spans the angles from ``start_deg`` to ``start_deg + 180``. Angles grow from +u towards +v.
    ink : str
        "black", "white" or "invert".

    Examples
    --------
    >>> from kpbench.patches import Patch, SemiCircle
    >>> right_half = SemiCircle(radius=1.0, start_deg=-90.0, ink="black")
    >>> bool(Patch("half", 9, "white", (right_half,)).is_black([0.5, 0.0]))
    True
    """

    radius: float
    start_deg: float
    ink: str


@dataclass(frozen=True)
class Patch:
    """A design in the patch frame.

    The disc has radius 1. u points right, v points down, and angles grow from +u towards +v.

    Attributes
    ----------
    name : str
    patch_id : int
        Identity that detectors report.
    disc : str
        Ink of the disc below the semi-circles, "black" or "white".
    semicircles : tuple of SemiCircle
        Painted in this order.
    rim : float
        Width of the ring around the disc, as a fraction of the disc's radius; 0 for no rim.
    rim_ink : str
        Ink of the rim, "black" or "white".
    quiet_zone : float
        Width of the white ring around the rim, as a fraction of the disc's radius; 0 for no quiet zone.

    Examples
    --------
    >>> import kpbench
    >>> checker = kpbench.shipped_patches()[0]
    >>> checker.name, checker.extent, checker.centre_is_crossing
    ('checker', 1.0, True)
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
        """Outer radius in disc radii, rim and quiet zone included."""
        return 1.0 + self.rim + self.quiet_zone

    @cached_property
    def cells(self) -> tuple[Float, Float, NDArray[np.bool_]]:
        """The polar chequer (radii, angles_deg, black).

        * ``radii``, ndarray of shape (R + 1,): radii that bound the rings, ascending from 0.
        * ``angles_deg``, ndarray of shape (A,): angles that bound the sectors, ascending in [0, 360).
        * ``black``, ndarray of shape (R, A), bool: ``black[i, j]`` tells whether the cell between ``radii[i]`` and
          ``radii[i + 1]`` and between ``angles_deg[j]`` and ``angles_deg[j + 1]`` is black. The last sector ends at the
          first angle.

        The disc has as few rings and sectors as possible: between any two neighbouring rings or sectors, some cells
        differ in colour. The rim and the quiet zone are rings of their own, even beside a ring of the same ink.
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
        """Return whether points of the patch frame are black. Points outside the patch are white.

        Parameters
        ----------
        points : array_like of shape (..., 2)

        Returns
        -------
        ndarray of shape (...), bool
        """
        u, v = np.moveaxis(np.asarray(points, np.float64), -1, 0)
        radii, angles, black = self.cells
        ring = np.searchsorted(radii, np.hypot(u, v), side="right") - 1
        sector = (np.searchsorted(angles, np.degrees(np.arctan2(v, u)) % 360.0, side="right") - 1) % len(angles)
        padded = np.vstack([black, np.zeros((1, black.shape[1]), bool)])
        return cast(NDArray[np.bool_], padded[np.minimum(ring, len(black)), sector])

    @cached_property
    def black_region(self) -> Region:
        """Exact outline of all black ink, without seams: black cells that share a border are merged."""
        return trace_contours(*self.cells)

    @cached_property
    def white_region(self) -> Region:
        """Exact outline of all that is not black within rim and quiet zone: the ink of an inverted print."""
        radii, angles, black = self.cells
        return trace_contours(radii, angles, ~black)

    @property
    def disc_region(self) -> Region:
        """Exact outline of the patch, rim and quiet zone included."""
        return circle(0.0, 0.0, self.extent)

    @property
    def centre_is_crossing(self) -> bool:
        """Whether straight edges of at least two directions meet at the centre.

        Straight edges stay straight under every homography. Edges of two directions therefore mark the centre exactly.
        Edges of a single direction leave the centre undetermined along that direction. If a design has only arcs, the
        centre can only be estimated from the arcs, and this estimate is biased under tilt.
        """
        _, angles, black = self.cells
        edges = angles[black[0] != np.roll(black[0], 1)]
        return len(np.unique(np.round(edges % 180.0, 6))) >= 2

    @cached_property
    def symmetry_order(self) -> int:
        """Number of rotations within a full turn that leave the print unchanged.

        The rotation by 0 degrees counts, so 1 means that the orientation is unique. 0 means that every rotation leaves
        the print unchanged.
        """
        _, angles, black = self.cells
        if len(angles) == 1:
            return 0
        width = np.diff(np.append(angles, angles[0] + 360.0))
        shifts = range(len(angles))
        same = (np.allclose(np.roll(width, k), width) and (np.roll(black, k, axis=1) == black).all() for k in shifts)
        return int(sum(same))

    @property
    def digest(self) -> str:
        """SHA-256 of :attr:`cells`. Designs with the same digest have identical ink."""
        radii, angles, black = self.cells
        content = (np.round(radii, 9).tolist(), np.round(angles, 9).tolist(), black.astype(int).tolist())
        return hashlib.sha256(repr(content).encode()).hexdigest()

    def to_dict(self) -> dict[str, Any]:
        """Return the design as the content of its TOML file. :func:`parse_patch` is the inverse."""
        table: dict[str, Any] = {"schema": SCHEMA, "name": self.name, "id": self.patch_id, "disc": self.disc}
        table["semicircles"] = [{"radius": s.radius, "start_deg": s.start_deg, "ink": s.ink} for s in self.semicircles]
        if self.rim:
            table["rim"] = {"width": self.rim, "ink": self.rim_ink}
        if self.quiet_zone:
            table["quiet_zone"] = self.quiet_zone
        return table


@lru_cache(maxsize=256)
def unit_polygons(patch: Patch, tolerance: float) -> tuple[tuple[Float, ...], tuple[Float, ...]]:
    """Return the polygons of the black ink and the polygons of the whole patch, in the patch frame.

    ``tolerance`` is the largest distance between an arc and its chords, in disc radii.
    """
    return tuple(flatten(patch.black_region, tolerance)), tuple(flatten(patch.disc_region, tolerance))


def parse_patch(content: Mapping[str, Any], source: str) -> Patch:
    """Return the patch that the content of a TOML file describes.

    Raises
    ------
    DesignError
        If a key is unknown or a value is wrong. The message names ``source``, the key and what was expected.
    """
    with name_source(source, DesignError):
        table = TomlTable(content, PATCH_KEYS, DesignError)
        table.require_schema(SCHEMA, optional=True)
        rim = table.table("rim", ("width", "ink"), {})
        return Patch(
            name=table.name(),
            patch_id=table.whole_number("id", 0, 32767),
            disc=table.choice("disc", ("black", "white"), "white"),
            semicircles=tuple(
                SemiCircle(
                    entry.number("radius", 0.01, 1.0, 1.0),
                    entry.number("start_deg", -360.0, 360.0),
                    entry.choice("ink", INKS),
                )
                for entry in table.tables("semicircles", ("radius", "start_deg", "ink"), SEMICIRCLES_LIMIT)
            ),
            rim=rim.number("width", 0.0, 2.0, 0.0),
            rim_ink=rim.choice("ink", ("black", "white"), "white"),
            quiet_zone=table.number("quiet_zone", 0.0, 2.0, 0.0),
        )


def load_patch(path: str | Path) -> Patch:
    """Read one design.

    Raises
    ------
    DesignError
        If the file cannot be read, is not TOML, or does not describe a design.
    """
    return parse_patch(read_toml(path, DesignError), str(path))


def load_patches(paths: Sequence[str | Path]) -> tuple[Patch, ...]:
    """Read designs from TOML files.

    Parameters
    ----------
    paths : sequence of str or Path
        Files, or folders whose .toml files are read.

    Returns
    -------
    tuple of Patch
        The designs in the order of their ids.

    Raises
    ------
    DesignError
        If a file cannot be read, or has an unknown key or a wrong value. If two designs share an id. If a folder holds
        no design. The message names the file, the key and what was expected.

    Examples
    --------
    >>> from pathlib import Path
    >>> import kpbench
    >>> text = '''
    ... name = "half"
    ... id = 7
    ... semicircles = [{ start_deg = 0, ink = "black" }]
    ... '''
    >>> _ = Path("half.toml").write_text(text)
    >>> [patch.name for patch in kpbench.load_patches(["half.toml"])]
    ['half']
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
    """Return the four designs that ship with kpbench, in the order of their ids.

    Examples
    --------
    >>> import kpbench
    >>> [patch.name for patch in kpbench.shipped_patches()]
    ['checker', 'trefoil', 'wheel', 'mushroom']
    """
    return load_patches([shipped_folder("patches")])
