import json
import os
import signal
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from kpbench.detectors.superpoint import SuperPointDetector
from kpbench.errors import DataError
from kpbench.files import PACKAGE, protect_read_files
from kpbench.patches.design import shipped_patches
from kpbench.training import loop
from kpbench.training.batches import Batch, SampleConfig
from kpbench.training.checkpoint import load_mean_network, read_checkpoint, start_state
from kpbench.training.export import export_onnx
from kpbench.training.loop import TrainOptions, train
from kpbench.training.process_group import ProcessGroup
from kpbench.training.recipe import LossConfig, NetworkConfig, Phase, Recipe, load_recipe, parse_recipe
from kpbench.training.step import train_step
from kpbench.training.validation import validate_network
from kpbench.training.weights import read_initial_weights

CONFIGS = Path(__file__).parents[2] / "configs"
TINY = NetworkConfig(widths=(4, 4, 8, 8), depths=(1, 1, 1, 1), down="stride", head_width=8, descriptor_width=8)
PATCHES = shipped_patches()
ALONE = ProcessGroup(0, 1, torch.device("cpu"))
RECIPE = Recipe("tiny", (Phase(16), Phase(16, severity=(0.0, 1.0))), network=TINY, batch=4, ema=0.9)


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """Three small photographs: the first is kept for validation."""
    folder = tmp_path_factory.mktemp("photos")
    for n in range(3):
        texture = np.random.default_rng(n).integers(0, 256, (48, 64), np.uint8)
        cv2.imwrite(str(folder / f"{n}.png"), cv2.GaussianBlur(texture, (0, 0), 2))
    return folder


@pytest.fixture
def run(photos):
    def call(recipe, out, patches=PATCHES, say=lambda line: None, **options):
        options = TrainOptions(**{"workers": 0, "validation_images": 1} | options)
        return train(recipe, out, photos, patches=patches, options=options, say=say)

    return call


def tensors(folder):
    return load_file(folder / "checkpoint.safetensors")


