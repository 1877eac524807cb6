"""Rings round stars."""

import numpy as np

from lnocl.core.scene.rings import Rings

SHAPE = (60, 70)
Y, X = np.indices(SHAPE)
STAR = np.array([(30.3, 28.6)])
R = np.hypot(X - STAR[0, 0], Y - STAR[0, 1])


def test_each_pixel_is_in_the_ring_of_its_distance():
    rings = Rings(SHAPE, STAR)
    assert (rings.edges[rings.number] <= R).all()
    assert (rings.edges[rings.number + 1] > R).all()
    widths = np.diff(rings.edges)
    assert widths[0] == 1.0
    np.testing.assert_allclose(widths, np.maximum(1.0, 0.15 * rings.edges[:-1]))
    assert len(rings) == rings.number.max() + 1


def test_each_pixel_is_in_a_ring_of_the_star_nearest_to_it():
    stars = np.array([(15.0, 30.0), (55.0, 30.0)])
    nearest = np.minimum(*(np.hypot(X - x, Y - y) for x, y in stars))
    rings = Rings(SHAPE, stars)
    np.testing.assert_array_equal(rings.number, np.digitize(nearest, rings.edges) - 1)
    np.testing.assert_allclose(rings.sums(nearest).sum(), nearest.sum())
