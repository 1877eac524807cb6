"""The verdict on a result: what it says of stars and residuals, and that runs warn of it."""

import warnings
from types import SimpleNamespace

import numpy as np
import pytest
from scenes import make_psfs

import lnocl
from lnocl.commands import cli
from lnocl.residuals import Fit, StarResiduals
from lnocl.result.verdict import _elsewhere, faults, is_doubt

N, STAR, LEVEL = 48, (21, 26), 20.0
Y, X = np.indices((N, N))
RUN = {"engine": "numpy", "pad": 0, "n_iter": 60}


def star(flux=4e4, widen=1.0):
    """Return an image of a star through a lopsided PSF, of which another is known, and that PSF."""
    u, v = X - N // 2, Y - N // 2
    wide, known = (
        np.exp(-0.5 * ((u / (1.8 * w)) ** 2 + (v / (1.2 * w)) ** 2))
        + 0.3 * np.exp(-0.5 * ((u - 3) ** 2 + (v + 2) ** 2) / w**2)
        for w in (widen, 1.0)
    )
    shift = STAR[1] - N // 2, STAR[0] - N // 2
    means = LEVEL + flux * np.roll(wide / wide.sum(), shift, (0, 1))
    return np.random.default_rng(0).poisson(means).astype(float), known


def solve(image, psf, background=LEVEL, **options):
    """Return a result and what was warned of."""
    observation = lnocl.Observation(image, psf, background=background, psf_centre="given")
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        result = lnocl.deconvolve(observation, [STAR], **RUN, **options)
    return result, [str(each.message) for each in warned]


def test_fitting_model_has_a_good_verdict_and_no_warning():
    result, warned = solve(*star(), smoothing=0.1)
    assert result.verdict() == ["the model fits"]
    assert warned == []


@pytest.mark.exhaustive
def test_a_run_warns_of_each_fault_of_its_verdict():
    image, psf = star(widen=1.25)
    result, warned = solve(image, psf, smoothing=3.0, stop=None)
    assert max(found.core.rms for found in result.star_residuals()) > 3
    (line,) = (each for each in result.verdict() if each.startswith("the model does not fit at 1"))
    assert line.endswith("of 1 star, (21, 26): give a better PSF, or try refine_psfs jitter pixels")
    assert warned[-len(result.verdict()) :] == result.verdict()
    _, warned = solve(image, psf, smoothing=3.0, stop=None, refine_psfs=["pixels"])
    assert not any("refine_psfs" in each for each in warned)


