"""What a file keeps of a run: replicas and maps made of it are those of the run, bit for bit."""

import numpy as np
import pytest
import turned_scenes
from scenes import make_smooth_psfs
from scipy.ndimage import gaussian_filter

import lnocl
from lnocl.core.runs.replicas import Replicas
from lnocl.io.fitswrite import write_result
from lnocl.io.parts import Column, read_parts
from lnocl.result.kept import from_parts, to_parts
from lnocl.significance import significance

NY, NX, LEVEL = 40, 36, 12.0
STARS, FLUXES = [(9.0, 12.0), (25.4, 28.7)], [2e4, 4e4]
RUN = {"engine": "numpy", "pad": 0}


def images(psf, level=LEVEL, blur=0.0, seed=0):
    """Return counts of the stars, their light blurred, and of a source beside them."""
    means = np.zeros((NY, NX))
    for (x, y), flux in zip(STARS, FLUXES, strict=True):
        there = np.s_[int(y) - 8 : int(y) + 9, int(x) - 8 : int(x) + 9]
        means[there] += flux * psf
    means[24:30, 6:14] += 40.0
    return np.random.default_rng(seed).poisson(gaussian_filter(means, blur) + level).astype(float)


def psfs(n):
    found = make_smooth_psfs(n, (17, 17))
    return found / found.sum(axis=(1, 2), keepdims=True)


def mended():
    """PSFs are refined, held-out counts choose, the image is flipped."""
    (psf,) = psfs(1)
    seen = images(psf, blur=1.0)[:, ::-1], psf[:, ::-1]
    options = {"stop": "held-out", "n_iter": 99, "refine_psfs": ["jitter"]}
    flip = {"transforms": [[[-1.0, 0.0, NX - 1], [0.0, 1.0, 0.0]]]}
    return lnocl.Observation(*seen, background=LEVEL, **flip), STARS, options


def held():
    """PSFs are right, so that a prior holds the stars while held-out counts choose."""
    (psf,) = psfs(1)
    observation = lnocl.Observation(images(psf), psf, background=LEVEL, psf_centre="given")
    return observation, np.floor(STARS), {"stop": "held-out", "n_iter": 300}


def levelled():
    """A halo is held, the level is fitted, one PSF serves both images, and stars are moved."""
    (psf,), (y, x) = psfs(1), np.indices((NY, NX))
    halo = 1.0 / (4.0 + np.hypot(x - 9, 1.3 * (y - 12)))
    light = [images(psf, level, seed=seed) + 40.0 * halo for seed, level in enumerate((12, 15))]
    known = {"background": [11.0, 16.0], "background_error": [1.0, 1.0], "halos": halo}
    options = {"stop": None, "n_iter": 5, "refine_positions": True}
    return lnocl.Observation(light, psf, read_noise=2.0, **known), STARS, options


def turned():
    """Images are turned, one of them by more than half a right angle, masked, in two epochs."""
    maps = turned_scenes.transforms(turned_scenes.ANGLES + np.array([90, 0, 0]))
    observation = turned_scenes.observation(maps, epochs=[0, 1, 1], exposure=[1.0, 2.0, 0.5])
    return observation, turned_scenes.STARS, {"stop": None, "n_iter": 4, "smoothing": 0.1}


CASES = [mended, held, levelled, pytest.param(turned, marks=pytest.mark.exhaustive)]


def again_from(parts, given):
    return from_parts(parts, given, None, "single")


@pytest.fixture(scope="module", params=CASES)
def case(request, tmp_path_factory):
    """Return the outcome of a run, what it was given, and the parts that a file has of it."""
    path = str(tmp_path_factory.mktemp("kept") / "out.fits")
    observation, stars, options = request.param()
    outcome = lnocl.deconvolve(observation, stars, **{**RUN, **options})._outcome
    assert bool(outcome.scene.penalty.stars) == (request.param is held)
    parts = to_parts(outcome, observation)
    columns = [Column(name, value[None]) for name, value in parts.items()]
    write_result(path, np.ones((8, 8)), [], [], {"ESTIMATE": columns})
    read = read_parts(path, ["ESTIMATE"])["ESTIMATE"].values
    read = {name: np.asarray(values[0]) for name, values in read.items()}
    return outcome, request.param()[0], read, parts


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
def test_a_file_gives_the_outcome_of_the_run_back(case):
    outcome, given, read, written = case
    assert read.keys() == written.keys()
    for name, values in written.items():
        assert read[name].dtype == values.dtype, name
        np.testing.assert_array_equal(read[name], values, name)
    found = again_from(read, given)
    again = to_parts(found, given)
    assert again.keys() == written.keys()
    for name, values in written.items():
        np.testing.assert_array_equal(again[name], values, name)
    for name, values in vars(outcome.observation).items():
        if isinstance(values, np.ndarray):
            np.testing.assert_array_equal(getattr(found.observation, name), values, name)
    assert found.observation.psfs.strides == outcome.observation.psfs.strides
    if (before := outcome.psf_refinement) is not None:
        after = found.psf_refinement
        assert (after.parameters, after.misfit) == (before.parameters, before.misfit)
        assert after.is_accepted


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
def test_maps_and_replicas_of_both_are_equal(case):
    outcome, given, parts, _ = case
    found = again_from(parts, given)
    maps, others = (significance(each, 0.0, 0.01) for each in (outcome, found))
    for name in ("signal_to_noise", "flux", "flux_error", "threshold"):
        np.testing.assert_array_equal(getattr(maps, name), getattr(others, name), name)
    np.testing.assert_array_equal(maps.limit(0.9), others.limit(0.9))
    np.testing.assert_equal(found.star_errors(), outcome.star_errors())
    one, other = (Replicas(each, 3).reconstruct(2)[0] for each in (outcome, found))
    np.testing.assert_equal(one, other)


@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
def test_stored_run_of_other_images_or_version_or_damaged_is_not_used(case, monkeypatch):
    _, given, parts, _ = case
    counts = given.images.copy()
    counts[0, 20, 20] += 1e-9
    assert again_from(parts, given.replace(images=counts)) is None
    assert again_from({**parts, "estimate.sky": parts["estimate.sky"][:-1]}, given) is None
    assert again_from({**parts, "setup.solver": np.asarray("sgm")}, given) is None
    assert again_from({name: parts[name] for name in parts if name != "positions"}, given) is None
    assert again_from({**parts, "digest": np.ones(3)}, given) is None
    assert again_from({}, given) is None
    monkeypatch.setattr("lnocl.result.kept.version", lambda name: "0.0.1")
    assert again_from(parts, given) is None
