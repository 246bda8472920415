"""Some hundred broken files of every kind, by ``benchmarks/robustness/fuzz.py``; a whole run of it has 200,000.

``KNOWN`` lists causes that are not mended yet. A cause that is not in it fails the test.
"""

import json
import random
import re
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks" / "robustness"
INPUTS = 4000
KNOWN: dict[str, str] = {}
"""What is known and not mended yet: a pattern of what ``outcomes`` tell, and why. It shrinks as causes are mended."""


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    """What each reader made of its inputs: their number, and those that were neither accepted nor refused."""
    file = tmp_path_factory.mktemp("fuzz") / "outcomes.json"
    words = [sys.executable, str(FOLDER / "fuzz.py"), "--inputs", str(INPUTS), "--json", str(file)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert file.exists(), done.stderr
    return json.loads(file.read_text())


def test_every_reader_reads_a_hundred_inputs_of_which_half_get_past_the_header(outcomes):
    for name, reader in outcomes.items():
        assert reader["inputs"] >= 100, name
        assert reader["past_header"] >= 0.5, name


def test_no_input_gives_a_traceback_a_hang_a_crash_or_other_values(outcomes):
    found = [
        f"{name}: {bad['kind']}: {bad['cause']} (--only {name} --index {bad['index']})"
        for name, reader in outcomes.items()
        for bad in reader["bad"]
    ]
    assert not [line for line in found if not any(re.search(pattern, line) for pattern in KNOWN)]


def test_an_input_is_a_function_of_seed_reader_and_index(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    from fuzzing import seeds
    from fuzzing.readers import READERS

    for name in ("predictions-json", "predictions-csv", "predictions-h5", "coco", "board", "png", "gif"):
        reader, state = READERS[name], random.getstate()
        valid = reader.seeds()
        assert valid == reader.seeds(), f"the valid files of {name} differ from call to call"
        made = [reader.make(0, index, valid) for index in range(200)]
        assert [reader.make(0, index, valid) for index in reversed(range(200))] == made[::-1], name
        assert made != [reader.make(1, index, valid) for index in range(200)], name
        assert random.getstate() == state, f"{name} draws from the random numbers of all"
    assert seeds.predictions().image_id.tolist() == [1, 4, 7, 10, 13]