def test_star_without_light_is_reported():
    """Iterations that multiply leave 1e-63 of it."""
    image, psf = star(flux=0.0)
    image[STAR[1] - 3 : STAR[1] + 4, STAR[0] - 3 : STAR[0] + 4] = 0.0
    beside = np.roll(psf / psf.sum(), (30 - N // 2, 18 - N // 2), (0, 1))
    image += np.random.default_rng(5).poisson(4e3 * beside)
    _, warned = solve(image, psf, smoothing=0.0, stop=None)
    assert any(
        each.startswith("no light is left for 1 star: (21, 26), and the brightest light within 10")
        and "lies at (18, 30)" in each
        for each in warned
    )


def test_light_beside_a_place_without_any_is_named_in_pixels_of_the_images():
    sky = np.zeros((64, 80))
    sky[36:38, 43] = 3.0, 9.0
    assert "pixels lies at (21.25, 18.25): give" in _elsewhere(sky, np.array([20.0, 21.0]), 2)


@pytest.fixture
def nameless(monkeypatch):
    """The fault of the PSF is of no kind that has a name."""
    monkeypatch.setattr("lnocl.core.scene.psf_faults.name_faults", lambda *_: "")


def observed(*labels, psf_error=0.0):
    """Return what a verdict asks of an observation."""
    return SimpleNamespace(
        n_epochs=len(labels),
        epoch_labels=labels,
        epoch_word="epoch",
        star_places=(),
        psf_error=psf_error,
    )


def test_a_star_that_moved_as_far_as_stars_may_is_named_first(nameless):
    def at(*given):
        bad = StarResiduals(Fit(100, 900.0, 200.0), Fit(), 0.0, 0.0)
        result = SimpleNamespace(
            star_positions=np.array([(10.0, 13.0)]),
            star_fluxes=np.array([5.0]),
            extended=np.ones((32, 32)),
            psf_refinement=None,
            smoothing=0.0,
            star_residuals=lambda: [bad],
            fit=Fit,
            _findings=SimpleNamespace(
                given_positions=np.array([given]),
                may_free_pixels=True,
                observation=observed("0"),
            ),
        )
        return faults(result)

    lines = at(10.0, 10.0)
    assert lines[0].startswith("1 star moved as far as stars may, 3 pixels, from (10, 10) to (10,")
    assert "does not fit" in lines[1]
    assert len(at(10.0, 10.5)) == 1


def test_a_star_counts_once_and_its_epochs_are_named(nameless):
    bad = StarResiduals(Fit(100, 900.0, 200.0), Fit(), 0.2, 0.8, 0.176)
    places = np.repeat([(10.0, 13.0), (20.0, 9.0)], 2, axis=0)
    findings = SimpleNamespace(
        given_positions=places,
        may_free_pixels=False,
        observation=observed("May", "June"),
    )
    result = SimpleNamespace(
        star_positions=places, star_fluxes=np.array([5.0, np.nan, 6.0, 7.0]), psf_refinement=None,
        smoothing=0.0, star_residuals=lambda: [bad, bad, bad._replace(exchanged=0.166), bad],
        fit=Fit, _findings=findings,
    )  # fmt: skip
    unfitted, lit, paired = faults(result)
    places = "(10, 13) in epoch May (20, 9) in 2 epochs"
    assert unfitted == f"the model does not fit at 2 of 2 stars, {places}: give a better PSF"
    assert lit.startswith("light lies all round 2 stars, as a share of its flux: (10, 13) in epoch")
    assert paired.startswith(
        "2 stars may exchange light with the extended source there, up to this"
    )
    assert "(10, 13) in epoch May, 18 %; (20, 9) in 2 epochs, 17 to 18 %" in paired
    assert [is_doubt(each) for each in (unfitted, lit, paired)] == [False, True, True]


def of_four(n_bad, psf_error=0.0, core_error=0.02, wings=100.0, overall=Fit()):  # noqa: B008
    """Return the faults of four stars, some of which do not fit."""
    bad = StarResiduals(
        Fit(100, 900.0, 200.0), Fit(100, wings, 200.0), 0.0, 0.0, core_error=core_error
    )
    found = [bad] * n_bad + [StarResiduals(Fit(100, 100.0, 200.0), Fit(), 0.0, 0.0)] * (4 - n_bad)
    places = np.array([(10.0, 13.0), (20.0, 9.0), (5.0, 25.0), (14.0, 20.0)])
    findings = SimpleNamespace(
        given_positions=places,
        may_free_pixels=False,
        observation=observed("0", psf_error=psf_error),
    )
    result = SimpleNamespace(
        star_positions=places, star_fluxes=np.full(4, 5.0), psf_refinement=None, smoothing=0.0,
        star_residuals=lambda: found, fit=lambda: overall, _findings=findings,
    )  # fmt: skip
    return faults(result)


@pytest.mark.parametrize(("n_bad", "remedy"), [(1, "the PSF fits the others: see"), (2, "give a")])
def test_one_misfit_of_several_stars_is_not_blamed_on_the_psf(nameless, n_bad, remedy):
    (line,) = of_four(n_bad)
    assert line.startswith(f"the model does not fit at {n_bad} of 4 stars, ")
    assert f": {remedy}" in line


def test_a_misfit_within_the_error_of_psfs_is_a_doubt(nameless):
    (line,) = of_four(2, psf_error=0.03)
    assert line.startswith(
        "the PSF is off at 2 stars, (10, 13), 2 %; (20, 9), 2 %: within its error"
    )
    assert is_doubt(line)
    for wrong in ({"core_error": 0.04}, {"wings": 900.0}, {"core_error": 0.01, "psf_error": 0.009}):
        (line,) = of_four(1, **{"psf_error": 0.3} | wrong)  # more than PSFs have
        assert not is_doubt(line)


@pytest.mark.parametrize(("squares", "is_told"), [(1e4, True), (1.5e3, False)])
def test_a_misfit_elsewhere_is_told_beside_a_psf_that_is_off(nameless, squares, is_told):
    """One that cores do not explain: a wrong gain, noise or background."""
    lines = of_four(1, psf_error=0.03, overall=Fit(1000, squares, 900.0))
    assert ("the model does not fit: see to background, noise and gain" in lines) == is_told
    assert is_doubt(lines[-1])


@pytest.mark.parametrize("more", [[], ["--quiet"]])
def test_the_shell_says_each_fault_once(more, tmp_path, monkeypatch, capsys):
    from astropy.io import fits

    monkeypatch.chdir(tmp_path)
    image, psf = star(widen=1.25)
    fits.writeto("image.fits", image)
    fits.writeto("psf.fits", psf)
    words = ["image.fits", "--psf", "psf.fits", "--psf-centre", "given", "--background", "20"]
    words += ["--star", "21,26", "--smoothing", "3", "--stop", "none", "--n-iter", "60"]
    words += ["--engine", "numpy", "--pad", "0", "-o", "out.fits"]
    assert cli.main(["deconvolve", *words, *more]) == 0
    said = capsys.readouterr()
    result, _ = solve(image, psf, smoothing=3.0, stop=None)
    with fits.open("out.fits") as hdus:
        assert hdus[0].header["VERDICT"] == "; ".join(result.verdict())
        kept = [str(line) for line in hdus["MESSAGES"].data["message"]]
    for line in result.verdict():
        shown = line.replace("refine_psfs", "--refine-psfs")
        assert (said.out + said.err).count(shown) == 1
        lines = said.err if more else said.out
        assert f"{'lnocl: warning: ' if more else ' no: '}{shown}\n" in lines
        assert kept.count(f"warning: {shown}") == 1
    assert "the model fits" not in said.out


@pytest.mark.parametrize("error", [0.03, 0.0])
def test_a_host_is_named_that_may_exchange_light_with_the_star(error):
    u, v = X - N // 2, Y - N // 2
    psf = np.exp(-0.5 * ((u / 2.2) ** 2 + (v / 1.7) ** 2)) + 0.2 * np.exp(-0.1 * (u**2 + v**2))
    host = np.exp(-np.hypot(X - STAR[0], 1.3 * (Y - STAR[1])) / 3)
    laid = np.roll(psf / psf.sum(), (STAR[1] - N // 2, STAR[0] - N // 2), (0, 1))
    spectra = np.fft.rfft2(host / host.sum()), np.fft.rfft2(np.fft.ifftshift(psf / psf.sum()))
    means = LEVEL + 1e5 * laid + 1e5 * np.fft.irfft2(spectra[0] * spectra[1], (N, N))
    image = np.random.default_rng(1).poisson(means.clip(0))
    known = {"background": LEVEL, "psf_centre": "given", "psf_error": error}
    observation = lnocl.Observation(image, psf, **known)
    options = {**RUN, "n_iter": 100, "smoothing": 1e-3, "stop": None}
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        result = lnocl.deconvolve(observation, [STAR], **options)
    is_named = [line.startswith("1 star may exchange light with") for line in result.verdict()]
    assert sum(is_named) == (error > 0)
    assert sum("exchange light" in str(each.message) for each in warned) == (error > 0)


def test_tiles_have_a_verdict_too():
    psf = make_psfs(1, (7, 7))[0]
    image = np.random.default_rng(2).poisson(LEVEL + 0.0 * X).astype(float)
    image[STAR[1], STAR[0]] += 3e3
    observation = lnocl.Observation(image, psf, background=LEVEL, psf_centre="given")
    options = {**RUN, "n_iter": 5, "smoothing": 0.0, "stop": None}
    with pytest.warns(lnocl.LnoclWarning) as warned:
        result = lnocl.deconvolve_tiles(observation, [STAR], **options)
    assert result.verdict()[0].startswith("the model does not fit at 1 of 1 star, (21, 26): give")
    assert result.verdict()[0] in [str(each.message) for each in warned]
