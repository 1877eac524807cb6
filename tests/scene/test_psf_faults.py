"""PSFs that were flipped, turned or left on a pedestal are named so, and others are not."""

import numpy as np
import pytest
from test_saturation import lopsided

import lnocl
from lnocl.core.scene.psf_faults import TURNS, name_faults

SHAPE, STARS, LEVEL = (60, 64), np.array([(22.3, 36.8), (41.7, 24.1)]), 50.0


def psf_of(size=41):
    """Return a PSF with a side lobe, which no turn or flip leaves as it is."""
    middle = size // 2
    psf = lopsided(middle, middle, (size, size))
    psf += 0.2 * lopsided(middle + 3.0, middle + 1.0, (size, size))
    return psf / psf.sum()


def observe(psf, n=2, flux=1e5, **known):
    light = np.full(SHAPE, LEVEL)
    for x, y in STARS:
        light += flux / 1.2 * (lopsided(x, y, SHAPE) + 0.2 * lopsided(x + 3.0, y + 1.0, SHAPE))
    images = np.random.default_rng(2).poisson(light, (n, *SHAPE)).astype(float)
    return lnocl.Observation(images, psf, background=LEVEL, **known)


@pytest.mark.parametrize("name", TURNS)
def test_turns_are_named_with_their_image(name):
    right = psf_of()
    undone = {"turned by 90 degrees": "turned by 270 degrees",
              "turned by 270 degrees": "turned by 90 degrees"}.get(name, name)  # fmt: skip
    said = name_faults(observe([right, TURNS[undone](right)]), STARS)
    assert said == f"`psfs[1]` fits when it is {name}: give it so"


def test_a_pedestal_is_named_with_its_share():
    said = name_faults(observe(psf_of() + 0.05 / 0.95 / 41**2, n=1), STARS)
    assert said == (
        "`psfs[0]` has a pedestal of 5 % of its light, level to its border: take that off, "
        "unless it is a halo"
    )


WRONG = {
    "right": psf_of(),
    "too wide": lopsided(20, 20, (41, 41), width=5.0),
    "another": lopsided(20, 20, (41, 41), width=2.5),
    "symmetric": np.exp(-np.hypot(*(np.indices((41, 41)) - 20)) / 2.0),
    "wings that are cut": lopsided(7, 7, (15, 15)),
}


@pytest.mark.parametrize("name", WRONG)
def test_other_faults_have_no_name(name):
    assert name_faults(observe(WRONG[name], n=1), STARS) == ""


@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
def test_the_verdict_says_it_in_place_of_a_better_psf():
    given = observe(psf_of()[:, ::-1], n=1)
    result = lnocl.deconvolve(given, STARS, engine="numpy", n_iter=30, smoothing=0.1, stop=None)
    (said,) = (line for line in result.verdict() if "does not fit" in line)
    assert said.endswith("psf 0 fits when it is flipped along x: give it so")
