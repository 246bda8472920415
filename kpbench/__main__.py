"""``python -m kpbench`` is ``kpbench``."""

from kpbench.cli import run

if __name__ == "__main__":
    run()
