"""Fields in detections: the place of each lattice of detections in a field, and the probability of this place.

A lattice is compared with the field in four rotations and at every place where they overlap. Every letter counts as
evidence: a letter that is read as it should be, one that is read wrongly, or a false alarm. The probability of a place
is Bayes' rule over all places and over the case that the letters are not those of the field at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from kpbench.boards.candidates import determinants
from kpbench.boards.field_lattice import QUARTERS, Piece, find_pieces
from kpbench.boards.frames import Frames, frame_errors
from kpbench.patches.board import Board
from kpbench.patches.lattice import Lattice
from kpbench.types import Float, Int

WRONG_LETTER, OUTSIDE = 0.1, 0.01
"""Probability that a patch is read as another letter, and that a detection on the lattice is none of the field's."""
OTHER_LETTERS = 0.02
"""Probability that a lattice is not that of the field."""
RIGHT_ORIENTATION = 0.9
"""Probability that the orientation of most patches is right. Blur turns mushrooms, all of an image alike."""
LEAST_PROBABILITY = 0.999
"""Least probability of a place that is sure."""
OFF_WRONG_LETTER = 0.5
"""Largest distance of a patch that is read as another letter, as a part of that of other patches."""
SAME_SHEET = 1.0
"""Largest distance between two lattices of one bent sheet, as either predicts the other, in pitches."""


@dataclass(frozen=True)
class FieldMatch:
    """Detections and their places in a field.

    ``rows`` (m,) are detections, ``points`` (m,) the board's keypoints, ``turn`` (m, 2, 2) the rotations that leave
    their designs unchanged and bring the frames into the board's orientation. ``evidence`` is the logarithm of the
    probability of the letters at this place, and of the place before the letters are seen, up to a constant that all
    fields share.
    """

    rows: Int
    points: Int
    turn: Float
    agrees: NDArray[np.bool_]
    probability: float
    evidence: float
    H: Float


def match_field(frames: Frames, patch_id: Int, board: Board, lattice: Lattice, limit: float) -> list[FieldMatch]:
    """Return the places of detections in a field: one match per copy of the field, the most points first.

    Parameters
    ----------
    frames : Frames
    patch_id : ndarray of shape (n,)
    board : Board
    lattice : Lattice
        That of the board.
    limit : float
        Largest distance of a detection from its point, in disc radii.
    """
    ids, letter = lattice.alphabet
    read = np.searchsorted(ids[:-1], patch_id)
    usable = np.isfinite(frames.xy[:, 0]) & (determinants(frames.A) > 0) & (ids[read] == patch_id)
    index = np.flatnonzero(usable)
    if not len(index):
        return []
    designs = board.patches
    errors = np.array([frame_errors(patch) for patch in designs])
    order = np.array([patch.symmetry_order for patch in designs])
    read = read[index]
    scale, shape = np.asarray(errors[read].T, np.float64)
    frames = frames[index]
    found = list[FieldMatch]()
    for piece in find_pieces(frames, lattice.pitch, scale, shape, limit):
        quarter, shift, probability, evidence = _place(piece, read, order, letter)
        cell = piece.cell @ QUARTERS[quarter].T + shift
        inside = ((cell >= 0) & (cell < letter.shape[::-1])).all(axis=1)
        right = np.zeros(len(cell), bool)
        right[inside] = letter[cell[inside, 1], cell[inside, 0]] == read[piece.rows[inside]]
        kept = inside & (right | (piece.off <= OFF_WRONG_LETTER * limit))
        if not kept.any():
            continue
        rows = piece.rows[kept]
        to_lattice = np.eye(3)
        to_lattice[:2, :2] = QUARTERS[-quarter % 4]
        to_lattice[:2, 2] = -QUARTERS[-quarter % 4] @ shift * lattice.pitch
        turns = (piece.quarter[kept] + quarter) % 4  # of the frames on the board
        is_turned = turns * order[read[rows]] % 4 == 0
        found.append(
            FieldMatch(
                index[rows],
                lattice.points[cell[kept, 1], cell[kept, 0]],
                np.where(is_turned[:, None, None], QUARTERS[-turns % 4], QUARTERS[0]).astype(float),
                piece.fits[kept] & right[kept] & is_turned,
                probability,
                evidence,
                piece.H @ to_lattice,
            )
        )
    return _join(found, board, lattice, index, frames)


