"""`kpbench leaderboard verify`: what passes, and every way to tamper that is refused."""

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from helpers import kpbench

from kpbench.benchmark.reports import write_suite_reports
from kpbench.benchmark.rerun import verify_submission
from kpbench.benchmark.run import bench
from kpbench.errors import DataError
from kpbench.files import shipped_files
from kpbench.predictions.files import read_predictions, write_predictions
from kpbench.synth.suite import SuiteConfig
from kpbench.synth.suite_file import load_suite

SMALL = SuiteConfig(load_suite("paper-v1"), images=1, size_px=(203, 155), only=("blur",), shard_size=10)


@pytest.fixture(scope="module")
def honest(tmp_path_factory):
    """A submission of two detectors, and the folder of images made anew."""
    folder = tmp_path_factory.mktemp("submission")
    runs = bench([SMALL], ["sift", "aruco"], folder / "bench", workers=1)
    write_suite_reports(runs, folder / "bench")
    shutil.rmtree(folder / "bench" / "suites")
    assert [v.problem for v in verify_submission(folder / "bench", folder / "again", workers=1)] == ["", ""]
    return folder


@pytest.fixture
def submission(honest, tmp_path):
    shutil.copytree(honest / "bench", tmp_path / "bench")
    shutil.copytree(honest / "again", tmp_path / "again")
    return tmp_path


def edit(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def name_predictions(folder, detector):
    """Let the scores name the edited predictions by their new SHA-256."""
    [file] = folder.glob(f"bench/predictions/*/{detector}-*.json")
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    scores = folder / "bench" / "scores" / "paper-v1" / f"{detector}.json"
    edit(scores, lambda c: c["provenance"]["predictions"][0].update(sha256=digest))
    return scores


def problem(folder, detector="sift", percent=100, **more):
    found = verify_submission(folder / "bench", folder / "again", percent=percent, workers=1, **more)
    return next(v.problem for v in found if v.detector == detector)


def test_a_sample_is_as_large_as_asked_and_repeats_with_its_seed(honest):
    one, two = (verify_submission(honest / "bench", honest / "again", percent=50, seed=7, workers=1) for _ in "ab")
    assert one == two
    assert [len(v.images) for v in one] == [2, 8]  # the board of tags is one, those of patches are four
    assert one[0].to_dict()["scores_sha256"] == hashlib.sha256(one[0].scores.read_bytes()).hexdigest()


def test_a_moved_detection_is_refuted(submission):
    [file] = submission.glob("bench/predictions/*/sift-*.json")
    told = read_predictions(file)
    moved = told.xy.copy()
    moved[0] += 0.05  # too little to change a count
    write_predictions(file, replace(told, xy=moved))
    assert problem(submission).startswith("no predictions file has the SHA-256")
    name_predictions(submission, "sift")
    assert (
        problem(submission)
        == f"image_id {told.image_id[0]}: a detection lies 0.0707 px from where its detector finds it"
    )


def test_better_scores_than_the_predictions_give_are_refuted(submission):
    scores = submission / "bench" / "scores" / "paper-v1" / "sift.json"
    honest_text = scores.read_text()
    for change in (
        lambda c: c["metrics"].update(detection_score=1.0),
        lambda c: c["metrics"].update(f1=1.0),
        lambda c: c["metrics"]["intervals"].update(detection_score=[0.9, 1.0]),
        lambda c: c["by"][0].update(rung=99.0),
        lambda c: c.update(by=[1]),
    ):
        scores.write_text(honest_text)
        edit(scores, change)
        assert problem(submission, percent=1) == "its scores do not follow from its predictions"


def test_another_suite_another_truth_and_another_version_are_refuted(submission):
    scores = submission / "bench" / "scores" / "paper-v1" / "sift.json"
    kept = scores.read_text()
    edit(scores, lambda c: c["provenance"]["config"]["scene"].update(white=[250, 250]))
    assert "its suite differs from paper-v1 of kpbench: scene" in problem(submission)
    scores.write_text(kept)
    edit(scores, lambda c: c["dataset"].update(fingerprint="0" * 64))
    assert problem(submission).startswith("its images have the fingerprint 0000000000000000")
    scores.write_text(kept)
    edit(scores, lambda c: c["detector"].update(version="0.0"))
    assert problem(submission).startswith("its detector is '0.0', the one here")


def test_a_suite_in_a_file_of_the_submission_is_refused(submission, monkeypatch):
    monkeypatch.chdir(submission)
    Path("easy.toml").write_text(shipped_files("suites")["paper-v1"].read_text().replace('"paper-v1"', '"easy.toml"'))
    assert load_suite("easy.toml").name == "easy.toml"
    scores = submission / "bench" / "scores" / "paper-v1" / "sift.json"
    edit(scores, lambda c: c["provenance"]["config"].update(suite="easy.toml"))
    with pytest.raises(DataError, match=r"sift\.json: .*'easy\.toml', which does not ship with kpbench"):
        problem(submission)


def test_code_that_a_submission_names_does_not_run(submission, monkeypatch):
    (submission / "evil.py").write_text("open('ran', 'w').close()\n")
    monkeypatch.chdir(submission)
    scores = submission / "bench" / "scores" / "paper-v1" / "sift.json"
    edit(scores, lambda c: c["detector"].update(name="evil:find"))
    assert "does not ship with kpbench" in problem(submission, "evil:find")
    assert not Path("ran").exists()
    edit(scores, lambda c: c["detector"].update(name="mine"))
    assert problem(submission, "mine", detectors={"mine": "sift"}) == ""


def test_the_command_says_what_is_verified_and_exits_1_if_something_is_not(submission, monkeypatch):
    monkeypatch.chdir(submission)
    done = kpbench("leaderboard", "verify", "bench", "--out", "again", "--json", "verified.json")
    assert "paper-v1 aruco: verified on 1 images" in done.output
    entries = json.loads(Path("verified.json").read_text())["results"]
    assert {entry["problem"] for entry in entries} == {""}
    scores = Path("bench/scores/paper-v1/sift.json")
    edit(scores, lambda c: c["metrics"].update(detection_score=1.0))
    done = kpbench("leaderboard", "verify", "bench", "--out", "again", code=1)
    assert "paper-v1 sift: refuted: its scores do not follow" in done.output
    scores.write_text('{"schema": "kpbench.scores/1"}')
    with pytest.raises(DataError, match=r"sift\.json: KeyError: 'provenance', expected the scores of a suite"):
        verify_submission("bench", "again")
    with pytest.raises(DataError, match="holds no scores"):
        verify_submission("again", "again")
