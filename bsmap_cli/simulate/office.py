"""A floor of offices, 72 m by 50 m: four corridors along x, four across, offices along the first; 1 km of way in loops.

Laid out by rules and a generator with a fixed seed, as so large a scene cannot be told box by box.
"""

from itertools import pairwise

import numpy as np

from bsmap_cli.simulate.geometry import Cut, room, solid

WIDTH = 2.2
"""Metres, of the corridors."""
ROWS, COLUMNS = (0.0, 16.0, 32.0, 48.0), (0.0, 24.0, 48.0, 69.8)
"""y and x at which corridors along and across begin."""
HEIGHT, DOOR_HEIGHT, DOOR_WIDTH, WALL = 2.6, 2.05, 0.9, 0.12
DEPTH = 5.5
"""Metres, of the offices."""


def office_cuts() -> list[Cut]:
    """Corridors, offices and what stands in them."""
    rng = np.random.default_rng(20)
    far_x, far_y = COLUMNS[-1] + WIDTH, ROWS[-1] + WIDTH
    cuts = [room(0.0, far_x, y, y + WIDTH, 0.0, HEIGHT) for y in ROWS]
    cuts += [room(x, x + WIDTH, 0.0, far_y, 0.0, HEIGHT) for x in COLUMNS]
    for begin, end in pairwise(COLUMNS):
        for row, y in enumerate(ROWS):
            if row < len(ROWS) - 1:
                cuts += _offices(rng, begin + WIDTH, end, y + WIDTH, 1)
            if row > 0:
                cuts += _offices(rng, begin + WIDTH, end, y, -1)
    return cuts + _pilasters(rng)


def _offices(rng: np.random.Generator, start: float, stop: float, wall: float, side: int) -> list[Cut]:
    """A row of offices behind the corridor's wall at y = `wall`, on the side +1 or -1; three in four doors are open."""
    cuts = []
    x = start + 0.3
    while x + 3.0 < stop:
        width = min(float(rng.uniform(2.8, 5.6)), stop - 0.3 - x)
        near, far = wall + side * WALL, wall + side * (WALL + float(rng.uniform(3.5, DEPTH)))
        door = x + float(rng.uniform(0.2, width - DOOR_WIDTH - 0.2))
        if rng.random() < 0.75:
            cuts += [_box(True, x, x + width, near, far, HEIGHT), _box(True, door, door + DOOR_WIDTH, wall, near)]
            desk = x + float(rng.uniform(0.0, width - 1.4))
            cuts.append(_box(False, desk, desk + 1.4, far - side * 0.8, far, 0.75))
        else:
            cuts.append(_box(True, door, door + DOOR_WIDTH, wall, wall + side * 0.08))
        x += width + WALL
    return cuts


def _pilasters(rng: np.random.Generator) -> list[Cut]:
    """Pilasters at the walls of the corridors, and radiators, at places without order."""
    cuts = []
    for y in ROWS:
        for x in rng.uniform(4.0, COLUMNS[-1] - 4.0, 6):
            if min(abs(x - c - WIDTH / 2) for c in COLUMNS) > WIDTH:
                size, top = float(rng.uniform(0.2, 0.5)), HEIGHT if rng.random() < 0.5 else 0.8
                at = y if rng.random() < 0.5 else y + WIDTH - 0.15
                cuts.append(solid(float(x), float(x) + size, at, at + 0.15, 0.0, top))
    return cuts


def _box(free: bool, x0: float, x1: float, one: float, other: float, height: float = DOOR_HEIGHT) -> Cut:
    low, high = min(one, other), max(one, other)
    return (room if free else solid)(x0, x1, low, high, 0.0, height)


def office_way() -> list[list[float]]:
    """Waypoints along the middle of the corridors: 1 km, every corridor at least once, most of them twice."""
    columns = (0, 3, 3, 0, 0, 3, 3, 0, 0, 1, 1, 2, 2, 3, 3, 0, 0, 3, 3, 0, 0, 2, 2, 1, 1, 2)
    rows = (0, 0, 1, 1, 2, 2, 3, 3, 0, 0, 3, 3, 0, 0, 3, 3, 1, 1, 0, 0, 2, 2, 1, 1, 0, 0)
    return [[COLUMNS[i] + WIDTH / 2, ROWS[j] + WIDTH / 2] for i, j in zip(columns, rows, strict=True)]
