"""Division of scan lines into pieces, and block means, all at once, against one interval or one way after the other."""

import itertools
from dataclasses import replace

import numpy as np
from face_scenes import corridor_set

from bsmap_cli.fit import pieces
from bsmap_cli.fit.beams import make_grid
from bsmap_cli.fit.blocks import FEWEST, FEWEST_ROWS, LARGEST, LONGEST, make_blocks, single_beams, thinned


def holed_grid():
    """A grid of four scans with gaps of several widths, some to be bridged."""
    grid = make_grid(corridor_set(scans=4).cloud, np.arange(4))
    hit = grid.hit.copy()
    hit[0, 100:103] = hit[1, 200:230] = hit[2, :50] = hit[3, 300] = False
    return replace(grid, hit=hit, ranges=np.where(hit, grid.ranges, np.nan))


def test_gain_of_a_break_is_that_of_two_lines_over_one():
    moments = pieces._prefix_moments(holed_grid())
    gain = pieces._break_gain(moments)
    _, m, places = moments.shape
    rng = np.random.default_rng(0)
    for _ in range(300):
        k, row, at = rng.integers(len(pieces.WINDOWS)), rng.integers(m), rng.integers(places)
        low, high = max(at - pieces.WINDOWS[k], 0), min(at + pieces.WINDOWS[k], places - 1)
        before, here, behind = (moments[:, row, place] for place in (low, at, high))
        both, left, right = (pieces._chi_line(d[:, None])[0] for d in (behind - before, here - before, behind - here))
        few = here[10] - before[10] < 3 or behind[10] - here[10] < 3
        np.testing.assert_allclose(gain[k, row, at], 0.0 if few else both - left - right, atol=1e-6)


def test_stretches_end_at_gaps_too_wide_to_bridge():
    grid = holed_grid()
    found = list(zip(*(of.tolist() for of in pieces._stretches(grid.hit)), strict=True))
    assert found == [(0, 0, 541), (1, 0, 200), (1, 230, 541), (2, 50, 541), (3, 0, 541)]


def test_candidates_are_peaks_and_jumps_of_each_stretch_alone():
    grid = holed_grid()
    gain, stretches = pieces._break_gain(pieces._prefix_moments(grid)), pieces._stretches(grid.hit)
    for row, first, stop, found in zip(*stretches, pieces._candidates(grid, gain, stretches), strict=True):
        step = np.abs(np.diff(grid.ranges[row, first:stop]))
        expected = {first, stop}
        limit = 8.0 * grid.sigma + 3.0 * np.median(step[np.isfinite(step)])
        expected |= set((first + 1 + np.flatnonzero(step > limit)).tolist())
        for half, g in zip(pieces.WINDOWS, gain[:, row], strict=True):
            for at in range(first, stop + 1):
                reach = max(2, half // 4)
                around = g[max(first, at - reach) : min(stop, at + reach) + 1]
                if g[at] > pieces.CANDIDATE and g[at] >= around.max():
                    expected.add(at)
        assert found.tolist() == sorted(expected)


def test_the_cheapest_way_is_the_cheapest_of_all():
    rng = np.random.default_rng(1)
    costs = rng.uniform(size=(6, 7, 7)) * (1.0 + 3.0 * np.subtract.outer(np.arange(7), np.arange(7)) ** 2 / 36.0)
    before = pieces._cheapest(costs)
    for cost, back in zip(costs, before, strict=True):
        ways = [(0, *between, 6) for count in range(6) for between in itertools.combinations(range(1, 6), count)]
        best = min(ways, key=lambda way: sum(cost[b, a] for a, b in itertools.pairwise(way)))
        found = [6]
        while found[-1]:
            found.append(int(back[found[-1]]))
        assert found[::-1] == list(best)


def test_blocks_are_means_of_equal_shares_of_their_runs():
    grid = holed_grid()
    rng = np.random.default_rng(2)
    row, start = rng.integers(4, size=60), rng.integers(480, size=60)
    stop = start + rng.integers(1, 60, 60)
    blocks, beams = make_blocks(grid, row, start, stop), single_beams(grid, row, start, stop)
    at = single = 0
    for k, (r, a, b) in enumerate(zip(row, start, stop, strict=True)):
        seen = a + np.flatnonzero(grid.hit[r, a:b])
        one = slice(single, single + len(seen))
        single += len(seen)
        np.testing.assert_array_equal(beams.points[one], grid.points[r, seen])
        np.testing.assert_array_equal(beams.directions[one], grid.directions[r, seen])
        assert np.all(beams.owner[one] == k)
        assert np.all(beams.row[one] == r)
        np.testing.assert_array_equal(beams.column[one], seen)
        if not len(seen):
            continue
        metres = np.linalg.norm(grid.points[r, seen[-1]] - grid.points[r, seen[0]])
        share = min(max(int(np.ceil(max((b - a) / LARGEST, metres / LONGEST))), FEWEST), b - a)
        for part in range(share):
            mine = seen[(seen - a) * share // (b - a) == part]
            if len(mine):
                np.testing.assert_allclose(blocks.points[at], grid.points[r, mine].mean(axis=0), atol=1e-11)
                way = grid.directions[r, mine].mean(axis=0)
                np.testing.assert_allclose(blocks.directions[at], way / np.linalg.norm(way), atol=1e-11)
                assert (blocks.counts[at], blocks.row[at], blocks.owner[at]) == (len(mine), r, k)
                np.testing.assert_allclose(blocks.column[at], mine.mean(), atol=1e-9)
                at += 1
    assert (at, single) == (len(blocks.counts), len(beams.counts))


def test_blocks_of_close_scans_are_taken_together():
    scans = 120
    grid = make_grid(corridor_set(scans=scans).cloud, np.arange(scans))
    row = np.repeat(np.arange(scans), 2)
    start = np.tile([100, 230], scans)
    blocks = make_blocks(grid, row, start, start + np.tile([60, 40], scans))
    for beams, narrow in ((LARGEST, 0.05), (LARGEST, 1.0), (1, 0.1)):
        cell = (blocks.column / beams).astype(int)
        at = dict(zip(zip(blocks.row.tolist(), cell.tolist(), strict=True), blocks.points, strict=True))
        steps = [np.linalg.norm(at[r + 1, c] - place) for (r, c), place in at.items() if (r + 1, c) in at]
        together = int(min(narrow / np.quantile(steps, 0.95), (scans - 1) / FEWEST_ROWS)) + 1
        assert together > 1
        found = thinned(blocks, beams, narrow)
        groups = sorted(set(zip((blocks.row // together).tolist(), cell.tolist(), strict=True)))
        assert len(found.counts) == len(groups)
        for k, (group, c) in enumerate(groups):
            own = (blocks.row // together == group) & (cell == c)
            weight = blocks.counts[own]
            assert found.counts[k] == weight.sum()
            np.testing.assert_allclose(found.points[k], np.average(blocks.points[own], axis=0, weights=weight))
            way = np.average(blocks.directions[own], axis=0, weights=weight)
            np.testing.assert_allclose(found.directions[k], way / np.linalg.norm(way))
            assert found.row[k] == blocks.row[own][0]


def test_blocks_of_scans_far_apart_stay():
    grid = holed_grid()
    blocks = make_blocks(grid, np.arange(4), np.full(4, 100), np.full(4, 160))
    assert thinned(blocks) is blocks
