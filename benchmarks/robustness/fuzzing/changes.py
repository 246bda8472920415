"""Changes to files that are made with the help of others: JSON, TOML, JSON lines, Parquet, GIF."""

from __future__ import annotations

import io
import json
import random
from collections.abc import Callable

from .texts import finish_text, json_text, mutate_json, mutate_toml, toml_text
from .trees import damage, mutate_tree

Change = Callable[[random.Random, bytes], bytes]


def of_json(*often: str) -> Change:
    """Change a JSON file, more often the values of some keys."""
    return lambda rng, data: mutate_json(rng, json.loads(data), often)


def of_toml(*often: str) -> Change:
    """Change a TOML file, more often the values of some keys."""
    return lambda rng, data: mutate_toml(rng, json.loads(data), often)


def toml_of(data: bytes) -> bytes:
    """The TOML of a tree that is kept as JSON."""
    return toml_text(random.Random(0), json.loads(data)).encode()


def change_jsonl(rng: random.Random, data: bytes) -> bytes:
    records = [json.loads(line) for line in data.splitlines()]
    if rng.random() < 0.9:
        n = rng.randrange(len(records)) if rng.random() < 0.75 else 0
        records[n] = mutate_tree(rng, records[n], ("image_id", "ids", "scores"))
    if rng.random() < 0.15:
        records.insert(rng.randrange(len(records) + 1), rng.choice(records))
    lines = [json_text(rng, record).replace("\n", " ") for record in records]
    end = rng.choice((*["\n"] * 12, "\r\n", "\n\n", "\r", " \n"))
    return finish_text(rng, end.join([*lines, *([""] if rng.random() < 0.8 else [])]))


def change_parquet(rng: random.Random, data: bytes) -> bytes:
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.ParquetFile(io.BytesIO(data)).read(use_threads=False)
    columns, metadata = {name: table.column(name) for name in table.column_names}, dict(table.schema.metadata)
    kinds = (pa.int8, pa.int32, pa.int64, pa.uint64, pa.float16, pa.float32, pa.float64, pa.string, pa.bool_, pa.binary)
    others = (
        pa.date32(),
        pa.timestamp("us"),
        pa.decimal128(20, 3),
        pa.list_(pa.float64()),
        pa.dictionary(pa.int8(), pa.string()),
    )
    for _ in range(rng.choice((1, 1, 2))):
        name = rng.choice(list(columns))
        values = columns[name].to_pylist()
        kind = rng.randrange(8)
        if kind <= 2:
            to = rng.choice((*(make() for make in kinds), *others))
            odd = rng.random() < 0.3
            cast = (
                str
                if to in (pa.string(), pa.binary())
                else bool
                if to == pa.bool_()
                else float
                if pa.types.is_floating(to)
                else int
            )
            columns[name] = pa.array(
                [
                    None if v is None else 2**63 + n if odd and to == pa.uint64() else cast(v)
                    for n, v in enumerate(values)
                ],
                to,
            )
        elif kind <= 4:
            changed = mutate_tree(rng, values)
            columns[name] = pa.array(changed if len(changed) == len(values) else (changed + values)[: len(values)])
        elif kind == 5 and b"kpbench" in metadata:
            metadata[b"kpbench"] = mutate_json(rng, json.loads(metadata[b"kpbench"]))
        elif kind == 6:
            values[rng.randrange(len(values))] = rng.choice((None, float("nan"), 0, -1, 2**53 + 1, 1e300))
            columns[name] = pa.array(values)
        else:
            columns[rng.choice(("id", "score", "z", name + " ", ""))] = columns.pop(name)
    packed = ("none", "snappy", "gzip", "zstd", "lz4", "brotli")
    out = io.BytesIO()
    pq.write_table(
        pa.table(columns).replace_schema_metadata(metadata), out, compression=rng.choice(packed),
        row_group_size=rng.choice((None, 1, 3)), use_dictionary=rng.random() < 0.5,
        data_page_version=rng.choice(("1.0", "2.0")),
    )  # fmt: skip
    raw = out.getvalue()
    kind = rng.random()
    footer = len(raw) - 8 - int.from_bytes(raw[-8:-4], "little")
    return damage(rng, raw, 4, footer) if kind < 0.2 else damage(rng, raw, footer) if kind < 0.3 else raw


def change_header(rng: random.Random, data: bytes) -> bytes:
    """Change bytes of an image that has no parts, mostly the first ones."""
    return damage(rng, data, rng.choice((2, 16, 30)), rng.choice((60, 120, None)))


def change_film(rng: random.Random, data: bytes) -> bytes:
    """Change bytes of a Matroska or WebM file, mostly in its headers."""
    return damage(rng, data, rng.choice((0, 40, 400)), rng.choice((200, 600, None)))


def change_gif(rng: random.Random, data: bytes) -> bytes:
    """Change the screen, the blocks or the pixels of a GIF, and not its colours."""
    table = 13 + 3 * 2 ** ((data[10] & 7) + 1) if data[10] & 128 else 13
    low, high = rng.choice(((6, 13), (table, table + 40), (table, None)))
    return damage(rng, data, low, high)
