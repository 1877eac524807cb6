"""The simulation against theory: PSF, photometry, noise and scenes."""

import math
import runpy
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import j1

from lnocl.errors import FileError, InputError
from lnocl.simulation import (
    Experiment,
    Star,
    Target,
    fizeau_psf,
    hh34,
    load_target,
    simulate,
)

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared" / "data"

H2 = 2.12 * u.um
PIXEL = 5 * u.mas
RADIAN_IN_MAS = 180 / math.pi * 3600e3
FRINGE_SPACING = 2.12e-6 / 14.4 * RADIAN_IN_MAS / 5  # pixels, 6.07


def psf_of(n, angle=0.0, strehl=1.0, seed=0, pixel=PIXEL):
    return fizeau_psf((n, n), angle * u.deg, H2, pixel, strehl, seed)


@pytest.fixture(scope="module")
def perfect():
    """At 1024 x 1024, where nothing is folded."""
    return psf_of(1024)


def obscured_airy(r):
    """Field of a disc of 8.4 m with an obscuration of 0.911 m at r pixels, 1 at the centre."""
    e = 0.911 / 8.4
    v = np.where(r == 0, 1e-9, np.pi * r * 5 / RADIAN_IN_MAS * 8.4 / 2.12e-6)
    return (2 * j1(v) / v - e**2 * 2 * j1(e * v) / (e * v)) / (1 - e**2)


