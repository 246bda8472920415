from dataclasses import replace

import numpy as np
import pytest

from kpbench.detectors.hypotheses import (
    UNUSED_COLUMNS,
    Evidence,
    Hypotheses,
    judge_inputs,
    select_distinct,
    select_likeliest,
)
from kpbench.detectors.verification import (
    LEAST_FIT_LOG_ODDS,
    SECOND_JUDGE,
    USUAL_PLACES,
    find_ellipses,
    fit_hypotheses,
    judge,
    look_again,
    move_poses,
    propose_poses,
    verify_candidates,
)
from kpbench.fitting.align import short_semi_axis
from kpbench.fitting.pyramid import Pyramids
from kpbench.patches.design import shipped_patches
from kpbench.render.placement import Placement
from kpbench.render.scene import render_scene

PATCHES = shipped_patches()
SURE = 0.9


def scene():
    """Two patches on an even ground: image, centres, indices of their designs."""
    placements = [
        Placement(PATCHES[1], np.array([[12.0, 2.0, 40.3], [-1.0, 9.0, 30.8], [0.0, 0.001, 1.0]]), 20.0, 230.0),
        Placement(PATCHES[3], np.array([[0.0, -30.0, 110.6], [30.0, 0.0, 70.1], [0.0005, 0.0, 1.0]]), 40.0, 200.0),
    ]
    rendered = render_scene(np.full((128, 160), 120, np.uint8), placements)
    return rendered.image, np.column_stack([rendered.keypoints["x"], rendered.keypoints["y"]]), [1, 3]


def verify(image, xy, designs, sure=SURE):
    """Verify candidates at places where a network sees these designs, with this probability."""
    log_id = np.log(np.full((len(xy), len(PATCHES) + 1), (1 - sure) / len(PATCHES)))
    log_id[np.arange(len(xy)), designs] = np.log(sure)
    return verify_candidates(image, np.asarray(xy, float), np.full(len(xy), sure), log_id, PATCHES)


def test_the_fit_finds_the_centre_to_a_fiftieth_of_a_pixel():
    image, xy, design = scene()
    found = verify(image, np.add(xy, [[0.9, -0.8], [-1.0, 1.2]]), design)
    np.testing.assert_allclose(found.xy, xy, atol=0.02)
    assert found.design.tolist() == design
    assert np.all(found.score > 0.9)


@pytest.mark.parametrize("guess", range(4))
def test_the_pixels_outvote_a_network_that_is_not_sure_of_the_design(guess):
    image, xy, design = scene()
    assert verify(image, xy, [guess, guess], sure=0.4).design.tolist() == design


def test_what_is_no_patch_scores_low():
    image, _, design = scene()
    image[90:, 20:40] = 20  # the corners of a stripe
    assert np.all(verify(image, [[20.0, 90.0], [40.0, 90.0]], design).score < 0.5)


def test_a_place_beside_the_centre_leads_to_it():
    image, xy, design = scene()
    found = verify(image, [xy[0] + [8.0, 0.0]], design[:1])
    np.testing.assert_allclose(found.xy, xy[:1], atol=0.02)


def test_a_score_does_not_depend_on_the_rest_of_the_image():
    image, xy, design = scene()
    alone = verify(image, xy[:1], design[:1]).score[0]
    wide = np.random.default_rng(0).integers(0, 255, (480, 640), np.uint8)
    wide[100:228, 200:360] = image
    crowd = np.random.default_rng(1).uniform([400, 0], [639, 479], (200, 2))
    places = np.concatenate([xy[:1] + np.array([200, 100]), crowd])
    found = verify(wide, places, design[:1] + [0] * len(crowd))
    assert found.score[found.place == 0][0] == pytest.approx(alone, abs=0.01)


def test_where_more_places_lie_around_a_patch_each_is_less_likely_one():
    image, xy, design = scene()
    few = verify(image, xy, design)
    bare = np.tile([[5.0, 5.0]], (20, 1))  # within 96 px of the first patch alone
    many = verify(image, np.concatenate([xy, bare]), design + [0] * len(bare))
    odds = [np.log(found.score / (1 - found.score)) for found in (few, many)]
    np.testing.assert_allclose(odds[0] - odds[1], [np.log(22 / USUAL_PLACES), 0], atol=0.02)


