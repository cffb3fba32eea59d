"""The plane across a direction: two unit vectors in it."""

import numba


@numba.njit(cache=True, error_model='numpy')
def fill_tangent(n, t):  # type: ignore[no-untyped-def]
    """Write two unit vectors that complete the unit vector ``n`` to a right-handed frame.

    Duff et al., Building an orthonormal basis, revisited, JCGT 2017: no direction is singular.
    """
    sign = 1.0 if n[2] >= 0.0 else -1.0
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    t[0, 0], t[0, 1], t[0, 2] = 1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]
    t[1, 0], t[1, 1], t[1, 2] = b, sign + n[1] * n[1] * a, -n[1]
