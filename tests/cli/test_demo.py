import json

from click.testing import CliRunner

from kpbench.cli import main


def test_the_demo_makes_what_it_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):  # a second demo replaces the first
        result = CliRunner().invoke(main, ["demo", "--n", "4"])
        assert result.exit_code == 0, result.output
    named = [line.split()[0] for line in result.stdout.split("Open:")[1].splitlines() if line.strip()]
    assert len(named) == 3
    assert all((tmp_path / name).stat().st_size > 0 for name in named)
    scores = json.loads((tmp_path / "kpbench-demo" / "scores.json").read_text())
    assert scores["metrics"]["counts"]["truths"] > 0
