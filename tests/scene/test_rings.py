"""Rings round stars: what lies all round them, and medians."""

import numpy as np
import pytest

from lnocl.scene.rings import Rings, medians

SHAPE = (60, 70)
Y, X = np.indices(SHAPE)
STAR = np.array([(30.3, 28.6)])
R = np.hypot(X - STAR[0, 0], Y - STAR[0, 1])
HALO = 50.0 * np.exp(-R / 6.0)


def test_each_pixel_is_in_the_ring_of_its_distance():
    rings = Rings(SHAPE, STAR)
    assert (rings.edges[rings.number] <= R).all()
    assert (rings.edges[rings.number + 1] > R).all()
    widths = np.diff(rings.edges)
    assert widths[0] == 1.0
    np.testing.assert_allclose(widths, np.maximum(1.0, 0.15 * rings.edges[:-1]))
    assert len(rings) == rings.number.max() + 1


def test_what_lies_all_round_a_star_is_found():
    found = Rings(SHAPE, STAR).round_stars(HALO + 7.0, 0.4)
    near = R < 20
    assert abs(found - HALO)[near].max() < 0.12 * HALO.max()
    assert found.min() == 0


def test_one_side_a_level_and_what_rises_outwards_are_not():
    rings = Rings(SHAPE, STAR)
    jet = 40.0 * ((abs(X - 30) < 4) & (Y > 29))
    ring = 30.0 * np.exp(-((R - 15.0) ** 2) / 8.0)
    for other in (jet, np.full(SHAPE, 9.0), R):
        np.testing.assert_allclose(rings.round_stars(other, 0.4), 0.0, atol=1e-12)
    # A ring adds its light to nothing inside or outside itself.
    assert rings.round_stars(HALO + ring, 0.4)[(R > 13) & (R < 17)].max() < 12.0
    assert rings.round_stars(ring, 0.4).max() < 0.05 * ring.max()


def test_each_star_has_its_own():
    stars = np.array([(15.0, 30.0), (55.0, 30.0)])
    halos = [
        flux * np.exp(-np.hypot(X - x, Y - y) / 3.0)
        for (x, y), flux in zip(stars, (90.0, 30.0), strict=True)
    ]
    found = Rings(SHAPE, stars).round_stars(halos[0] + halos[1], 0.4)
    assert found[30, 15] == pytest.approx(90.0, rel=0.3)
    assert found[30, 55] == pytest.approx(30.0, rel=0.3)


def test_medians_are_those_of_each_number():
    number, values = np.array([3, 1, 1, 3, 1, 0]), np.array([5.0, 2.0, 9.0, 7.0, 4.0, 1.0])
    np.testing.assert_array_equal(medians(number, values), [1.0, 4.0, 0.0, 6.0])
    assert len(medians(np.zeros(0, int), np.zeros(0))) == 1
