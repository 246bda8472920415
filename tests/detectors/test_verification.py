from dataclasses import replace

import numpy as np
import pytest

from kpbench.detectors import verification as verify
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


def examined(image, xy, said, sure=SURE):
    """What is made of places at which a network sees these designs, with this probability."""
    log_id = np.log(np.full((len(xy), len(PATCHES) + 1), (1 - sure) / len(PATCHES)))
    log_id[np.arange(len(xy)), said] = np.log(sure)
    return verify.examine(image, np.asarray(xy, float), np.full(len(xy), sure), log_id, PATCHES)


def test_the_fit_finds_the_centre_to_a_fiftieth_of_a_pixel():
    image, xy, which = scene()
    found = examined(image, np.add(xy, [[0.9, -0.8], [-1.0, 1.2]]), which)
    np.testing.assert_allclose(found.xy, xy, atol=0.02)
    assert found.which.tolist() == which
    assert np.all(found.score > 0.9)


@pytest.mark.parametrize("said", range(4))
def test_the_pixels_outvote_a_network_that_is_not_sure_of_the_design(said):
    image, xy, which = scene()
    assert examined(image, xy, [said, said], sure=0.4).which.tolist() == which


def test_what_is_no_patch_scores_low():
    image, _, which = scene()
    image[90:, 20:40] = 20  # the corners of a stripe
    assert np.all(examined(image, [[20.0, 90.0], [40.0, 90.0]], which).score < 0.5)


def test_a_place_beside_the_centre_leads_to_it():
    image, xy, which = scene()
    found = examined(image, [xy[0] + [8.0, 0.0]], which[:1])
    np.testing.assert_allclose(found.xy, xy[:1], atol=0.02)


def test_where_more_places_look_like_a_patch_each_is_less_likely_one():
    image, xy, which = scene()
    few = examined(image, xy, which)
    bare = np.tile([[5.0, 5.0]], (2 * verify.USUAL, 1))
    many = examined(image, np.concatenate([xy, bare]), which + [0] * len(bare))
    odds = [np.log(found.score / (1 - found.score)) for found in (few, many)]
    np.testing.assert_allclose(odds[0] - odds[1], np.log(2 + 2 / verify.USUAL), atol=0.02)


def test_bare_ground_is_nothing_whatever_the_network_says():
    assert len(examined(np.full((64, 64), 120, np.uint8), [[20.0, 30.0]], [0]).score) == 0


def test_hopeless_places_are_not_fitted():
    image, _, _ = scene()
    assert len(examined(image, [[20.0, 100.0]], [0], sure=0.01).score) == 0


def test_every_place_has_one_answer_the_likeliest():
    place, odds = np.array([0, 0, 0, 2, 2, 5]), np.array([-1.0, 3.0, 2.0, 0.5, 0.7, -9.0])
    assert verify.likeliest(place, odds).tolist() == [1, 4, 5]
    assert verify.likeliest(place[:0], odds[:0]).tolist() == []


def test_a_small_patch_is_not_taken_for_a_large_one_that_the_background_resembles():
    ground = np.full((160, 160), 60, np.uint8)
    ground[:80, :80] = ground[80:, 80:] = 200  # a chequer whose middle is the patch's own place
    small = Placement(PATCHES[2], np.array([[6.0, 0.5, 80.3], [-0.5, 6.0, 79.6], [0.0, 0.0, 1.0]]), 20.0, 230.0)
    rendered = render_scene(ground, [small])
    xy = np.column_stack([rendered.keypoints["x"], rendered.keypoints["y"]])
    found = examined(rendered.image, xy + 0.7, [2], sure=0.99)
    np.testing.assert_allclose(found.xy, xy, atol=0.05)
    assert found.minor_px[0] == pytest.approx(rendered.keypoints["radius_minor"][0], rel=0.05)


def test_of_hypotheses_of_one_design_that_cover_each_other_the_likeliest_is_fitted():
    xy = np.array([[50.0, 50.0], [51.0, 50.0], [50.5, 50.0], [58.0, 50.0], [90.0, 50.0]])
    which, odds = np.array([0, 0, 1, 0, 0]), np.array([1.0, 2.0, -1.0, 0.5, verify.HOPELESS - 0.1])
    A = np.tile(np.eye(2) * 10, (5, 1, 1))
    nothing = np.zeros((5, 0))
    found = verify.Hypotheses(np.arange(5), xy, which, xy, A, nothing, np.zeros(5), nothing)
    assert verify.distinct(found, odds).tolist() == [1, 2, 3]
    assert verify.distinct(found[:0], odds[:0]).tolist() == []


def test_an_ellipse_is_found_from_half_a_radius_off():
    image, xy, _ = scene()
    true = [np.array([[12.0, 2.0], [-1.0, 9.0]]), np.array([[0.0, -30.0], [30.0, 0.0]])]
    for n, A in enumerate(true):
        A = A - np.outer(xy[n], [0.0, 0.001] if n == 0 else [0.0005, 0.0])  # of the perspective
        off = A @ [0.3, -0.35]
        centre, map_, odds = verify.ellipses(verify.Picture(image), xy[n : n + 1] + off)
        assert np.linalg.norm(np.linalg.solve(A, centre[0] - xy[n])) < 0.15
        stretch = np.linalg.svd(np.linalg.solve(A, map_[0]), compute_uv=False)
        assert stretch == pytest.approx([1.0, 1.0], abs=0.2)
        assert odds[0] > 2