def same(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


@pytest.fixture
def stop_after(monkeypatch):
    """Make the loop stop by itself after so many steps, as ``minutes`` would."""

    def arm(steps):
        count = iter(range(1, 10**6))
        monkeypatch.setattr(ProcessGroup, "any_of", lambda group, stop: stop or next(count) == steps)

    return arm


@pytest.mark.parametrize("optimizer", ["adam", "adamw"])
def test_interrupted_and_resumed_equals_undisturbed_to_the_bit(tmp_path, run, stop_after, optimizer):
    recipe = replace(RECIPE, optimizer=optimizer, schedule="step", decay_at=(12,), decay=0.2)
    assert run(recipe, tmp_path / "whole")
    stop_after(3)
    assert not run(recipe, tmp_path / "parts")
    assert not same(tensors(tmp_path / "whole"), tensors(tmp_path / "parts"))
    with protect_read_files():  # as the command does; the checkpoint that is read is replaced
        assert run(recipe, tmp_path / "parts", resume=True)
    assert same(tensors(tmp_path / "whole"), tensors(tmp_path / "parts"))


def test_the_minutes_hold_the_last_validation_and_a_bar_shows_them(tmp_path, run, monkeypatch, capsys):
    monkeypatch.setattr(loop, "estimate_validation_s", lambda network, sets: 3600.0)  # no time is left for training
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert not run(RECIPE, tmp_path, minutes=60.0)
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [1, 1]
    assert "clean_found_3px" in lines[-1]
    bar = capsys.readouterr().err
    assert "train" in bar
    assert "step 1, loss" in bar
    assert run(RECIPE, tmp_path, resume=True)


@pytest.mark.parametrize(
    ("head_width", "line"),
    [
        (128, "30 tensors matched; not in it: nothing"),
        (
            144,
            "30 tensors matched; not in it: nothing; grown into another network, convolutions added: 0, left out: 0",
        ),
    ],
)
def test_shipped_weights_are_trained_on_from_what_they_find(tmp_path, run, head_width, line):
    recipe = replace(load_recipe(CONFIGS / "reference.toml"), batch=4, lr=1e-12)
    recipe = replace(recipe, phases=(Phase(4, "attached"),))  # one step that leaves everything as it is
    recipe = replace(recipe, network=replace(recipe.network, head_width=head_width))
    lines = []
    assert run(recipe, tmp_path, init="superpoint-small", say=lines.append)
    assert lines == [f"superpoint-small: {line}"]
    content, tensors = read_checkpoint(tmp_path / "checkpoint.safetensors")
    detector = SuperPointDetector(PACKAGE / "detectors" / "weights" / "superpoint-small.onnx")  # not in 8 bits
    images = np.random.default_rng(0).integers(0, 256, (2, 64, 72), np.uint8)
    with torch.inference_mode():
        ours = load_mean_network(content, tensors)(torch.from_numpy(images)[:, None].float() / 255)
    for mine, theirs in zip(ours, detector.heads(list(images)), strict=True):
        assert np.abs(mine.numpy() - theirs).max() < 1e-3


def test_other_designs_leave_out_the_id_head_of_an_exported_file():
    weights, _ = read_initial_weights("superpoint-small", shipped_patches()[::-1])
    assert "descriptor_attached.weight" not in weights
    with pytest.raises(DataError, match="cannot be read as an ONNX model"):
        read_initial_weights(Path(__file__).with_suffix(".onnx"), shipped_patches())


def test_a_checkpoint_is_trained_on_grown_and_for_other_designs_without_its_id_head(tmp_path, run):
    run(RECIPE, tmp_path / "first")
    first = tmp_path / "first" / "checkpoint.safetensors"
    lines = []
    run(RECIPE, tmp_path / "same", init=first, say=lines.append)
    run(RECIPE, tmp_path / "others", init=first, say=lines.append, patches=shipped_patches()[::-1])
    run(replace(RECIPE, network=replace(TINY, head_width=16)), tmp_path / "wider", init=first, say=lines.append)
    assert [line.removeprefix(f"{first}: ") for line in lines] == [
        "52 tensors matched; not in it: nothing",
        "50 tensors matched; not in it: descriptor_attached",
        "52 tensors matched; not in it: nothing; grown into another network, convolutions added: 0, left out: 0",
    ]


def test_an_exported_file_whose_batchnorm_is_lost_is_refused(tmp_path, run):
    after = replace(RECIPE, network=replace(TINY, norm="after"))
    run(after, tmp_path)
    export_onnx(tmp_path / "checkpoint.safetensors", tmp_path / "a.onnx")
    with pytest.raises(DataError, match=r"a\.onnx: its BatchNorm, .* cannot be put back; start from its checkpoint"):
        read_initial_weights(tmp_path / "a.onnx", shipped_patches())


def test_worker_processes_change_nothing(tmp_path, run):
    run(RECIPE, tmp_path / "none")
    run(RECIPE, tmp_path / "two", workers=2)
    assert same(tensors(tmp_path / "none"), tensors(tmp_path / "two"))


def test_sixteen_images_are_learnt_by_heart():
    network = NetworkConfig((8, 16, 16, 32), (1, 1, 1, 2), "stride", 32, 16)
    recipe = Recipe("heart", (Phase(10**6),), network=network, batch=16, lr=3e-3, schedule="step", ema=0.95)
    images = np.full((16, 64, 64), 128, np.uint8)
    keypoints = np.zeros((16, 12, 4), np.float32)
    keypoints[..., 2] = -1
    rng = np.random.default_rng(0)
    for n in range(16):
        x, y = rng.uniform(12, 52, 2)
        columns, rows = np.meshgrid(np.arange(64) - x, np.arange(64) - y)
        inside = np.hypot(columns, rows) < 10
        sectors = np.floor(np.arctan2(rows, columns) / np.pi * (1 + n % 4)).astype(int) % 2
        images[n][inside] = np.where(sectors, 255, 0)[inside]
        keypoints[n, 0] = x, y, n % 4, 0
    state = start_state(recipe, torch.device("cpu"))
    blob, wanted = torch.from_numpy(images), torch.from_numpy(keypoints)
    for _ in range(200):
        train_step(state, state.network, blob, wanted, ALONE)
    figures = validate_network(state.mean, [("heart", Batch(images, keypoints))])
    assert figures["heart_found_1px"] == 1.0
    assert figures["heart_id"] == 1.0
    assert figures["heart_alarms"] == 0.0


def test_the_first_phase_leaves_all_but_the_attached_layers_alone(tmp_path, run):
    recipe = replace(RECIPE, phases=(Phase(16, trains="attached"),))
    fresh = start_state(recipe, torch.device("cpu")).network.state_dict()
    run(recipe, tmp_path)
    after = {k.removeprefix("network."): v for k, v in tensors(tmp_path).items() if k.startswith("network.")}
    changed = {k for k in fresh if not torch.equal(fresh[k], after[k])}
    assert changed == {f"{h}_attached.{p}" for h in ("detector", "descriptor") for p in ("weight", "bias")}


def test_phases_and_rates_follow_the_recipe():
    recipe = replace(RECIPE, lr=1.0, warmup=8, schedule="step", decay_at=(16, 24), decay=0.2)
    assert recipe.steps == 8
    assert [recipe.rate(s) for s in range(8)] == pytest.approx([0.5, 1, 1, 1, 0.2, 0.2, 0.04, 0.04])
    assert [recipe.phase(s)[1] for s in (0, 3, 4, 6, 8)] == [0, 0, 0, 0.5, 1]
    cosine = replace(RECIPE, lr=1.0, decay=0.1)
    assert [cosine.rate(s) for s in (0, 4, 8)] == pytest.approx([1.0, 0.55, 0.1])


def test_the_papers_recipe_is_the_papers():
    recipe = load_recipe(CONFIGS / "paper.toml")
    epoch = 20_000
    assert [p.samples / epoch for p in recipe.phases] == [15, 15, 120]
    assert [p.trains for p in recipe.phases] == ["attached", "all", "all"]
    assert recipe.samples == SampleConfig("scenes", (640, 480), epoch)
    assert (recipe.optimizer, recipe.lr, recipe.weight_decay) == ("adam", 5e-4, 1e-6)
    assert (recipe.schedule, recipe.decay, recipe.decay_at) == ("step", 0.2, (15 * epoch, 45 * epoch))
    assert recipe.loss == LossConfig("pixel", 1.0, 0.0, "hinge", 0.2, 640 * 480 / 5, 0.9, 0.2)
    assert recipe.network == NetworkConfig(norm="after")


def test_the_papers_recipe_runs_its_three_phases(tmp_path, run):
    recipe = load_recipe("paper")
    small = replace(recipe.network, widths=(4, 4, 8, 8), head_width=8, descriptor_width=8)
    scenes = replace(recipe.samples, size=(96, 64), set_size=4)
    phases = tuple(replace(phase, samples=8) for phase in recipe.phases)
    recipe = replace(recipe, network=small, samples=scenes, phases=phases, batch=4, decay_at=(8, 24))
    assert [recipe.phase(step)[0].trains for step in range(6)] == ["attached"] * 2 + ["all"] * 4
    assert [recipe.phase(step)[1] for step in range(6)] == [0, 0, 0, 0, 1, 1]
    assert run(recipe, tmp_path)
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert lines[-1]["samples"] == 24
    assert np.isfinite([lines[-2]["loss"], lines[-2]["id_loss"]]).all()


def test_a_recipe_that_ships_is_found_by_its_name():
    assert load_recipe("paper") == load_recipe(CONFIGS / "paper.toml")
    with pytest.raises(
        DataError, match="there is no recipe 'papers', only: finetune, paper, reference, superpoint, or"
    ):
        load_recipe("papers")


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.toml")), ids=lambda p: p.name)
def test_shipped_recipes_survive_the_checkpoint(path):
    recipe = load_recipe(path)
    content = {key: value for key, value in asdict(recipe).items() if value is not None}
    assert parse_recipe(json.loads(json.dumps(content)), "json") == recipe


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name = 'a'\nphases = []\nbatches = 3", "unknown key 'batches'; known are: name, phases, seed"),
        ("name = 'a'\n[[phases]]\nsamples = 1\nepochs = 2", r"unknown key 'epochs' in phases\[0\]; known are: samples"),
        ("phases = []", "the recipe lacks name"),
        ("name = 'a'\nphases = []\nbatch = 'b'", "batch is 'b', expected a whole number from 0"),
        ("name = 'a'\nphases = []\nlr = -1", "lr is -1, expected a number from 0"),
        ("name = 'a'\nphases = []\nschedule = 'linear'", "schedule is 'linear', expected one of: step, cosine"),
        ("name = 'a'\nphases = []\n[network]\nwidths = [1, 2]", r"network\.widths is \[1, 2\], expected a list of 4"),
        ("name = 'a'\nphases = []\n[network]\nwidths = [0, 2, 3, 4]", "expected four positive numbers each"),
        ("name = 'a'\nphases = []", "expected at least one phase"),
        (
            "name = 'a'\nphases = [{ samples = 63 }]",
            "together, they have fewer samples than one batch, expected at least 64",
        ),
        ("name = 'a'\nphases = []\nlr = nan", "lr is nan, expected a number from 0"),
        ("name = 'a'\nphases = []\n[samples]\nsize = [100, 96]", r"size \[100, 96\] .*, expected multiples of 8"),
        ("name = 'a'\nphases = []\n[samples]\nset_size = 0", "set_size 0, expected .* at least 1"),
        ("name = ", "not valid TOML"),
    ],
)
def test_a_bad_recipe_is_one_line_with_the_place(tmp_path, text, message):
    path = tmp_path / "recipe.toml"
    path.write_text(text)
    with pytest.raises(DataError, match=rf"recipe\.toml: .*{message}") as caught:
        load_recipe(path)
    assert "\n" not in str(caught.value)


