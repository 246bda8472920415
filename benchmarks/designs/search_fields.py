"""Search a patch field: letters 0 to 3 by rows and columns, whose windows all differ in many letters.

The words of a field are its windows as read in each of four rotations. Any two words of different places, and any two
rotations of one place, differ in at least ``--distance`` letters. The search fills the field row by row. Where no
letter fits, it takes back the last letters, and more of them each time in vain. It stops after
``--steps``, and writes the rows that are complete. The same seed and steps give the same field.

The shipped fields are the output of these, each with ``--out FILE.txt``:

    python benchmarks/designs/search_fields.py --distance 5 --rows 6 --columns 6 --steps 200000 --seed 0
    python benchmarks/designs/search_fields.py --distance 4 --rows 12 --columns 8 --steps 600000 --seed 2
    python benchmarks/designs/search_fields.py --distance 3 --rows 24 --columns 16 --steps 400000 --seed 0
    python benchmarks/designs/search_fields.py --distance 2 --rows 60 --columns 50 --steps 60000 --seed 0
    python benchmarks/designs/search_fields.py --window 2x2 --distance 1 --rows 8 --columns 8 --steps 20000
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np


def words_of(window: np.ndarray) -> list[np.ndarray]:
    """Return a window as it is read in the rotations of its shape, each as a row of letters."""
    turned = [np.rot90(window, k) for k in range(4)]
    wide = max(window.shape)
    return [t.ravel() for t in turned if t.shape[1] == wide]


class Search:
    """A field that is being filled, and the words of its complete windows."""

    def __init__(self, shape: tuple[int, int], window: tuple[int, int], distance: int, seed: int) -> None:
        self.field = np.full(shape, -1, np.int8)
        self.shapes = list(dict.fromkeys([window, window[::-1]]))
        self.distance = distance
        self.rng = np.random.default_rng(seed)
        self.words = np.empty((4 * len(self.shapes) * shape[0] * shape[1] + 8, window[0] * window[1]), np.int8)
        self.count = 0
        self.counts = np.zeros(shape[0] * shape[1] + 1, np.int64)  # words before each cell was filled

    def fits(self, row: int, column: int) -> bool:
        """Add the words of the windows that end at a cell. Return False, and add none, if they are too near."""
        first = self.count
        for height, width in self.shapes:
            if row < height - 1 or column < width - 1:
                continue
            words = words_of(self.field[row - height + 1 : row + 1, column - width + 1 : column + 1])
            for word in words:
                if self.count and (self.words[: self.count] != word).sum(axis=1).min() < self.distance:
                    self.count = first
                    return False
                self.words[self.count] = word
                self.count += 1
        return True

    def run(self, steps: int) -> int:
        """Fill the field. Return the number of complete rows: the most that were reached."""
        rows, columns = self.field.shape
        cell, best, failures, deepest = 0, self.field.copy(), 0, 0
        for _ in range(steps):
            if cell == rows * columns:
                break
            row, column = divmod(cell, columns)
            self.counts[cell] = self.count
            for letter in self.rng.permutation(4):
                self.field[row, column] = letter
                if self.fits(row, column):
                    cell += 1
                    break
            else:
                failures += 1
                back = min(cell, 1 + int(self.rng.geometric(1 / (1 + min(failures / 50, 3.0 * columns)))))
                cell -= back
                self.count = int(self.counts[cell])
            if cell > deepest:
                deepest, best, failures = cell, self.field.copy(), 0
        self.field = best
        return deepest // columns


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--window", default="3x3")
    parser.add_argument("--distance", type=int, required=True)
    parser.add_argument("--rows", type=int, required=True)
    parser.add_argument("--columns", type=int, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    height, width = map(int, args.window.split("x"))
    search = Search((args.rows, args.columns), (height, width), args.distance, args.seed)
    rows = search.run(args.steps)
    args.out.write_text("".join("".join(map(str, row)) + "\n" for row in search.field[:rows].tolist()))
    print(f"{args.out}: {rows} of {args.rows} rows of {args.columns}")


if __name__ == "__main__":
    main()
