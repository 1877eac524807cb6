"""No scene breaks the arithmetic: a finite answer, or a refusal before the run."""

import warnings

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scenes import FEWER_ENGINES, blur, make_psfs, paper, worst

import lnocl
from lnocl.core.opencl import program
from lnocl.core.scene.penalty import MAX_WEIGHT

SHAPE = (16, 32)
PSFS = make_psfs(2, (7, 8))
STARS = ((9, 6), (20, 11))
MASK = np.random.default_rng(8).random((2, *SHAPE)) < 0.05
every_engine = pytest.mark.parametrize("engine", FEWER_ENGINES)


def logarithmic(least, most):
    """Powers of ten between two exponents."""
    return st.floats(least, most).map(lambda exponent: 10.0**exponent)


def deconvolve(
    engine, images, psfs=PSFS, stars=STARS, n_iter=30, mask=None, background=0.0, **more
):
    """Run, and see that the answer is sound."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lnocl.LnoclWarning)
        observation = lnocl.Observation(images, psfs, background=background, mask=mask)
        result = paper(observation, stars=stars, n_iter=n_iter, **engine, **more)
    for values in (result.extended, result.star_fluxes, result.history["objective"]):
        assert np.isfinite(values).all()
    assert (result.extended >= 0).all()
    assert (result.star_fluxes >= 0).all()
    return result


def jet():
    """A narrow bright ridge on a dark sky, of unit mean."""
    y, x = np.indices(SHAPE)
    ridge = np.exp(-0.5 * ((y - 7 - 2 * np.sin(x / 5)) / 0.8) ** 2) * (1.1 + np.cos(x))
    return ridge / ridge.mean()


def expose(counts, contrast, background, seed=0):
    """Poisson images of the jet and of stars `contrast` times as bright as it, and mean counts."""
    sky = counts * jet()
    for x, y in STARS:
        sky[y, x] += contrast * counts * sky.size
    means = np.array([blur(sky, psf) for psf in PSFS]) + background
    return np.random.default_rng(seed).poisson(np.maximum(means, 0.0)).astype(float)


@every_engine
@given(
    counts=logarithmic(-3, 12),
    contrast=logarithmic(0, 5),
    share=st.just(0.0) | logarithmic(-6, 6),
    mu=logarithmic(-12, 6),
    seed=st.integers(0, 100),
)
@example(counts=1e-3, contrast=1.0, share=0.0, mu=1e-12, seed=0)
@example(counts=1e12, contrast=1.0, share=0.0, mu=1e6, seed=0)
@example(counts=1e3, contrast=1e8, share=1e-3, mu=1e-12, seed=0)
@example(counts=1e3, contrast=1e8, share=0.0, mu=1e-8, seed=0)
def test_counts_contrast_background_and_mu(engine, counts, contrast, share, mu, seed):
    background = share * counts
    images = expose(counts, contrast, background, seed)
    if mu * 2.0 ** np.frexp(images[~MASK].mean())[1] <= MAX_WEIGHT:
        deconvolve(engine, images, mask=MASK, background=background, mu=mu)
    else:
        with pytest.raises(lnocl.InputError, match=r"mu .* is too large for images"):
            deconvolve(engine, images, mask=MASK, background=background, mu=mu)


def one_hot_pixel():
    images = np.zeros((2, *SHAPE))
    images[0, 3, 5] = 1e9
    return images


IMAGES = {
    "zeros": np.zeros((2, *SHAPE)),
    "one count in all": np.eye(1, 2 * SHAPE[0] * SHAPE[1]).reshape(2, *SHAPE),
    "one hot pixel": one_hot_pixel(),
    "saturated": np.minimum(expose(1e4, 1.0, 10.0), 6e4),
    "saturated everywhere": np.full((2, *SHAPE), 65535.0),
    "subnormal": expose(10.0, 1.0, 1.0) * 5e-324,
    "very small": expose(10.0, 1.0, 1.0) * 1e-300,
    "very large": expose(10.0, 1.0, 1.0) * 1e26,
}


@every_engine
@pytest.mark.parametrize("solver", ["sgm", "sgp"])
@pytest.mark.parametrize("background", [0.0, 1.0])
@pytest.mark.parametrize("images", IMAGES.values(), ids=IMAGES)
def test_images(engine, solver, images, background):
    mean = images.mean()
    mu = 1e-3 / max(mean, 1e-20)  # of any size, so that it is one program
    level = background * mean
    deconvolve(engine, images, mask=MASK, background=level, mu=mu, solver=solver)


@pytest.mark.exhaustive
def test_the_brightest_images_are_fitted_and_written(tmp_path):
    """Squares of counts were infinite in the fit of stars, and sums in the file."""
    images = expose(1.0, 1.0, 0.0)[0]
    observation = lnocl.Observation(images * (1e30 / images.max()), PSFS[:1], background=1e29)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lnocl.LnoclWarning)
        result = lnocl.deconvolve(
            observation, STARS[:1], refine_psfs=(), engine="numpy", stop=None, n_iter=2
        )
    result.write(tmp_path / "a.fits")
    assert np.isfinite(result.star_fluxes).all()


def wings(value):
    """A PSF on the whole grid, far wings replaced by a value."""
    psfs = make_psfs(2, SHAPE)
    return np.where(psfs < 1e-4, value, psfs)


PSF_KINDS = {
    "one pixel": np.ones((1, 1)),
    "delta in zeros": np.pad(np.ones((1, 1)), 7),
    "exact zeros": wings(0.0),
    "tiny negative wings": wings(-1e-9),
    "negative wings": wings(-1e-5),
    "subnormal wings": wings(1e-310),
    "flat": np.ones(SHAPE),
}


@every_engine
@pytest.mark.parametrize("background", [0.0, 5.0])
@pytest.mark.parametrize("psfs", PSF_KINDS.values(), ids=PSF_KINDS)
def test_psfs(engine, psfs, background):
    images = expose(100.0, 1.0, 0.0) + background
    deconvolve(engine, images, psfs, mask=MASK, background=background, mu=1e-6)


def test_psfs_wider_than_the_images():
    images = expose(100.0, 1.0, 5.0)
    deconvolve({"engine": "numpy"}, images, make_psfs(2, (41, 77)), mask=MASK, background=5.0)


@every_engine
@pytest.mark.parametrize(
    "stars",
    [
        ((0, 0), (31, 15)),
        ((31, 0), (0, 7)),
        ((9, 6), (10, 6)),
        ((9, 6), (9, 6.25)),
    ],
    ids=["corners", "corner and edge", "neighbours", "the same pixel"],
)
def test_stars(engine, stars):
    deconvolve(engine, expose(100.0, 1.0, 1.0), stars=stars, mask=MASK, background=1.0, mu=1e-6)


@every_engine
def test_star_on_a_masked_pixel(engine):
    mask = MASK.copy()
    mask[:, STARS[0][1], STARS[0][0]] = True
    deconvolve(engine, expose(100.0, 1.0, 1.0), mask=mask, background=1.0, mu=1e-6)


@pytest.mark.exhaustive
def test_subnormals_may_be_flushed(monkeypatch):
    """A device that has no subnormals gives the same answer."""
    images = expose(100.0, 1.0, 0.0)
    engine = {"engine": "opencl", "precision": "single"}
    expected = deconvolve(engine, images, mask=MASK, mu=1e-6, n_iter=300)
    build = program._build
    monkeypatch.setattr(
        program,
        "_build",
        lambda context, text, options: build(context, text, (*options, "-cl-denorms-are-zero")),
    )
    result = deconvolve(engine, images, mask=MASK, mu=1e-6, n_iter=300)
    assert worst(result.extended, expected.extended) <= 1e-6
    assert worst(result.star_fluxes, expected.star_fluxes) <= 1e-6


def test_single_precision_is_warned_of_in_very_long_runs():
    observation = lnocl.Observation(np.ones((2, *SHAPE)), np.ones((1, 1)), mask=MASK)
    once = {"callback": lambda *_: True, "stars": STARS, "mu": 1e-6}
    with pytest.warns(lnocl.LnoclWarning, match="stray from double by 0.002 of the extended"):
        paper(observation, n_iter=200_000, **once)
    paper(observation, n_iter=100_000, **once)
    paper(observation, n_iter=200_000, engine="numpy", precision="double", **once)


@pytest.mark.exhaustive
@pytest.mark.parametrize("precision", ["single", "double"])
def test_a_hundred_thousand_iterations(precision):
    engine = {"engine": "opencl", "precision": precision}
    images = expose(100.0, 10.0, 1.0)
    deconvolve(engine, images, mask=MASK, background=1.0, mu=1e-6, n_iter=100_000)


@pytest.mark.exhaustive
@pytest.mark.parametrize("shape", [(4096, 4096), (8192, 2), (1, 8192)])
def test_sizes(shape):
    images = np.random.default_rng(1).poisson(3.0, shape).astype(float)
    stars = ((shape[1] - 1, shape[0] - 1),)
    deconvolve({"engine": "opencl"}, images, PSFS[0], stars=stars, background=0.5, n_iter=2)
