"""Changes to files of networks: safetensors, the zip archives of torch, ONNX."""

from __future__ import annotations

import io
import json
import random
import zipfile
from typing import Any

from .texts import json_text
from .trees import NUMBERS, TEXTS, damage, mutate_tree

# --- Tensors -------------------------------------------------------------------------------------------------------


def mutate_safetensors(rng: random.Random, data: bytes) -> bytes:
    """Change the header of a safetensors file, what kpbench writes into it, or the tensors."""
    length = int.from_bytes(data[:8], "little")
    header, body = json.loads(data[8 : 8 + length]), data[8 + length :]
    kind = rng.random()
    if kind < 0.55:
        content = json.loads(header["__metadata__"]["kpbench"])
        header["__metadata__"]["kpbench"] = json_text(
            rng, mutate_tree(rng, content, ("step", "recipe", "network", "patches"))
        )
    elif kind < 0.85:
        few = {key: header[key] for key in rng.sample(sorted(header), 3)}
        changed = mutate_tree(rng, few)
        for key in few:
            del header[key]
        header |= changed if isinstance(changed, dict) else {"a": changed}
    elif kind < 0.92:
        body = damage(rng, body)
    packed = json_text(rng, header).encode(errors="surrogatepass")
    shown = (
        len(packed)
        if rng.random() < 0.95
        else rng.choice((0, 1, len(packed) - 1, len(packed) + 8, 2**31, 2**63, 10**9))
    )
    out = shown.to_bytes(8, "little") + packed + body
    return damage(rng, out) if rng.random() < 0.07 else out


def mutate_state_dict(rng: random.Random, data: bytes) -> bytes:
    """Change an entry of the zip archive that torch writes, mostly its pickle."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as given, zipfile.ZipFile(out, "w") as made:
        names = given.namelist()
        pickled = next(name for name in names if name.endswith("data.pkl"))
        target, kind = (pickled if rng.random() < 0.7 else rng.choice(names)), rng.randrange(8)
        for name in names:
            content = given.read(name)
            if name == target:
                content = damage(rng, content) if kind < 6 else content
            if name != target or kind != 6:
                made.writestr(zipfile.ZipInfo(name), content)
            if name == target and kind == 7:
                made.writestr(zipfile.ZipInfo(name[:-1] + "x"), rng.randbytes(20))
    return damage(rng, out.getvalue()) if rng.random() < 0.1 else out.getvalue()


# --- Protocol buffers ----------------------------------------------------------------------------------------------


def mutate_onnx(rng: random.Random, data: bytes) -> bytes:
    """Change fields of an ONNX model, above all the JSON that kpbench writes into it."""
    import onnx

    model = onnx.load_from_string(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        if rng.random() < 0.45 and model.metadata_props:
            entry = model.metadata_props[0]
            try:
                entry.value = (
                    json_text(rng, mutate_tree(rng, json.loads(entry.value), ("patches", "schema", "name")))
                    .encode(errors="replace")
                    .decode(errors="replace")
                )
            except ValueError:
                entry.value = ""
        else:
            _change_message(rng, model)
    out: bytes = model.SerializeToString()
    return damage(rng, out) if rng.random() < 0.12 else out


OPERATORS = (
    "Conv",
    "Relu",
    "MaxPool",
    "Loop",
    "If",
    "Identity",
    "Softmax",
    "Reshape",
    "Resize",
    "ConstantOfShape",
    "Nope",
)
EXTERNAL = ("/etc/passwd", "../x", "input.onnx", "/dev/zero")


def _change_message(rng: random.Random, model: Any) -> None:
    """Change one field of a message, somewhere in the model."""
    message = model
    while True:
        inner = []
        for field, value in message.ListFields():
            if field.message_type is not None:
                inner += list(value) if field.is_repeated else [value]
        if not inner or rng.random() < 0.12:
            break
        message = rng.choice(inner)
    fields = message.ListFields()
    if not fields:
        return
    if message.DESCRIPTOR.name == "TensorProto" and rng.random() < 0.15:
        message.data_location = 1
        message.external_data.add(key="location", value=rng.choice(EXTERNAL))
        message.external_data.add(key="length", value=rng.choice(("0", "100", "-1", "600000000", "99999999999999")))
        return
    field, value = rng.choice(fields)
    try:
        if field.is_repeated:
            _change_repeated(rng, message, field, value)
        elif field.message_type is not None or rng.random() < 0.08:
            message.ClearField(field.name)
        else:
            setattr(message, field.name, _odd_scalar(rng, field, value))
    except (ValueError, TypeError, OverflowError):
        message.ClearField(field.name)


def _odd_scalar(rng: random.Random, field: Any, value: Any) -> Any:
    if isinstance(value, str):
        odd = rng.choice((*OPERATORS, *TEXTS[:30], value + "x", value[:-1]))
        return odd.encode(errors="replace").decode(errors="replace")
    if isinstance(value, bytes):
        return damage(rng, value)
    if isinstance(value, bool):
        return not value
    number = rng.choice((*NUMBERS, value + 1, value - 1, -value, value * 2, *range(12)))
    return number if isinstance(value, float) else int(number)


def _change_repeated(rng: random.Random, message: Any, field: Any, value: Any) -> None:
    n, kind = rng.randrange(len(value)), rng.randrange(5)
    if kind == 0:
        del value[n]
    elif kind == 1:
        value.append(value[n])
    elif kind == 2:
        order = list(value)
        rng.shuffle(order)
        message.ClearField(field.name)
        getattr(message, field.name).extend(order)
    elif field.message_type is None:
        value[n] = _odd_scalar(rng, field, value[n])
    elif kind == 3:
        message.ClearField(field.name)
