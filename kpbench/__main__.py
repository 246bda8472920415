"""``python -m kpbench`` is ``kpbench``."""

import os
import sys

if __name__ == "__main__":
    if not sys.flags.safe_path:
        # Python puts the current folder first; a file in it must not stand for a package that kpbench imports
        current = sys.path.pop(0)
        if os.path.dirname(os.path.dirname(__file__)) == current:  # kpbench itself lies there
            sys.path.append(current)

    from kpbench.cli import run

    run()
