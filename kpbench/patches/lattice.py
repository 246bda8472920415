"""Fields of letters: boards on a square lattice whose windows of 3 x 3 patches tell their place.

A word is the letters of a window, read row by row in one of the four rotations of the window. In a field, all words
differ: those of different places, and those of one place in different rotations. The distance of a field is the least
number of letters in which two words differ (the Hamming distance).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kpbench.types import Float, Int

WINDOW = (3, 3)
EVEN_MM = 1e-3
"""Lengths that differ by less are the same."""
WORDS_AT_ONCE = 2**24
"""Pairs of words that are compared at a time."""


@dataclass(frozen=True, eq=False)
class Lattice:
    """A board whose patches lie on a full square lattice and are not rotated, and whose 3 x 3 windows all differ.

    Attributes
    ----------
    ids : ndarray of shape (R, C)
        ID of the patch in each row and column.
    points : ndarray of shape (R, C)
        Index of the keypoint.
    pitch : float
        Distance of neighbours, in disc radii.
    """

    ids: Int
    points: Int
    pitch: float

    @cached_property
    def alphabet(self) -> tuple[Int, Int]:
        """The different IDs, in rising order, and the number of the ID in each row and column, shape (R, C)."""
        ids, letter = np.unique(self.ids, return_inverse=True)
        return ids, letter.reshape(self.ids.shape)


def window_words(letters: Int, window: tuple[int, int] = WINDOW) -> Int:
    """Return the words of all windows of a field, ndarray of shape (n, places of a window).

    A window that is not square lies in both directions in the field. It is read in the two rotations in which it is as
    wide as the wider side.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.patches.lattice import window_words
    >>> window_words(np.array([[0, 1], [2, 3]]), (2, 2)).tolist()
    [[0, 1, 2, 3], [1, 3, 0, 2], [3, 2, 1, 0], [2, 0, 3, 1]]
    """
    found = [np.empty((0, window[0] * window[1]), letters.dtype)]
    for shape in dict.fromkeys([window, window[::-1]]):
        if letters.shape[0] < shape[0] or letters.shape[1] < shape[1]:
            continue
        views = np.lib.stride_tricks.sliding_window_view(letters, shape)
        for turn in range(4):
            turned = np.rot90(views, turn, axes=(2, 3))
            if turned.shape[3] == max(window):
                found.append(turned.reshape(-1, window[0] * window[1]))
    return np.concatenate(found)


def field_distance(letters: Int, window: tuple[int, int] = WINDOW) -> int:
    """Return the least number of letters in which two words of a field differ, by comparing all pairs of words.

    Parameters
    ----------
    letters : ndarray of shape (R, C)
        Letters by row and column.
    window : (int, int)
        Rows and columns of a window.

    Returns
    -------
    int
        0 if two words are equal. The number of places of a window if there are fewer than two words.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.patches import field_distance
    >>> field_distance(np.array([[0, 1, 1], [0, 0, 2]]), (2, 2)), field_distance(np.zeros((3, 4), int))
    (2, 0)
    """
    words = window_words(letters, window).astype(np.int8)
    places = window[0] * window[1]
    least, step = places, max(1, WORDS_AT_ONCE // max(1, words.size))
    for first in range(0, len(words), step):
        part, rest = words[first : first + step], words[first:]
        differ = np.zeros((len(part), len(rest)), np.int8)
        for k in range(places):
            differ += part[:, k, None] != rest[:, k]
        differ[np.arange(len(part)), np.arange(len(part))] = places
        least = min(least, int(differ.min()))
    return least


def find_lattice(points_mm: Float, ids: Int, rotate_deg: Float, diameter_mm: Float) -> Lattice | None:
    """Return the lattice of a board, or None if its patches are no field.

    Parameters
    ----------
    points_mm : ndarray of shape (N, 2)
        Centres of the patches.
    ids : ndarray of shape (N,)
        Their IDs.
    rotate_deg, diameter_mm : ndarray of shape (N,)
        Their rotations and diameters.
    """
    x, column = np.unique(points_mm[:, 0].round(3), return_inverse=True)
    y, row = np.unique(points_mm[:, 1].round(3), return_inverse=True)
    if len(x) * len(y) != len(ids) or min(len(x), len(y)) < WINDOW[0]:
        return None
    steps = np.concatenate([np.diff(x), np.diff(y)])
    if max(np.ptp(steps), np.ptp(diameter_mm), np.ptp(rotate_deg), abs(rotate_deg[0])) > 2 * EVEN_MM:
        return None
    points = np.full((len(y), len(x)), -1)
    points[row, column] = np.arange(len(ids))
    if points.min() < 0:
        return None
    words = window_words(ids[points])
    if len(np.unique(words, axis=0)) < len(words):
        return None
    return Lattice(ids[points], points, float(steps.mean() / (diameter_mm[0] / 2)))