@pytest.mark.parametrize("octave", [1, 3])
def test_a_large_patch_is_verified_in_the_picture_in_which_it_was_found(octave):
    size = 2.0**octave
    H = np.array([[20.0, 2.0, 90.3], [-3.0, 17.0, 80.8], [0.0, 0.001, 1.0]])
    H[:2] *= size
    placement = Placement(PATCHES[1], H, 20.0, 230.0)
    rendered = render_scene(np.full((int(160 * size), int(180 * size)), 120, np.uint8), [placement])
    xy = np.column_stack([rendered.keypoints["x"], rendered.keypoints["y"]])
    log_id = np.log(np.full((1, len(PATCHES) + 1), 0.2))
    found = verify_candidates(rendered.image, xy + size, np.array([SURE]), log_id, PATCHES, octave=np.array([octave]))
    assert found.design.tolist() == [1]
    assert found.score[0] > 0.9
    np.testing.assert_allclose(found.xy, xy, atol=0.05)


def test_bare_ground_is_nothing_whatever_the_network_says():
    assert len(verify(np.full((64, 64), 120, np.uint8), [[20.0, 30.0]], [0]).score) == 0


def test_hopeless_places_are_not_fitted():
    image, _, _ = scene()
    assert len(verify(image, [[20.0, 100.0]], [0], sure=0.01).score) == 0


def test_every_place_has_one_answer_the_likeliest():
    place, odds = np.array([0, 0, 0, 2, 2, 5]), np.array([-1.0, 3.0, 2.0, 0.5, 0.7, -9.0])
    assert select_likeliest(place, odds).tolist() == [1, 4, 5]
    assert select_likeliest(place[:0], odds[:0]).tolist() == []


def test_a_small_patch_is_not_taken_for_a_large_one_that_the_background_resembles():
    ground = np.full((160, 160), 60, np.uint8)
    ground[:80, :80] = ground[80:, 80:] = 200  # a chequer whose middle is the patch's own place
    small = Placement(PATCHES[2], np.array([[6.0, 0.5, 80.3], [-0.5, 6.0, 79.6], [0.0, 0.0, 1.0]]), 20.0, 230.0)
    rendered = render_scene(ground, [small])
    xy = np.column_stack([rendered.keypoints["x"], rendered.keypoints["y"]])
    found = verify(rendered.image, xy + 0.7, [2], sure=0.99)
    np.testing.assert_allclose(found.xy, xy, atol=0.05)
    assert short_semi_axis(found.A)[0] == pytest.approx(rendered.keypoints["radius_minor"][0], rel=0.05)


def test_of_hypotheses_of_one_design_that_cover_each_other_the_likeliest_is_fitted():
    xy = np.array([[50.0, 50.0], [51.0, 50.0], [50.5, 50.0], [58.0, 50.0], [90.0, 50.0]])
    design, odds = np.array([0, 0, 1, 0, 0]), np.array([1.0, 2.0, -1.0, 0.5, LEAST_FIT_LOG_ODDS - 0.1])
    A = np.tile(np.eye(2) * 10, (5, 1, 1))
    nothing = np.zeros((5, 0))
    zeros, octave = np.zeros(5), np.zeros(5, np.int64)
    found = Hypotheses(np.arange(5), xy, octave, zeros, zeros, design, xy, A, A, nothing, zeros, nothing)
    assert select_distinct(found, odds, LEAST_FIT_LOG_ODDS).tolist() == [1, 2, 3]
    assert select_distinct(found[:0], odds[:0], LEAST_FIT_LOG_ODDS).tolist() == []


def test_an_ellipse_is_found_from_half_a_radius_off():
    image, xy, _ = scene()
    true = [np.array([[12.0, 2.0], [-1.0, 9.0]]), np.array([[0.0, -30.0], [30.0, 0.0]])]
    for n, A in enumerate(true):
        A = A - np.outer(xy[n], [0.0, 0.001] if n == 0 else [0.0005, 0.0])  # of the perspective
        off = A @ [0.3, -0.35]
        centre, map_, odds = find_ellipses(Pyramids(image), xy[n : n + 1] + off)
        assert np.linalg.norm(np.linalg.solve(A, centre[0] - xy[n])) < 0.15
        stretch = np.linalg.svd(np.linalg.solve(A, map_[0]), compute_uv=False)
        assert stretch == pytest.approx([1.0, 1.0], abs=0.2)
        assert odds[0] > 2


