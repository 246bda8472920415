"""Run the networks of ONNX files, with ONNX Runtime or with OpenVINO."""

from __future__ import annotations

import io
import os
import threading
from collections.abc import Sequence
from functools import cache
from typing import Any, Protocol

import cv2
import numpy as np

from kpbench.errors import DataError
from kpbench.types import Float32

RUNTIMES = ("auto", "cpu", "cuda", "openvino")
"""Values of the environment variable ``KPBENCH_RUNTIME``, see :func:`open_session`."""


TRIAL_PX, TRIAL_BYTES, TRIAL_SECONDS = 256, 2**29, 10.0
"""A network of the user's is tried on an image of this side, px, within this memory, bytes, and this time, s."""


class InferenceSession(Protocol):
    """A network that is ready to run: ONNX Runtime's ``InferenceSession``, or :class:`OpenVinoSession`."""

    def run(self, outputs: None, feed: dict[str, Float32], /) -> Sequence[Float32]:
        """Return all outputs of the network; ``feed`` maps the name of each input to its values."""
        ...


class OpenVinoSession:
    """A network that OpenVINO has compiled for the processor."""

    def __init__(self, model: bytes, threads: int) -> None:
        import openvino

        core, settings = openvino.Core(), {"INFERENCE_NUM_THREADS": threads, "INFERENCE_PRECISION_HINT": "f32"}
        self._compiled = core.compile_model(core.read_model(io.BytesIO(model)), "CPU", settings)

    def run(self, outputs: None, feed: dict[str, Float32], /) -> Sequence[Float32]:
        """Return all outputs of the network; ``feed`` maps the name of each input to its values."""
        results = self._compiled(feed)
        return [np.array(results[output]) for output in self._compiled.outputs]


def import_onnxruntime() -> Any:
    """Import ONNX Runtime and return the module.

    The environment variable keeps the library from sending telemetry over the network and from writing the number of a
    device into the user's cache.
    """
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    import onnxruntime

    return onnxruntime


def runs_on_gpu() -> bool:
    """Return whether :func:`open_session` runs networks on CUDA."""
    onnxruntime = import_onnxruntime()
    return _requested_runtime() in ("auto", "cuda") and "CUDAExecutionProvider" in onnxruntime.get_available_providers()


def _requested_runtime() -> str:
    runtime = os.environ.get("KPBENCH_RUNTIME", "auto")
    if runtime not in RUNTIMES:
        raise DataError(f"KPBENCH_RUNTIME is {runtime!r}, expected one of: {', '.join(RUNTIMES)}")
    return runtime


@cache
def _limit_allocator() -> None:
    """Make an allocator of at most ``TRIAL_BYTES``. Only sessions that ask for it use it."""
    onnxruntime = import_onnxruntime()
    kind, memory = onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, onnxruntime.OrtMemType.DEFAULT
    place = onnxruntime.OrtMemoryInfo("Cpu", kind, 0, memory)
    onnxruntime.create_and_register_allocator(place, onnxruntime.OrtArenaCfg(TRIAL_BYTES, -1, -1, -1))


def try_network(model: bytes, name: str, given: dict[str, Float32] | None = None) -> None:
    """Run a network of unknown origin once on small inputs, within limits. A small file may declare any work.

    ``name`` : name of the file, for the message. ``given`` : the inputs. None: one small image.

    Raises
    ------
    DataError
        If the network needs more memory or time than the limits, or cannot be run.
    Exception
        ONNX Runtime's own, if the file is no network.
    """
    onnxruntime = import_onnxruntime()
    _limit_allocator()
    options, run = onnxruntime.SessionOptions(), onnxruntime.RunOptions()
    options.intra_op_num_threads, options.log_severity_level, run.log_severity_level = 1, 4, 4
    options.add_session_config_entry("session.use_env_allocators", "1")
    loaded, problem = list[Any](), list[Exception]()

    def try_once() -> None:
        try:
            loaded.append(onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"]))
            loaded[0].run(None, given or {"image": np.zeros((1, 1, TRIAL_PX, TRIAL_PX), np.float32)}, run)
        except Exception as error:  # ONNX Runtime raises classes of its own, which are not public
            problem.append(error)

    thread = threading.Thread(target=try_once, daemon=True)
    thread.start()
    thread.join(TRIAL_SECONDS)
    is_slow, run.terminate = thread.is_alive(), True
    if problem and not loaded:
        raise problem[0]
    if is_slow or problem:
        reason = "it takes longer" if is_slow else str(problem[0]).splitlines()[0][:200]
        raise DataError(
            f"{name}: cannot be run on {TRIAL_PX} x {TRIAL_PX} pixels within {TRIAL_BYTES >> 20} MiB and "
            f"{TRIAL_SECONDS:g} s ({reason})"
        )


def open_session(model: bytes, threads: int = 0) -> tuple[InferenceSession, str]:
    """Make a network ready to run.

    The environment variable ``KPBENCH_RUNTIME`` chooses the runtime: "auto" (ONNX Runtime, on CUDA where the installed
    package supports it), "cpu", "cuda", or "openvino".

    Parameters
    ----------
    model : bytes
        Content of an ONNX file.
    threads : int
        Number of threads. 0 means the number of OpenCV's threads, which is 1 in a worker process.

    Returns
    -------
    session : InferenceSession
    metadata : str
        Text that kpbench wrote into the file; "" if the file has no such text.

    Raises
    ------
    DataError
        If ``KPBENCH_RUNTIME`` is not one of :data:`RUNTIMES`, or names a runtime that is not installed.
    """
    onnxruntime = import_onnxruntime()
    runtime = _requested_runtime()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads or cv2.getNumThreads()
    options.log_severity_level = 3
    # by default, idle threads spin, which takes processor time from other processes
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    if runtime == "cuda" and not runs_on_gpu():
        raise DataError("KPBENCH_RUNTIME is 'cuda', but this ONNX Runtime has no CUDA: install onnxruntime-gpu")
    providers: list[str | tuple[str, dict[str, str]]] = ["CPUExecutionProvider"]
    if runs_on_gpu():  # cuDNN's default search would time all algorithms for every new size of image
        providers.insert(0, ("CUDAExecutionProvider", {"cudnn_conv_algo_search": "HEURISTIC"}))
    session = onnxruntime.InferenceSession(model, options, providers=providers)
    metadata = session.get_modelmeta().custom_metadata_map.get("kpbench", "")
    if runtime != "openvino":
        return session, metadata
    try:
        return OpenVinoSession(model, threads or cv2.getNumThreads()), metadata
    except ModuleNotFoundError:
        raise DataError(
            "KPBENCH_RUNTIME is 'openvino', but OpenVINO is not installed: pip install 'kpbench[openvino]'"
        ) from None
