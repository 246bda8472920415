import json

from helpers import kpbench


def test_the_demo_makes_what_it_names(here):
    for _ in range(2):  # a second demo replaces the first
        result = kpbench("demo", "--n", 4)
    named = [line.split()[0] for line in result.stdout.split("Open:")[1].splitlines() if line.strip()]
    assert len(named) == 3
    assert all((here / name).stat().st_size > 0 for name in named)
    scores = json.loads((here / "kpbench-demo" / "scores.json").read_text())
    assert scores["metrics"]["counts"]["truths"] > 0
