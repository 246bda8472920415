"""``python -m kpbench`` is ``kpbench``."""

from kpbench.cli import main

if __name__ == "__main__":
    main(prog_name="kpbench")