@pytest.mark.parametrize("shape", [(64, 64), (100, 100), (64, 96)])
def test_psf_has_unit_sum_and_peak_at_centre(shape):
    psf = fizeau_psf(shape, 30 * u.deg, H2, PIXEL, 0.7)
    assert psf.shape == shape
    assert psf.dtype == np.float64
    assert psf.sum() == pytest.approx(1, abs=1e-12)
    assert psf.min() >= 0
    assert np.unravel_index(psf.argmax(), shape) == (shape[0] // 2, shape[1] // 2)


def test_psf_is_airy_pattern_crossed_by_fringes(perfect):
    """The whole core against theory: |Airy|^2 cos^2(pi B x / lambda)."""
    y, x = np.mgrid[-60:61, -60:61].astype(float)
    theory = obscured_airy(np.hypot(x, y)) ** 2 * np.cos(np.pi * x / FRINGE_SPACING) ** 2
    core = perfect[452:573, 452:573] / perfect.max()
    np.testing.assert_allclose(core, theory, atol=1e-3)


@pytest.mark.parametrize("strehl", [0.02, 0.7])
def test_strehl_ratio(strehl):
    ratio = psf_of(256, 45, strehl, seed=1).max() / psf_of(256, 45).max()
    assert ratio == pytest.approx(strehl, abs=0.002)


def test_low_strehl_ratio_gives_a_faint_core():
    assert psf_of(256, strehl=1e-4).max() / psf_of(256).max() < 0.01


def test_halo_keeps_the_fringes():
    """Residual phase lowers the side lobes of the MTF and leaves them in their place."""
    mtf, perfect = (np.abs(np.fft.rfft2(psf_of(256, strehl=s))) for s in (0.7, 1.0))
    k = round(256 / FRINGE_SPACING)
    assert 0.5 < mtf[0, k] / perfect[0, k] < 0.9
    assert mtf[0, k - 5 : k + 6].argmax() in (4, 5, 6)


@pytest.mark.parametrize(("angle", "lobe"), [(0, (0, 1)), (45, (1, 1)), (90, (1, 0))])
def test_mtf_has_side_lobes_at_the_baseline(angle, lobe):
    """Half as high as the centre, at B / lambda along the baseline; nothing beyond B + D."""
    # Pixels for which the lobes fall on a frequency of the grid.
    cycles = 48 if angle != 45 else 48 * math.sqrt(2)
    pixel = cycles * 2.12e-6 / 14.4 / 512 * u.rad
    mtf = np.abs(np.fft.fft2(psf_of(512, angle, pixel=pixel)))
    ky, kx = 48 * np.array(lobe)
    assert mtf[0, 0] == pytest.approx(1)
    assert mtf[ky, kx] == pytest.approx(0.5, abs=0.002)
    assert mtf[-ky, -kx] == pytest.approx(0.5, abs=0.002)
    around = mtf[np.ix_(np.arange(ky - 3, ky + 4), np.arange(kx - 3, kx + 4))]
    assert np.unravel_index(around.argmax(), around.shape) == (3, 3)
    v, h = np.meshgrid(*[np.fft.fftfreq(512, 1 / 512)] * 2, indexing="ij")
    reach = cycles * 8.4 / 14.4 + 1.5
    outside = np.all([np.hypot(v - s * ky, h - s * kx) > reach for s in (-1, 0, 1)], axis=0)
    assert mtf[outside].max() < 1e-3


def test_angle_turns_from_x_to_y(perfect):
    """Fringes are orthogonal to the baseline; 90 degrees is the transpose, 135 the mirror of 45."""
    np.testing.assert_allclose(psf_of(1024, 90), perfect.T, atol=1e-12)
    np.testing.assert_allclose(psf_of(256, 180), psf_of(256), atol=1e-12)
    turned, other = psf_of(256, 45)[1:, 1:], psf_of(256, 135)[1:, 1:]
    np.testing.assert_allclose(other, turned[:, ::-1], atol=1e-7)
    # A step of one spacing along the baseline leads from one bright fringe to the next, a step
    # across it stays on the bright one.
    step = round(FRINGE_SPACING / 2 / math.sqrt(2))
    assert turned[127 + step, 127 + step] < 0.05 * turned.max()
    assert turned[127 + step, 127 - step] > 0.5 * turned.max()


@pytest.mark.exhaustive
def test_psf_follows_its_seed():
    assert (psf_of(64, strehl=0.7, seed=5) == psf_of(64, strehl=0.7, seed=5)).all()
    assert (psf_of(64, strehl=0.7, seed=5) != psf_of(64, strehl=0.7, seed=6)).any()


def test_psf_beside_real_frame():
    """The fringes of the real LBTI frame of Altair have the spacing of the simulated ones."""
    frame = DATA / "lbti-fizeau-altair" / "lm_180507_009030.fits"
    if not frame.is_file():
        pytest.skip("../shared/data/lbti-fizeau-altair is not here")
    example = runpy.run_path(str(ROOT / "examples" / "real" / "psf_lbti.py"))
    real = example["read_frame"](frame)
    spacing, angle = example["fringe_spacing"](real)
    simulated, _ = example["fringe_spacing"](example["simulated_psf"](angle))
    theory = 4.05e-6 / 14.4 * RADIAN_IN_MAS / 10.7
    assert simulated == pytest.approx(theory, rel=0.01)
    assert spacing == pytest.approx(simulated, rel=0.03)


def test_photometry_by_hand():
    """The numbers of docs/validation/photometry.md, from plain arithmetic."""
    area = 2 * math.pi / 4 * (8.4**2 - 0.911**2)
    mag_0 = 666.7e-26 / 6.62607e-34 * 0.02 / 2.12
    star = mag_0 * 10 ** (-0.4 * 13) * area * 1800 * 0.3
    sky = mag_0 * 10 ** (-0.4 * 13.5) * 0.005**2 * area * 1800 * 0.3
    assert area == pytest.approx(109.53, abs=0.005)
    assert mag_0 == pytest.approx(9.492e7, rel=1e-4)
    assert star == pytest.approx(3.542e7, rel=2e-4)
    assert sky == pytest.approx(558.8, rel=2e-4)

    experiment = Experiment()
    assert experiment.source_electrons(13 * u.mag) == pytest.approx(star, rel=1e-5)
    assert experiment.source_electrons(experiment.extended_magnitude) == pytest.approx(
        star, rel=1e-5
    )
    assert experiment.sky_electrons == pytest.approx(sky, rel=1e-5)


def test_photometry_documented():
    text = (ROOT / "docs" / "validation" / "photometry.md").read_text()
    for number in ("109.53", "9.492", "598.9", "3.542", "25.005", "558.8"):
        assert number in text


@given(st.floats(-5, 30), st.floats(0.1, 10), st.floats(0.1, 1.9))
def test_photometry_scales(mag, wider, coarser):
    plain = Experiment().source_electrons(mag * u.mag)
    assert plain / Experiment().source_electrons((mag + 5) * u.mag) == pytest.approx(100)
    changed = Experiment(
        bandwidth=0.02 * wider * u.um, throughput=0.15, exposure_time="1 min",
        pixel_scale=5 * coarser * u.mas, sky_brightness=f"{mag} mag/arcsec2",
    )  # fmt: skip
    assert changed.source_electrons(mag * u.mag) == pytest.approx(plain * wider / 60)
    per_arcsec2 = changed.sky_electrons / (0.005 * coarser) ** 2
    assert per_arcsec2 == pytest.approx(changed.source_electrons(mag * u.mag))


@pytest.mark.usefixtures("few_screens")
def test_images_are_a_periodic_convolution_with_noise():
    rng = np.random.default_rng(0)
    target = Target(rng.random((32, 32)), [Star(3, 30), Star(20, 8, 15 * u.mag)])
    simulation = simulate(target, Experiment(angles=[0, 70] * u.deg))
    sky = simulation.extended.copy()
    for (x, y), flux in zip(simulation.stars, simulation.star_fluxes, strict=True):
        sky[y, x] += flux
    expected = np.full(simulation.images.shape, simulation.background[0])
    for j, psf in enumerate(simulation.psfs):
        for dy, dx in np.ndindex(psf.shape):
            expected[j] += psf[dy, dx] * np.roll(sky, (dy - 16, dx - 16), axis=(0, 1))
    pull = (simulation.images - expected) / np.sqrt(expected + 10**2)
    assert pull.mean() == pytest.approx(0, abs=4 / math.sqrt(pull.size))
    assert pull.std() == pytest.approx(1, abs=4 / math.sqrt(2 * pull.size))
    fluxes = simulation.star_fluxes
    assert fluxes[0] / fluxes[1] == pytest.approx(10**0.8)
    assert simulation.extended.sum() == pytest.approx(3.542e7, rel=2e-4)


@pytest.mark.usefixtures("few_screens")
def test_read_noise_alone_makes_negative_pixels():
    dark = {"sky_brightness": "30 mag/arcsec2", "extended_magnitude": "40 mag"}
    target = Target(np.ones((64, 64)))
    noise = simulate(target, Experiment(angles=0 * u.deg, **dark)).images
    assert noise.std() == pytest.approx(10, rel=0.05)
    assert noise.min() < 0
    photons = simulate(target, Experiment(angles=0 * u.deg, read_noise="0 electron")).images
    assert (photons == np.round(photons)).all()
    assert photons.min() > 0


@pytest.mark.usefixtures("few_screens")
def test_simulation_follows_its_seed():
    angles = [0, 90] * u.deg
    first, again, other = (simulate(hh34(64), Experiment(angles=angles, seed=s)) for s in (1, 1, 2))
    assert (first.images == again.images).all()
    assert (first.psfs == again.psfs).all()
    assert (first.psfs != other.psfs).any()
    assert not np.allclose(first.psfs[0], first.psfs[1].T, rtol=1e-3)


@pytest.mark.exhaustive
@pytest.mark.parametrize("size", [64, 250, 512, 1024])
def test_hh34_is_a_jet_along_y(size):
    target = hh34(size)
    jet, (star,) = target.extended, target.stars
    assert (star.x, star.y) == (size // 2, size // 4)
    assert jet.sum() == pytest.approx(1)
    assert jet.min() == 0 or size < 250
    assert (jet == hh34(size).extended).all()
    profile = jet.sum(axis=1)
    assert profile[star.y :].sum() > 0.95  # one-sided
    assert profile[[0, -1]].max() < 0.01 * profile.max()  # and inside the frame
    x = np.arange(size)
    centre = (jet @ x)[star.y : star.y + size // 2] / profile[star.y : star.y + size // 2]
    assert np.abs(centre - star.x).max() < 6


def test_hh34_widens_and_has_knots_and_a_bow_shock():
    jet = hh34(1024).extended
    x = np.arange(1024) - 512.0
    profile = jet.sum(axis=1)
    spread = np.sqrt((jet @ x**2) / np.where(profile > 0, profile, 1))
    assert 3 < spread[262] < 8
    assert 1.5 * spread[262] < spread[600] < 5 * spread[262]
    assert spread[850] > 2 * spread[600]  # the bow shock
    axis = jet[256:880, 507:518].sum(axis=1)
    knots = np.flatnonzero((axis[1:-1] > axis[:-2]) & (axis[1:-1] > axis[2:])) + 1
    assert 8 <= len(knots) <= 15
    assert knots[0] < 12


def test_hh34_near_star_does_not_depend_on_frame():
    small, large = (hh34(n).extended for n in (512, 1024))
    near, far = small[128:188, 216:296], large[256:316, 472:552]
    assert np.corrcoef(near.ravel(), far.ravel())[0, 1] > 0.99


def test_contrast_of_paper():
    """Star and jet hold the same light, the star all of it in one pixel."""
    simulation = simulate(hh34(1024), Experiment(angles=0 * u.deg))
    contrast = simulation.star_fluxes[0] / simulation.extended.max()
    assert 1e3 < contrast < 1e4
    assert simulation.extended.max() > 10 * simulation.background[0]


@pytest.mark.parametrize("size", [512, 1024])
def test_real_jet(size):
    path = DATA / "hh211" / f"hh211_scene_{size}.fits.gz"
    if not path.is_file():
        pytest.skip("../shared/data/hh211 is not here")
    target = load_target(path)
    assert target.extended.shape == (size, size)
    assert target.extended.sum() == pytest.approx(1)
    assert [(s.x, s.y) for s in target.stars] == [(size // 2, size // 2)]
    assert target.stars[0].magnitude == 13 * u.mag


def test_load_target(tmp_path):
    path = tmp_path / "jet.fits"
    hdus = [fits.PrimaryHDU(), fits.ImageHDU(np.ones((32, 40), np.int16))]
    fits.HDUList(hdus).writeto(path)
    target = load_target(path)
    assert target.extended.shape == (32, 40)
    assert target.stars == ()
    star = Star(39, 0, 12 * u.mag)
    assert load_target(str(path), stars=[star]).stars == (star,)
    assert load_target("hh34", size=64, stars=[]).stars == ()
    assert load_target("hh34", size=64).extended.shape == (64, 64)


def test_load_target_refuses_files_without_image(tmp_path):
    text = tmp_path / "jet.txt"
    text.write_text("no image")
    empty = tmp_path / "empty.fits"
    fits.PrimaryHDU().writeto(empty)
    image = tmp_path / "image.fits"
    fits.PrimaryHDU(np.ones((32, 32))).writeto(image)
    for path, message in ((text, "is not a FITS file"), (empty, "no image")):
        with pytest.raises(FileError, match=message) as caught:
            load_target(path)
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="size"):
        load_target(image, size=64)


def flat(**pixels):
    image = np.ones((32, 32))
    image[0, 0] = pixels.get("first", 1.0)
    return image


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: load_target("hh35"), "'hh35' is neither a built-in one .hh34. nor a file"),
        (lambda: hh34(255), "255 x 255 pixels; sides must be whole, even"),
        (lambda: hh34(62), "64 or more"),
        (lambda: Target(np.ones((30, 32))), "32 or more"),
        (lambda: hh34(64.0), "even"),
        (lambda: Target(np.zeros((32, 32))), "no flux"),
        (lambda: Target(np.ones((32, 33))), "33 x 32"),
        (lambda: Target(np.ones((3, 32, 32))), r"shape must be \(ny, nx\)"),
        (lambda: Target(flat(first=-1)), "not negative"),
        (lambda: Target(flat(first=math.nan)), "finite"),
        (lambda: Target(1e306 * flat()), "too large to be summed: divide it by a constant"),
        (
            lambda: Target(np.ma.array(flat(), mask=flat(first=2) > 1)),
            "the extended source has 1 masked value; fill it or leave it out",
        ),
        (lambda: Target(flat(), [Star(32, 0)]), "outside"),
        (lambda: Target(flat(), [Star(0.5, 0)]), "between pixels"),
        (lambda: Target(flat(), [Star("a", 0)]), "two numbers"),
        (lambda: Target(flat(), [Star(1, 1, 13)]), "magnitude of a star"),
        (
            lambda: Target(flat(), [Star(1, 1, math.nan * u.mag)]),
            "magnitude of a star must be finite",
        ),
        (lambda: Experiment(strehl=0.0), r"strehl must be in \(0, 1\]"),
        (lambda: Experiment(strehl=1.01), "strehl"),
        (lambda: Experiment(strehl=math.nan), "strehl"),
        (lambda: Experiment(angles=[0, math.inf] * u.deg), "angles"),
        (lambda: Experiment(angles=[] * u.deg), "angles"),
        (lambda: Experiment(angles=[0, 45]), "angles must be a quantity in deg"),
        (lambda: Experiment(exposure_time=-30 * u.min), "exposure_time must be positive"),
        (lambda: Experiment(exposure_time=30), "exposure_time must be a quantity in min"),
        (lambda: Experiment(bandwidth=0 * u.um), "bandwidth"),
        (lambda: Experiment(wavelength="2 parsnips"), "wavelength"),
        (lambda: Experiment(pixel_scale=[5, 5] * u.mas), "pixel_scale must be one number"),
        (lambda: Experiment(angles=[[0], [45]] * u.deg), "angles must be one or several numbers"),
        (
            lambda: Experiment(read_noise=-1 * u.electron),
            "read_noise must be one number, 0 or more",
        ),
        (lambda: Experiment(throughput=1.5), "throughput"),
        (lambda: Experiment(zero_point=0 * u.Jy), "zero_point"),
        (lambda: Experiment(sky_brightness=13 * u.mag), "sky_brightness"),
        (lambda: Experiment(seed=-1), "seed"),
        *(
            (partial(simulate, Target(flat()), Experiment(**extreme)), "all light together")
            for extreme in (
                {"exposure_time": "1e300 min"},
                {"exposure_time": "1e308 min"},
                {"sky_brightness": "-1000 mag/arcsec2"},
                {"extended_magnitude": "-1000 mag"},
                {"read_noise": "1e300 electron"},
            )
        ),
        (lambda: simulate(Target(flat(), [Star(1, 2, -5.5 * u.mag)] * 3)), "all light together"),
        (lambda: psf_of(64, pixel=10 * u.mas), "pixel_scale must be at most 9.59 mas"),
        (lambda: psf_of(64, pixel=0.1 * u.mas), "coarser pixels"),
        (lambda: psf_of(64, angle=math.nan), "angle"),
        (lambda: fizeau_psf(64, 0 * u.deg, H2, PIXEL), "shape must be"),
    ],
)
def test_refuses_in_one_line(call, message):
    with pytest.raises(InputError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)
