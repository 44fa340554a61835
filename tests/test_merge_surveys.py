"""Surveys over time folded into one map: it gets better and does not grow, and what moved is not averaged."""

from dataclasses import replace

import numpy as np
import pytest
from face_maps import SIGMA, floor, map_of, wall

from bsmap_cli.core.uncertainty import is_plane, surface_covariance
from bsmap_cli.merge import merge_surfaces
from bsmap_cli.params import MergeParams

POSE = np.diag([0.002**2, 0.002**2, 1e-8])


def survey(rng, *, cupboard=None):
    """A wall and a floor seen by two data sets with noise and errors of pose, and a cupboard at a distance from it."""
    seen = []
    for name, (start, end) in {"set-01": (0.0, 4.0), "set-02": (1.0, 5.0)}.items():
        error = rng.normal(0.0, 0.002)
        noise = error + rng.normal(0.0, SIGMA, (2, 2))
        seen += [wall(f"{name}/01", start, end, pose=POSE, noise=noise), floor(f"{name}/02", start, end, pose=POSE)]
        if cupboard is not None:
            noise = error + rng.normal(0.0, SIGMA, (2, 2))
            seen.append(wall(f"{name}/03", 6.0, 7.0, offset=cupboard, heights=(0.0, 1.0), pose=POSE, noise=noise))
    return map_of(*seen)


def folded(surveys):
    made = merge_surfaces(surveys[:1], MergeParams())
    for one in surveys[1:]:
        made = merge_surfaces([made, one], MergeParams())
    return made


def corners(surface):
    """Control points (n, 3), sorted by place: the axes of a base may be turned."""
    P = surface.control_points.reshape(-1, 3)
    return P[np.lexsort(P.round(2).T)]


def wall_of(surface_map):
    (face,) = [s for s in surface_map.surfaces if np.ptp(s.control_points[..., 1]) < 0.1]
    return face


def variance(surface_map):
    """Of the wall across, amid it: sensor and pose part."""
    return surface_covariance(wall_of(surface_map), np.array([0.5]), np.array([0.5]))[0, 1, 1]


def test_map_does_not_grow_and_gets_surer_where_a_place_is_surveyed_again():
    rng = np.random.default_rng(0)
    surveys = [survey(rng) for _ in range(8)]
    once, often = folded(surveys[:1]), folded(surveys)
    assert len(often.surfaces) == len(once.surfaces) == 2
    assert [s.name for s in often.surfaces] == [s.name for s in once.surfaces]
    assert [d.name for d in often.data_sets] == ["set-01", "set-02"]
    assert [d.points for d in often.data_sets] == [8 * d.points for d in once.data_sets]
    assert {part.data_set for s in often.surfaces for part in s.covariance.pose} == {"set-01", "set-02"}
    assert variance(often) == pytest.approx(variance(once) / 8, rel=0.1)


def test_folding_one_by_one_gives_what_joining_all_at_once_gives():
    rng = np.random.default_rng(1)
    surveys = [survey(rng) for _ in range(5)]
    one_by_one, at_once = folded(surveys), merge_surfaces(surveys, MergeParams())
    assert variance(one_by_one) == pytest.approx(variance(at_once), rel=0.05)
    assert len(one_by_one.surfaces) == len(at_once.surfaces)
    a, b = wall_of(one_by_one), wall_of(at_once)
    np.testing.assert_allclose(np.diag(a.covariance.matrix), np.diag(b.covariance.matrix), rtol=0.05)
    np.testing.assert_allclose(corners(a), corners(b), atol=1e-4)


def test_wall_known_as_a_plane_stays_one_unless_all_surveys_together_tell_otherwise():
    """A twist that no survey tells alone: eight of them do; and one survey that errs bends no wall that is known."""
    shape = np.array([[1.0, -1.0], [-1.0, 1.0]])
    plane = merge_surfaces([map_of(wall("set-01/01", 0.0, 4.0), wall("set-02/01", 0.0, 4.0))], MergeParams())
    for _ in range(7):
        plane = merge_surfaces([plane, map_of(wall("set-01/01", 0.0, 4.0))], MergeParams())
    assert is_plane(wall_of(plane).covariance.matrix)
    off = 4.0 * SIGMA * shape / 4.0  # a twist of two standard deviations
    once = merge_surfaces([plane, map_of(wall("set-01/01", 0.0, 4.0, noise=1.5 * off))], MergeParams())
    assert is_plane(wall_of(once).covariance.matrix)
    bent = [map_of(wall(f"set-{k:02}/01", 0.0, 4.0, noise=off)) for k in range(8)]
    assert not is_plane(wall_of(merge_surfaces(bent, MergeParams())).covariance.matrix)