def _place(piece: Piece, read: Int, order: Int, letter: Int) -> tuple[int, Int, float, float]:
    """Return the most probable rotation of a piece, the shift (column, row) of its cells, probability and evidence."""
    rows, columns = letter.shape
    seen = read[piece.rows]
    hit, miss, outside = np.log([1 - WRONG_LETTER, WRONG_LETTER / (order.size - 1), OUTSIDE])
    table = np.where(letter == np.arange(order.size)[:, None, None], hit, miss) - outside
    table = table.astype(np.float32)  # transforms are fast, and evidence is exact to 0.001
    cells = piece.cell @ QUARTERS.transpose(0, 2, 1)  # (4, m, 2)
    least = cells.min(axis=1)
    cells = cells - least[:, None]
    width, height = (cells.max(axis=(0, 1)) + 1).tolist()
    size = (rows + height - 1, columns + width - 1)
    fast = [scipy.fft.next_fast_len(length, real=True) for length in size]
    mask = np.zeros((4, order.size, *fast), np.float32)
    mask[np.arange(4)[:, None], seen, cells[..., 1], cells[..., 0]] = 1.0
    spectrum = np.conj(scipy.fft.rfft2(mask)) * scipy.fft.rfft2(table, fast)
    evidence = scipy.fft.irfft2(spectrum.sum(axis=1), fast)
    places = [
        np.r_[:field, length - rest : length]
        for field, length, rest in zip((rows, columns), fast, (height - 1, width - 1), strict=True)
    ]
    evidence = evidence[:, places[0][:, None], places[1]]
    evidence += _orientation_evidence(piece, seen, order)[:, None, None]
    prior = np.log((1 - OTHER_LETTERS) / evidence.size)
    none = np.log(OTHER_LETTERS) + len(seen) * (np.log(1 / order.size) - outside)
    best = int(evidence.argmax())
    total = np.exp(np.minimum(evidence - evidence.flat[best], 0.0)).sum()
    probability = 1 / float(total + np.exp(min(none - prior - evidence.flat[best], 700.0)))
    quarter, y, x = (int(v) for v in np.unravel_index(best, evidence.shape))
    shift = np.array([x - size[1] if x >= columns else x, y - size[0] if y >= rows else y])
    return quarter, shift - least[quarter], probability, float(evidence.flat[best] + prior)


def _orientation_evidence(piece: Piece, seen: Int, order: Int) -> Float:
    """Return the logarithms of the probabilities of the four rotations of a piece, by the orientation of its patches.

    A frame of ``quarter`` q stands upright if the piece is rotated by -q.
    """
    told = piece.fits & (order[seen] == 1)
    votes = np.bincount(-piece.quarter[told] % 4, minlength=4)
    evidence = np.full(4, np.log((1 - RIGHT_ORIENTATION) / 3))
    if told.any():
        evidence[votes.argmax()] = np.log(RIGHT_ORIENTATION)
    return evidence


def _join(found: list[FieldMatch], board: Board, lattice: Lattice, index: Int, frames: Frames) -> list[FieldMatch]:
    """Join the lattices of one bent sheet: those that predict each other and share no point."""
    if len(found) < 2:
        return found
    radius_mm = board.keypoints[0].diameter_mm / 2
    origin = board.points_mm[lattice.points[0, 0], :2]
    joined = list[FieldMatch]()
    for match in sorted(found, key=lambda m: -len(m.rows)):
        is_sure = match.probability >= LEAST_PROBABILITY
        for n, other in enumerate(joined):
            if not is_sure or other.probability < LEAST_PROBABILITY or np.isin(match.points, other.points).any():
                continue
            X = (board.points_mm[match.points, :2] - origin) / radius_mm
            near = np.argmin(
                ((X[:, None] - (board.points_mm[other.points, :2] - origin) / radius_mm) ** 2).sum(2).min(1)
            )
            seen = other.H @ np.append(X[near], 1.0)
            detection = int(np.searchsorted(index, match.rows[near]))
            off = np.linalg.inv(frames.A[detection]) @ (frames.xy[detection] - seen[:2] / seen[2])
            if seen[2] > 0 and np.hypot(*off) <= SAME_SHEET * lattice.pitch:
                joined[n] = FieldMatch(
                    np.concatenate([other.rows, match.rows]),
                    np.concatenate([other.points, match.points]),
                    np.concatenate([other.turn, match.turn]),
                    np.concatenate([other.agrees, match.agrees]),
                    min(other.probability, match.probability),
                    other.evidence + match.evidence,
                    other.H,
                )
                break
        else:
            joined.append(match)
    return sorted(joined, key=lambda m: -len(m.rows))