def test_a_symmetric_map_and_a_shift_within_it_move_a_pose():
    xy, A = verify.moved(
        np.array([[5.0, 6.0]]),
        np.array([[[0.0, -2.0], [2.0, 0.0]]]),
        np.array([[0.5, 0.0]], np.float32),
        np.array([np.diag([np.log(3), 0.0])], np.float32),
    )
    np.testing.assert_allclose(A[0], [[0.0, -2.0], [6.0, 0.0]], atol=1e-6)
    np.testing.assert_allclose(xy[0], [5.0, 9.0], atol=1e-6)


def test_a_second_look_shows_a_place_in_the_pose_that_it_is_given():
    image, xy, which = scene()
    picture, log_id = verify.Picture(image), np.log(np.full((2, len(PATCHES) + 1), 0.2))
    posed = verify.posed(picture, xy, np.full(2, SURE), log_id, PATCHES)
    posed = posed[posed.which == np.array(which)[posed.place]]
    same = verify.again(picture, posed, PATCHES)
    np.testing.assert_allclose(same.evidence, posed.evidence, atol=0.1)
    np.testing.assert_array_equal(same.view, posed.view)
    off = verify.again(picture, replace(posed, xy=posed.xy + 3.0), PATCHES)
    correlation = verify.POSED.index(verify.NCC)
    assert np.all(off.evidence[:, correlation] < posed.evidence[:, correlation] - 0.3)
    np.testing.assert_array_equal(off.at, posed.at)
    assert len(verify.again(picture, posed[:0], PATCHES)) == 0


def test_evidence_has_a_column_for_each_name_and_none_for_no_places():
    image, xy, _ = scene()
    log_id = np.log(np.full((2, len(PATCHES) + 1), 0.2))
    picture = verify.Picture(image)
    for count in (2, 0):
        posed = verify.posed(picture, xy[:count], np.full(count, SURE), log_id[:count], PATCHES)
        assert posed.evidence.shape == (len(posed), len(verify.POSED))
        assert sorted(set(posed.place.tolist())) == list(range(count))
        fitted = verify.fitted(picture, posed, np.zeros(len(posed)), PATCHES)
        assert fitted.evidence.shape == (len(posed), len(verify.FITTED))
        odds, corrected = verify.judged("fitted", fitted, PATCHES)
        assert odds.shape == (len(posed),)
        assert corrected.xy.shape == fitted.xy.shape


def test_a_clear_patch_is_named_by_its_pixels_however_sure_the_network_is_of_another():
    image, xy, which = scene()
    found = examined(image, xy, [0, 0], sure=0.9999)
    assert found.which[1] == which[1]


def test_what_lies_outside_the_image_is_no_evidence():
    image, xy, which = scene()
    cut = np.ascontiguousarray(image[:, 38:])  # the first centre lies 2 px inside
    log_id = np.log(np.full((1, len(PATCHES) + 1), 0.2))
    found = verify.posed(verify.Picture(cut), xy[:1] - [38, 0], np.array([SURE]), log_id, PATCHES)
    view = verify.inputs(found, PATCHES)["view"]
    assert np.isnan(found.view).any()
    assert not np.isnan(view).any()
    outside = np.isnan(found.view).reshape(len(found), 1, *view.shape[2:])
    assert (view[np.broadcast_to(outside, view.shape)] == 0).all()
    assert (view[:, 1:][~outside] != 0).mean() > 0.9
    assert which[0] in found.which


def test_a_hypothesis_is_compared_with_likely_ones_elsewhere():
    image, xy, which = scene()
    log_id = np.log(np.full((2, len(PATCHES) + 1), 0.2))
    picture = verify.Picture(image)
    posed = verify.posed(picture, xy, np.full(2, SURE), log_id, PATCHES)
    odds = np.where(posed.which == np.array(which)[posed.place], 9.0, -9.0)
    evidence = verify.fitted(picture, posed, odds, PATCHES).evidence
    columns = [n for n, name in enumerate(verify.FITTED) if "other" in name]
    patches, others, blur, contrast = evidence[odds > 0][:, columns].T
    np.testing.assert_allclose(patches, np.log(2), atol=0.01)
    np.testing.assert_allclose(others, np.log([1 + np.sum(posed.place[odds < 0] == k) for k in (1, 0)]), atol=0.01)
    np.testing.assert_allclose(blur[0], -blur[1], atol=0.01)
    np.testing.assert_allclose(contrast[0], -contrast[1], atol=0.01)
    alone = verify.fitted(picture, posed[:1], odds[:1], PATCHES).evidence[0, columns]
    np.testing.assert_array_equal(alone, np.zeros(4))


def test_a_design_is_shown_as_blurred_as_the_fit_found_the_image():
    image, xy, _ = scene()
    log_id = np.log(np.full((2, len(PATCHES) + 1), 0.2))
    posed = verify.posed(verify.Picture(image), xy, np.full(2, SURE), log_id, PATCHES)
    sharp = verify.inputs(posed, PATCHES)["view"]
    soft = verify.inputs(replace(posed, blur_px=np.full(len(posed), 4.0)), PATCHES)["view"]
    np.testing.assert_array_equal(soft[:, 0], sharp[:, 0])
    assert np.all(soft[:, 1].std(axis=(1, 2)) < 0.95 * sharp[:, 1].std(axis=(1, 2)))
