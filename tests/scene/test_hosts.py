"""The light of a host: what lies all round a star and falls, and not jets, rings or flat skies."""

import numpy as np
import pytest

from lnocl.core.scene.hosts import light_of_host

N, STAR, WIDTH = 61, (29.3, 30.6), 4.0
ROWS, COLUMNS = np.arange(N)[:, None] - STAR[1], np.arange(N) - STAR[0]
R, TURN = np.hypot(ROWS, COLUMNS), np.arctan2(ROWS, COLUMNS)
HOST = np.exp(-R / 6.0)
JET = np.exp(-((TURN - 1.0) ** 2) / 0.1 - R / 20.0)
RING = np.exp(-((R - 14.0) ** 2) / 20.0) * (1.0 + 0.5 * np.cos(TURN))


def host(sky, hidden=0.0):
    return light_of_host(sky, ROWS, COLUMNS, WIDTH, hidden)


def test_a_host_has_the_light_that_it_has_round_the_star():
    is_round = (R > 0.85 * WIDTH) & (R <= 1.65 * WIDTH)
    within = np.count_nonzero(R <= 1.65 * WIDTH)
    assert host(HOST) == pytest.approx(HOST[is_round].mean() * within, rel=0.05)
    assert host(3.0 * HOST) == pytest.approx(3.0 * host(HOST))


@pytest.mark.parametrize("sky", [JET, RING, np.ones((N, N)), np.zeros((N, N))])
def test_one_sided_annular_and_flat_light_is_no_host(sky):
    assert host(sky) < 1e-3 * host(HOST)


def test_a_jet_beside_a_host_adds_little_to_it():
    assert host(HOST + JET) == pytest.approx(host(HOST), rel=0.05)


def test_a_bright_jet_far_off_on_one_side_does_not_hide_a_host():
    """The mean of all that is far off is then above what lies all round the star."""
    far_jet = 20.0 * JET * (R > 2.0 * WIDTH)
    assert host(HOST + far_jet) == pytest.approx(host(HOST), rel=0.01)


def test_where_nothing_is_observed_belongs_to_the_star():
    hidden = 5.0
    seen = HOST * (hidden < R)
    is_round = (R - hidden > 0.85 * WIDTH) & (R - hidden <= 1.65 * WIDTH)
    within = np.count_nonzero(R - hidden <= 1.65 * WIDTH)
    assert host(seen, hidden) == pytest.approx(HOST[is_round].mean() * within, rel=0.05)