def test_a_symmetric_map_and_a_shift_within_it_move_a_pose():
    xy, A = move_poses(
        np.array([[5.0, 6.0]]),
        np.array([[[0.0, -2.0], [2.0, 0.0]]]),
        np.array([[0.5, 0.0]], np.float32),
        np.array([np.diag([np.log(3), 0.0])], np.float32),
    )
    np.testing.assert_allclose(A[0], [[0.0, -2.0], [6.0, 0.0]], atol=1e-6)
    np.testing.assert_allclose(xy[0], [5.0, 9.0], atol=1e-6)


def test_a_second_look_shows_a_place_in_the_pose_that_it_is_given():
    image, xy, design = scene()
    pyramids, log_id = Pyramids(image), np.log(np.full((2, len(PATCHES) + 1), 0.2))
    proposed = propose_poses(pyramids, xy, np.full(2, SURE), log_id, PATCHES)
    proposed = proposed[proposed.design == np.array(design)[proposed.place]]
    same = look_again(pyramids, proposed, PATCHES)
    np.testing.assert_allclose(same.evidence, proposed.evidence, atol=0.1)
    np.testing.assert_array_equal(same.view, proposed.view)
    off = look_again(pyramids, replace(proposed, xy=proposed.xy + 3.0), PATCHES)
    correlation = Evidence.NCC
    assert np.all(off.evidence[:, correlation] < proposed.evidence[:, correlation] - 0.3)
    np.testing.assert_array_equal(off.place_xy, proposed.place_xy)
    assert len(look_again(pyramids, proposed[:0], PATCHES)) == 0


def test_evidence_has_a_column_for_each_name_and_none_for_no_places():
    image, xy, _ = scene()
    log_id = np.log(np.full((2, len(PATCHES) + 1), 0.2))
    pyramids = Pyramids(image)
    for count in (2, 0):
        proposed = propose_poses(pyramids, xy[:count], np.full(count, SURE), log_id[:count], PATCHES)
        assert proposed.evidence.shape == (len(proposed), Evidence.RADIUS + 1)
        assert sorted(set(proposed.place.tolist())) == list(range(count))
        fitted = fit_hypotheses(pyramids, proposed, np.zeros(len(proposed)), PATCHES)
        assert fitted.evidence.shape == (len(proposed), len(Evidence) + UNUSED_COLUMNS)
        odds, corrected = judge(SECOND_JUDGE, fitted, PATCHES)
        assert odds.shape == (len(proposed),)
        assert corrected.xy.shape == fitted.xy.shape


def test_a_clear_patch_is_named_by_its_pixels_however_sure_the_network_is_of_another():
    image, xy, design = scene()
    found = verify(image, xy, [0, 0], sure=0.9999)
    assert found.design[1] == design[1]


def test_what_lies_outside_the_image_is_no_evidence():
    image, xy, design = scene()
    cut = np.ascontiguousarray(image[:, 38:])  # the first centre lies 2 px inside
    log_id = np.log(np.full((1, len(PATCHES) + 1), 0.2))
    found = propose_poses(Pyramids(cut), xy[:1] - [38, 0], np.array([SURE]), log_id, PATCHES)
    view = judge_inputs(found, PATCHES)["view"]
    assert np.isnan(found.view).any()
    assert not np.isnan(view).any()
    outside = np.isnan(found.view).reshape(len(found), 1, *view.shape[2:])
    assert (view[np.broadcast_to(outside, view.shape)] == 0).all()
    assert (view[:, 1:][~outside] != 0).mean() > 0.9
    assert design[0] in found.design


def test_a_design_is_shown_as_blurred_as_the_fit_found_the_image():
    image, xy, _ = scene()
    log_id = np.log(np.full((2, len(PATCHES) + 1), 0.2))
    proposed = propose_poses(Pyramids(image), xy, np.full(2, SURE), log_id, PATCHES)
    sharp = judge_inputs(proposed, PATCHES)["view"]
    soft = judge_inputs(replace(proposed, blur_px=np.full(len(proposed), 4.0)), PATCHES)["view"]
    np.testing.assert_array_equal(soft[:, 0], sharp[:, 0])
    assert np.all(soft[:, 1].std(axis=(1, 2)) < 0.95 * sharp[:, 1].std(axis=(1, 2)))
