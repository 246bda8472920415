import pytest
from helpers import kpbench

TINY = """
name = "tiny"
batch = 4
phases = [{ samples = 4 }]
[network]
widths = [4, 4, 8, 8]
depths = [1, 1, 1, 1]
head_width = 8
descriptor_width = 8
"""


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "one of --config and --verifier is missing"),
        (["--config", "reference", "--test", "set"], "--test only with --verifier"),
        (["--config", "reference", "set"], "DATASET only with --verifier"),
        (["--verifier", "ellipse", "set"], "--verifier needs at least one DATASET, and --test DATASET"),
        (["--verifier", "ellipse", "set", "--test", "set", "--resume"], "--resume not with --verifier"),
        (["--verifier", "ellipse", "set", "--test", "set", "--init", "a.onnx"], "expected shipped with --verifier"),
        (
            ["--verifier", "ellipse", "set", "--test", "set", "--detector", "a.onnx"],
            "--detector only with --verifier j",
        ),
    ],
)
def test_options_of_the_two_kinds_of_training_do_not_mix(arguments, message):
    assert message in kpbench("train", *arguments, code=2).stderr


def test_a_finished_training_is_neither_overwritten_nor_resumed_elsewhere(here):
    (here / "tiny.toml").write_text(TINY)
    train = ("train", "--config", "tiny.toml", "--workers", "0", "--threads", "1")
    assert kpbench(*train).stdout == "runs/tiny/checkpoint.safetensors: finished\n"
    assert kpbench(*train, code=1).stderr == (
        "kpbench: runs/tiny/checkpoint.safetensors: there is a training in this folder; "
        "use --resume, or another folder\n"
    )
    assert kpbench(*train, "--out", "other", "--resume", code=1).stderr == (
        "kpbench: other/checkpoint.safetensors: nothing to go on from yet; leave --resume out\n"
    )


def test_a_recipe_that_is_not_there_is_one_line():
    result = kpbench("train", "--config", "papers", code=1)
    assert result.stderr.startswith("kpbench: there is no recipe 'papers', only: finetune, paper, reference, ")
