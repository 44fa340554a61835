"""Normal equations of three unknowns on plain numbers: numpy's calls take several times as long for so few."""

Three = tuple[float, float, float]

LEAST_PIVOT = 1e-12
"""Below it a pivot is what rounding has left: nothing is known of that unknown."""


def solve_three(matrix: tuple[float, float, float, float, float, float], side: Three) -> Three:
    """Solution x of A x = side, A symmetric and not negative, by L D L' (Golub and Van Loan, section 4.1).

    matrix : A's (aa, ab, ac, bb, bc, cc).
    """
    (a, b, c, d, e, f), (u, v, w) = matrix, side
    a, least_d, least_f = max(a, LEAST_PIVOT), LEAST_PIVOT * (1.0 + d), LEAST_PIVOT * (1.0 + f)
    ba, ca = b / a, c / a
    d, e, f = max(d - ba * b, least_d), e - ba * c, f - ca * c
    v, w = v - ba * u, w - ca * u
    ed = e / d
    z = (w - ed * v) / max(f - ed * e, least_f)
    y = v / d - ed * z
    return u / a - ba * y - ca * z, y, z
