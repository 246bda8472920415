import numpy as np
import pytest
from scipy import stats

from kpbench.errors import DataError, GateFailed
from kpbench.scoring.comparison import Comparison, Difference, check_no_worse
from kpbench.scoring.significance import adjust_holm, exchange_test


def difference(sums):
    return {"rate": sums[..., 0] / sums[..., 1] - sums[..., 2] / sums[..., 3]}


def sums_of(scenes, seed, gain=0):
    rng = np.random.default_rng(seed)
    truths = rng.integers(5, 9, scenes)
    found = rng.binomial(truths, 0.6), np.minimum(rng.binomial(truths, 0.6) + gain, truths)
    return np.stack([found[0], truths, found[1], truths], axis=1)


@pytest.mark.parametrize("scenes", [1, 2, 7, 12])
def test_few_scenes_agree_with_all_exchanges_of_scipy(scenes):
    sums = sums_of(scenes, seed=scenes)
    a, b = sums[:, 0], sums[:, 2]

    def rate(a, b, axis):
        return (a.sum(axis=axis) - b.sum(axis=axis)) / sums[:, 1].sum()

    p = exchange_test(sums, difference, seed=0)["rate"]
    if scenes == 1:
        assert p == 1
        return
    found = stats.permutation_test((a, b), rate, permutation_type="samples", vectorized=True, n_resamples=np.inf)
    assert p == pytest.approx(min(found.pvalue, 1))


def test_many_scenes_agree_with_a_paired_t_test():
    sums = sums_of(300, seed=3, gain=1) * [1, 0, 1, 0] + [0, 8, 0, 8]
    sums[::3, [0, 2]] = sums[::3, [2, 0]]
    p = exchange_test(sums, difference, seed=0)["rate"]
    assert p == pytest.approx(stats.ttest_rel(sums[:, 0], sums[:, 2]).pvalue, abs=0.01)
    clear = sums_of(300, seed=3, gain=1)
    assert exchange_test(clear, difference, seed=0)["rate"] == 1 / 5000


def test_an_undefined_difference_has_no_p_value():
    with np.errstate(invalid="ignore"):
        assert exchange_test(np.zeros((3, 4), int), difference, seed=0) == {"rate": None}


def test_holm_agrees_with_the_definition():
    rng = np.random.default_rng(0)
    for n in (0, 1, 2, 9):
        p = np.round(rng.random(n) ** 3, 2)  # with ties
        adjusted = adjust_holm(p)
        for level in np.linspace(0.003, 0.999, 200):  # step down by hand: reject while p <= level / tests left
            left, rejected = sorted(p.tolist()), []
            while left and left[0] * len(left) <= level:
                rejected.append(left.pop(0))
            assert sorted(p[adjusted <= level].tolist()) == rejected


def test_holm_turns_a_chance_verdict_even():
    assert Difference("blur", 3, "f1", 0.5, 0.4, (0.01, 0.2), 0.03, 0.03).verdict == "better"
    assert Difference("blur", 3, "f1", 0.5, 0.4, (0.01, 0.2), 0.03, 0.3).verdict == "even"


@pytest.mark.parametrize(
    ("metric", "interval", "no_worse", "equivalent"),
    [
        ("detection_score", (-0.005, 0.02), True, False),
        ("detection_score", (-0.02, 0.005), False, False),
        ("detection_score", (-0.01, 0.01), True, True),
        ("average_false_alarm", (-0.02, 0.005), True, False),
        ("average_false_alarm", (-0.005, 0.02), False, False),
        ("detection_score", None, False, False),
    ],
)
def test_a_margin_is_judged_in_the_direction_of_the_metric(metric, interval, no_worse, equivalent):
    d = Difference(None, None, metric, 0.5, 0.5, interval)
    assert (d.is_no_worse(0.01), d.is_equivalent(0.01)) == (no_worse, equivalent)
    check = [Comparison("a", "b", (d,))]
    if no_worse:
        check_no_worse(check, {metric: 0.01})
    else:
        with pytest.raises(GateFailed, match=r"of a may be worse than that of b by more than 0\.01: (\[|no interval)"):
            check_no_worse(check, {metric: 0.01})


def test_a_margin_that_means_nothing_is_refused():
    with pytest.raises(DataError, match=r"^nees is not compared, only detection_score, .*$"):
        check_no_worse([], {"nees": 1})
    with pytest.raises(DataError, match=r"^the margin of f1 is 0, expected a positive number$"):
        check_no_worse([], {"f1": 0})