def common(surface, modes, trajectory):
    """The wall with an error of pose that the other data sets of its trajectory have, too."""
    (part,) = surface.covariance.pose
    part = replace(part, covariance=part.covariance + modes @ modes.T, modes=modes, trajectory=trajectory)
    return replace(surface, covariance=replace(surface.covariance, pose=(part,)))


def test_what_a_trajectory_has_in_common_averages_over_surveys_only():
    """Each survey's two data sets err by 5 mm together: four surveys halve that, eight data sets do no more."""
    modes = np.array([[0.005, 0.0], [0.0, 0.005], [0.0, 0.0]])
    rng = np.random.default_rng(2)
    surveys = []
    for number in range(4):
        made, error = survey(rng), np.array([0.0, rng.normal(0.0, 0.005), 0.0])
        moved = (replace(s, control_points=s.control_points + error) for s in made.surfaces)
        surveys.append(replace(made, surfaces=tuple(common(s, modes, f"t{number}") for s in moved)))
    once, often = folded(surveys[:1]), folded(surveys)
    own = variance(folded([survey(rng)]))
    assert variance(once) == pytest.approx(0.005**2 + own, rel=0.02)
    assert variance(often) == pytest.approx(variance(once) / 4, rel=0.1)
    (name,) = {part.trajectory for s in often.surfaces for part in s.covariance.pose}
    assert len(name) == 8


@pytest.mark.slow
def test_covariance_after_four_surveys_is_that_of_the_errors():
    """Of the wall amid its face, sensor and pose together, over seeds."""
    ratios = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        made = folded([survey(rng) for _ in range(4)])
        ratios.append(wall_of(made).control_points[..., 1].mean() ** 2 / variance(made))
    assert 0.5 < np.mean(ratios) < 1.7  # chi-square of 20 degrees of freedom, 98%


def test_survey_of_another_place_keeps_its_data_sets():
    old = folded([survey(np.random.default_rng(0))])
    elsewhere = map_of(wall("set-01/01", 10.0, 14.0, pose=POSE), wall("set-02/01", 11.0, 15.0, pose=POSE))
    result = merge_surfaces([old, elsewhere], MergeParams())
    assert [d.name for d in result.data_sets] == ["set-01", "set-02", "2.set-01", "2.set-02"]


def test_small_face_that_one_survey_saw_alone_does_not_keep_its_data_set_apart():
    """After four surveys the others have a fifth of a weight in each face, and it has all of that of its own."""
    rng = np.random.default_rng(4)
    old = folded([survey(rng, cupboard=0.5) for _ in range(4)])
    new = survey(rng, cupboard=0.5)
    alone = wall("set-02/09", 9.0, 9.2, heights=(0.0, 0.3), pose=POSE)
    pose = next(s.covariance.pose for s in new.surfaces if s.name == "set-02/03")
    alone = replace(alone, covariance=replace(alone.covariance, pose=pose))
    result = merge_surfaces([old, map_of(*new.surfaces, alone)], MergeParams())
    assert len(result.surfaces) == 4
    assert [d.name for d in result.data_sets] == ["set-01", "set-02"]


def test_old_map_and_new_survey_may_be_given_in_any_order():
    rng = np.random.default_rng(2)
    old, new = folded([survey(rng)]), survey(rng)
    one, other = merge_surfaces([old, new], MergeParams()), merge_surfaces([new, old], MergeParams())
    assert [s.name for s in one.surfaces] == [s.name for s in other.surfaces]
    for a, b in zip(one.surfaces, other.surfaces, strict=True):
        np.testing.assert_allclose(a.control_points, b.control_points, rtol=0, atol=1e-9)


def test_cupboard_that_moved_is_told_and_not_averaged():
    rng = np.random.default_rng(3)
    old = folded([survey(rng, cupboard=0.5)])
    result = merge_surfaces([old, survey(rng, cupboard=0.54)], MergeParams())
    (moved,) = [d for d in result.decisions if "moved" in d.reason]
    assert moved.figures["offset"] == pytest.approx(0.04, abs=0.004)
    assert moved.figures["squared_mahalanobis"] > 20.0
    levels = sorted(s.control_points[..., 1].mean() for s in result.surfaces if s.control_points[0, 0, 0] > 5.9)
    np.testing.assert_allclose(levels, [0.5, 0.54], atol=0.006)
    again = merge_surfaces([result, survey(rng, cupboard=0.54)], MergeParams())
    assert len(again.surfaces) == len(result.surfaces)
    assert not [d for d in again.decisions if "moved" in d.reason]


def test_cupboard_that_may_have_moved_by_what_nobody_can_tell_is_averaged():
    rng = np.random.default_rng(4)
    old = folded([survey(rng, cupboard=0.5)])
    result = merge_surfaces([old, survey(rng, cupboard=0.502)], MergeParams())
    assert not [d for d in result.decisions if "moved" in d.reason]
    assert len(result.surfaces) == 3
