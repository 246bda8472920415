"""Conversion of networks to 8-bit integers."""

from __future__ import annotations

import json
import logging
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from kpbench.detectors.inference import import_onnxruntime, open_session, try_network
from kpbench.detectors.superpoint import SCALES, SCHEMA, pad_to_cells
from kpbench.errors import DataError, system_reason
from kpbench.files import read_bytes
from kpbench.images import resize
from kpbench.patches.design import parse_patch
from kpbench.training.batches import SampleConfig, load_photos, make_batch
from kpbench.training.export import Exported, largest_difference, require_onnx_target
from kpbench.writing import write_file


def export_int8(model: str | Path, out: str | Path) -> Exported:
    """Convert an exported network to 8-bit integers. The file shrinks to a quarter; a CPU runs it three times as fast.

    The ranges of the activations are measured on 40 synthetic scenes with procedural backgrounds. About half of the
    scenes are degraded. Each scene is resized to one of the detector's image scales.

    Parameters
    ----------
    model, out : path
        ONNX file of :func:`kpbench.training.export_onnx`, and the ONNX file to write.

    Returns
    -------
    Exported
        ``difference`` is measured on an image of noise: the largest difference between a logit of the new file and the
        same logit of the float32 network.

    Raises
    ------
    DataError
        If the file cannot be read, was not written by ``export_onnx``, or holds integers already.

    Examples
    --------
    >>> from kpbench.training import export_int8
    >>> export_int8("small.onnx", "small-int8.onnx").step  # doctest: +SKIP
    46875
    """
    import onnx

    require_onnx_target(out)
    try:
        data = read_bytes(model)
        try_network(data, str(model))
        given = onnx.load_from_string(data)
        content = json.loads({p.key: p.value for p in given.metadata_props}["kpbench"])
    except DataError:
        raise
    except Exception as error:  # protobuf raises errors of private classes
        why = system_reason(error) or (str(error) or type(error).__name__).splitlines()[0][:200]
        raise DataError(f"{model}: cannot be read as an ONNX file of kpbench export-model ({why})") from None
    if content.get("schema") != SCHEMA or "int8" in content:
        raise DataError(f"{model}: expected a float32 network of kpbench export-model")
    patches = [parse_patch(table, str(model)) for table in content["patches"]]
    textures = load_photos(None, "training")
    scenes = make_batch(SampleConfig("scenes", (640, 480)), patches, textures, 0, 0, 40, 0.5).images
    sizes = [(round(scale * 640), round(scale * 480)) for scale in SCALES]
    images = [pad_to_cells(resize(scene, *sizes[n % len(sizes)])) for n, scene in enumerate(scenes)]
    content["int8"] = f"uint8 activations, 7-bit weights, ranges of {len(images)} scenes"
    quantised = quantise(given, ({"image": np.float32(1 / 255) * image[None, None]} for image in images))
    onnx.helper.set_model_props(quantised, {"kpbench": json.dumps(content, sort_keys=True)})
    written = cast(bytes, quantised.SerializeToString())
    image = np.random.default_rng(0).random((1, 1, 72, 104), np.float32)
    difference = largest_difference(written, image, list(open_session(data)[0].run(None, {"image": image})))
    write_file(Path(out), written)
    return Exported(len(written), content["step"], difference)


def quantise(model: Any, feeds: Iterable[dict[str, NDArray[np.float32]]]) -> Any:
    """Return an ONNX model whose convolutions compute with 8-bit integers.

    The weights have only 7 bits. With 8 bits, sums of products would saturate on processors without VNNI.

    Parameters
    ----------
    model : onnx.ModelProto
    feeds : iterable of dict
        Inputs of the network on which the ranges of the activations are measured.
    """
    import_onnxruntime()
    import onnx
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

    class Reader(CalibrationDataReader):  # type: ignore[misc]
        def __init__(self) -> None:
            self.feeds = iter(feeds)

        def get_next(self) -> dict[str, NDArray[np.float32]] | None:
            return next(self.feeds, None)

    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "int8.onnx"
        logging.disable(logging.WARNING)  # hides the advice to preprocess the model; convolutions do not need this
        try:
            quantize_static(
                model,
                out,
                Reader(),
                quant_format=QuantFormat.QDQ,
                per_channel=True,
                reduce_range=True,
                activation_type=QuantType.QUInt8,
                weight_type=QuantType.QInt8,
                op_types_to_quantize=["Conv", "Relu", "MaxPool"],
            )
        finally:
            logging.disable(logging.NOTSET)
        return onnx.load(out)