def test_a_checkpoint_of_another_recipe_or_design_set_is_refused(tmp_path, run):
    run(RECIPE, tmp_path)
    with pytest.raises(DataError, match="was trained with another lr and ema; use another folder"):
        run(replace(RECIPE, lr=0.1, ema=0.5), tmp_path, resume=True)
    with pytest.raises(DataError, match="was trained on other patch designs"):
        run(RECIPE, tmp_path, resume=True, patches=shipped_patches()[::-1])
    with pytest.raises(DataError, match="use `resume`"):
        run(RECIPE, tmp_path)
    (tmp_path / "checkpoint.safetensors").write_bytes(b"cut off")
    with pytest.raises(DataError, match="cannot be read as a checkpoint"):
        run(RECIPE, tmp_path, resume=True)


def test_the_log_holds_losses_and_validation(tmp_path, run):
    run(RECIPE, tmp_path)
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert lines[-1]["samples"] == 32
    assert {"loss", "id_loss", "lr"} <= lines[-2].keys()
    assert {"clean_found_3px", "paper_alarms", "hard_id"} <= lines[-1].keys()


def test_evaluation_counts_what_is_there():
    """A stand-in network that sees one of two keypoints, 2 px away and with the wrong ID, and one ghost."""
    keypoints = np.zeros((1, 12, 4), np.float32)
    keypoints[..., 2] = -1
    keypoints[0, :3] = [(20, 20, 0, 0), (60, 20, 1, 0), (20, 60, 1, 9)]  # the last one is ignored

    class Oracle(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = torch.nn.Parameter(torch.zeros(1))

        def forward(self, image):
            detector = torch.zeros(1, 65, 10, 10)
            detector[:, 64] = 10
            for x, y in ((22, 20), (24, 60), (60, 60)):
                detector[0, (y % 8) * 8 + x % 8, y // 8, x // 8] = 30
            ids = torch.zeros(1, 5, 10, 10)
            ids[:, 1] = 1
            return detector, ids

    figures = validate_network(Oracle(), [("a", Batch(np.zeros((1, 80, 80), np.uint8), keypoints))])
    assert figures == {"a_found_3px": 0.5, "a_found_1px": 0.0, "a_id": 0.0, "a_alarms": 1.0}


def test_two_processes_train_one_network(tmp_path, photos):
    """The same gradients in both: what two processes of batch 2 do is saved once, and resumes."""
    recipe = tmp_path / "recipe.toml"
    recipe.write_text(
        "name = 'two'\nbatch = 4\nprecision = 'fp32'\nphases = [{ samples = 8 }]\n"
        "[network]\nwidths = [4, 4, 8, 8]\ndepths = [1, 1, 1, 1]\nhead_width = 8\ndescriptor_width = 8\n"
    )
    code = (
        "import hashlib, os, sys, torch\n"
        "from pathlib import Path\n"
        "from kpbench.training import loop as t\n"
        "from kpbench.training.process_group import dist\n"
        "from kpbench.training.recipe import load_recipe\n"
        "step = t.train_step\n"
        "def watched(state, *rest):\n"
        "    pair = step(state, *rest)\n"
        "    flat = torch.cat([p.flatten() for p in state.network.parameters()])\n"
        "    out = Path(sys.argv[2]) / f'{state.step}-{os.environ[\"RANK\"]}'\n"
        "    out.write_text(hashlib.sha256(flat.detach().numpy().tobytes()).hexdigest())\n"
        "    return pair\n"
        "t.train_step = watched\n"
        "options = t.TrainOptions(workers=0, threads=1, validation_images=1)\n"
        "t.train(load_recipe(sys.argv[1]), sys.argv[2], sys.argv[3], options=options)\n"
        "dist.destroy_process_group()\n"
    )
    port = str(20_000 + os.getpid() % 20_000)
    environment = os.environ | {
        "WORLD_SIZE": "2",
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": port,
        "OMP_NUM_THREADS": "1",
    }
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", code, str(recipe), str(tmp_path), str(photos)],
            env=environment | {"RANK": rank, "LOCAL_RANK": rank},
        )
        for rank in "01"
    ]
    assert [p.wait(timeout=60) for p in processes] == [0, 0]
    digests = [[(tmp_path / f"{step}-{rank}").read_text() for rank in "01"] for step in (1, 2)]
    assert digests[0][0] == digests[0][1]
    assert digests[1][0] == digests[1][1]
    assert digests[0] != digests[1]


def test_an_interrupt_ends_after_the_step_with_a_checkpoint_that_resumes(tmp_path, run, monkeypatch):
    inherited = signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in a shell's background job
    before = signal.getsignal(signal.SIGINT)

    def interrupted(state, *rest):
        if state.step == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return train_step(state, *rest)

    run(RECIPE, tmp_path / "whole")
    with monkeypatch.context() as patched:
        patched.setattr("kpbench.training.loop.train_step", interrupted)
        with pytest.raises(KeyboardInterrupt, match="is at step 3; the same command with `resume` goes on"):
            run(RECIPE, tmp_path / "parts")
    assert signal.getsignal(signal.SIGINT) is before
    signal.signal(signal.SIGINT, inherited)
    # "the same command", whatever that started from
    assert run(RECIPE, tmp_path / "parts", resume=True, init="superpoint-small")
    assert same(tensors(tmp_path / "whole"), tensors(tmp_path / "parts"))
