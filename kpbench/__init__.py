"""kpbench: design, print, synthesise, find and score keypoint patches.

The public names stand in ``__init__.pyi`` and are imported when they are first used: ``import kpbench`` loads neither
torch, h5py, onnxruntime, OpenCV nor pandas.

Examples
--------
>>> import kpbench
>>> [patch.name for patch in kpbench.shipped_patches()]
['checker', 'trefoil', 'wheel', 'mushroom']
"""

from typing import Any

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """Return a public name. The first use parses ``__init__.pyi``: the command line starts without it."""
    import lazy_loader

    this = globals()
    this["__getattr__"], this["__dir__"], this["__all__"] = lazy_loader.attach_stub(__name__, __file__)
    return this[name] if name in this else this["__getattr__"](name)


def __dir__() -> list[str]:
    return list(__getattr__("__all__"))
