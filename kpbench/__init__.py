"""kpbench: design, print, synthesise, find and score keypoint patches.

``__init__.pyi`` lists the public names. Each name is imported at its first use: ``import kpbench`` alone loads none of
torch, h5py, onnxruntime, OpenCV and pandas.

Examples
--------
>>> import kpbench
>>> [patch.name for patch in kpbench.shipped_patches()]
['checker', 'trefoil', 'wheel', 'mushroom']
"""

import os  # loaded before any file of a current folder can be

__version__ = "0.1.0"
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", "200000000")  # OpenCV reads the limit when it is loaded


def __getattr__(name: str) -> object:
    """Return a public name. Only the first use parses ``__init__.pyi``, so that the command line starts faster."""
    # this file imports nothing at its start: `python -m kpbench` runs it while the current folder is on sys.path
    import lazy_loader

    this = globals()
    this["__getattr__"], this["__dir__"], this["__all__"] = lazy_loader.attach_stub(__name__, __file__)
    return this[name] if name in this else this["__getattr__"](name)


def __dir__() -> list[str]:
    return list(__getattr__("__all__"))
