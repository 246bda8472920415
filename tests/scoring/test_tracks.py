"""Metrics of tracking, on films of a few frames with known answers."""

import numpy as np
import pytest

from kpbench.scoring import TRACK_METRICS, FilmTruth, PoseSeries, score_tracks

POINTS = np.array([[40.0, 0, 0], [0, 40, 0], [-40, 0, 0], [0, -40, 0]])


def series(x_mm, turn_deg=0.0):
    c, s = np.cos(np.radians(turn_deg)) + 0 * x_mm, np.sin(np.radians(turn_deg)) + 0 * x_mm
    R = np.array([[c, -s, 0 * c], [s, c, 0 * c], [0 * c, 0 * c, 0 * c + 1]]).transpose(2, 0, 1)
    return PoseSeries(R, np.column_stack([x_mm, 0 * x_mm, 0 * x_mm + 500]))


def truth(n, films=1, shows=None):
    x_mm = np.tile(5.0 * np.arange(n), films)
    film, time_s = np.repeat(np.arange(films), n), np.tile(np.arange(n) / 30, films)
    shows = np.ones(n * films, bool) if shows is None else shows
    return FilmTruth(film, time_s, series(x_mm), shows, POINTS), x_mm


def test_perfect_poses_have_perfect_scores():
    film, x_mm = truth(8, 2)
    scores = score_tracks(film, series(x_mm), series(x_mm))
    assert list(scores) == list(TRACK_METRICS)
    assert scores["frames"] == 16
    assert scores["frames_with_pose"] == 1
    assert all(scores[name] == 0 for name in TRACK_METRICS[2:15] if name != "lag_ms")
    assert scores["lag_ms"] == 0
    assert scores["losses"] == 0
    assert scores["frames_to_find_again"] is None


def test_no_poses_leave_the_errors_undefined():
    film, _x_mm = truth(4)
    nothing = series(np.full(4, np.nan))
    scores = score_tracks(film, nothing, nothing)
    assert scores["frames_with_pose"] == 0
    assert scores["losses"] == 0
    assert scores["identity_switches"] == 0
    assert scores["translation_median_mm"] is scores["jitter_mm"] is scores["lag_ms"] is None


def test_errors_and_jitter():
    film, x_mm = truth(400)
    noise = np.random.default_rng(0).normal(0, 0.3, 400)
    scores = score_tracks(film, series(x_mm + noise, 2.0), series(x_mm + 1.0))
    assert scores["jitter_mm"] == pytest.approx(0.3, rel=0.1)
    assert scores["jitter_deg"] == pytest.approx(0, abs=1e-6)
    assert scores["rotation_median_deg"] == pytest.approx(2.0)
    assert scores["filtered_translation_p95_mm"] == pytest.approx(1)


def test_a_filter_that_trails_has_a_lag():
    film, x_mm = truth(20)
    assert score_tracks(film, series(x_mm), series(x_mm - 0.15 * 20))["lag_ms"] == pytest.approx(20.0)
    assert score_tracks(film, series(x_mm), series(x_mm + 0.15 * 20))["lag_ms"] == pytest.approx(-20.0)


def test_wrong_points_count_once_per_switch():
    film, x_mm = truth(6)
    found = series(x_mm, np.array([0, 90, 90, 0, 90, 20.0]))
    assert score_tracks(film, found, found)["identity_switches"] == 2


def test_frames_without_a_pose_count_if_they_show_the_board():
    shows = np.array([1, 1, 0, 0, 1, 1, 1, 1, 1, 1], bool)
    film, x_mm = truth(10, shows=shows)
    x_mm[[0, 2, 3, 4, 8]] = np.nan  # not yet seen; two frames hidden, one late; one lost
    scores = score_tracks(film, series(x_mm), series(x_mm))
    assert scores["losses"] == 2
    assert scores["frames_to_find_again"] == 1.0


def test_films_are_scored_apart():
    film, x_mm = truth(5, 2)
    x_mm[5:] += 300  # the error of the second film is another, but constant
    assert score_tracks(film, series(x_mm), series(x_mm))["jitter_mm"] == 0
