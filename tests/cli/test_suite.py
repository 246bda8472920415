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
        "kpbench: there is no suite 'paper-v9', only: camera-v1, extended-v1, extended-v2, paper-v1, video-v1, "
        "or a .toml file of your own; did you mean 'paper-v1'?\n"
    )
    kpbench("suite", "paper-v1", "--distortion", "much", code=2)


def test_a_camera_that_cannot_be_used_is_one_line(tmp_path):
    bad = tmp_path / "bad.yaml"
    bad.write_text("image_width: 640\n")
    made = ("suite", "paper-v1", "--images", 1, "--size", "203x155", "--out", tmp_path / "out", "--camera")
    for name, problem in (
        (
            "no-such",
            "there is no camera 'no-such', only: action-cam, everyday, industrial, phone, webcam, or a .toml, ",
        ),
        (bad, f"{bad}: camera_matrix is missing, expected the keys of OpenCV, ROS or Kalibr"),
        (tmp_path / "none.yaml", f"{tmp_path / 'none.yaml'}: "),
    ):
        done = kpbench(*made, name, code=1)
        assert done.stderr.startswith(f"kpbench: {problem}")
        assert done.stderr.count("\n") == 1


def test_films_may_be_short(tmp_path):
    made = ("suite", "video-v1", "--images", 1, "--frames", 2, "--size", "203x155", "--workers", 1)
    assert "8 images" in kpbench(*made, "--out", tmp_path / "films").stdout
    other = kpbench("suite", "paper-v1", "--frames", 2, code=2)
    assert "--frames is for suites of films; paper-v1 has none" in other.stderr
