"""What runs a network of an ONNX file: ONNX Runtime, or OpenVINO."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from typing import Protocol

import cv2
import numpy as np

from kpbench.errors import DataError
from kpbench.types import Float32


class Session(Protocol):
    """What runs a network: ONNX Runtime's ``InferenceSession``, or :class:`OpenVinoSession`."""

    def run(self, outputs: None, feed: dict[str, Float32], /) -> Sequence[Float32]:
        """All outputs for an input by name."""
        ...


class OpenVinoSession:
    """A network compiled by OpenVINO for the processor."""

    def __init__(self, model: bytes, threads: int) -> None:
        import openvino

        core, settings = openvino.Core(), {"INFERENCE_NUM_THREADS": threads, "INFERENCE_PRECISION_HINT": "f32"}
        self._compiled = core.compile_model(core.read_model(io.BytesIO(model)), "CPU", settings)

    def run(self, outputs: None, feed: dict[str, Float32], /) -> Sequence[Float32]:
        """All outputs for an input by name."""
        results = self._compiled(feed)
        return [np.array(results[output]) for output in self._compiled.outputs]


RUNTIMES = ("auto", "cpu", "cuda", "openvino")


def on_gpu() -> bool:
    """Whether networks run on CUDA here (see :func:`open_session`)."""
    import onnxruntime

    return _asked() in ("auto", "cuda") and "CUDAExecutionProvider" in onnxruntime.get_available_providers()


def _asked() -> str:
    asked = os.environ.get("KPBENCH_RUNTIME", "auto")
    if asked not in RUNTIMES:
        raise DataError(f"KPBENCH_RUNTIME is {asked!r}, expected one of: {', '.join(RUNTIMES)}")
    return asked


def open_session(model: bytes, threads: int = 0) -> tuple[Session, str]:
    """A session for an ONNX model, and the text that kpbench wrote into the model, or "".

    The environment variable ``KPBENCH_RUNTIME`` chooses: "auto" (ONNX Runtime, on CUDA where the installed
    package has it), "cpu", "cuda", or "openvino". 0 threads means as many as OpenCV may use: one in worker processes.

    Raises
    ------
    DataError
        If that runtime is not there.
    """
    import onnxruntime

    asked = _asked()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads or cv2.getNumThreads()
    options.log_severity_level = 3
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # threads that wait take time from others
    if asked == "cuda" and not on_gpu():
        raise DataError("KPBENCH_RUNTIME is 'cuda', but this ONNX Runtime has no CUDA: install onnxruntime-gpu")
    providers: list[str | tuple[str, dict[str, str]]] = ["CPUExecutionProvider"]
    if on_gpu():  # its default tries out all algorithms for every new size of input
        providers.insert(0, ("CUDAExecutionProvider", {"cudnn_conv_algo_search": "HEURISTIC"}))
    session = onnxruntime.InferenceSession(model, options, providers=providers)
    content = session.get_modelmeta().custom_metadata_map.get("kpbench", "")
    if asked != "openvino":
        return session, content
    try:
        return OpenVinoSession(model, threads or cv2.getNumThreads()), content
    except ModuleNotFoundError:
        raise DataError("KPBENCH_RUNTIME is 'openvino': pip install 'kpbench[openvino]'") from None
