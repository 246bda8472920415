from helpers import digests, kpbench


def test_the_suite_command(tmp_path):
    made = ("suite", "paper-v1", "--images", 1, "--size", "203x155", "--workers", 1, "--only", "scale,blur")
    first = kpbench(*made, "--out", tmp_path / "a")
    assert "44 images, 1 shards, fingerprint" in first.stdout
    kpbench(*made, "--out", tmp_path / "b", "--distortion", "0,0")
    assert digests(tmp_path / "a") == digests(tmp_path / "b")
    again = kpbench(*made, "--out", tmp_path / "a", "--seed", 1, code=1)
    assert "already holds a dataset" in again.stderr
    unknown = kpbench("suite", "paper-v9", code=1)
    assert unknown.stderr == (
        "kpbench: there is no suite 'paper-v9', only: extended-v1, paper-v1, or a .toml file of your own\n"
    )
    kpbench("suite", "paper-v1", "--distortion", "much", code=2)
