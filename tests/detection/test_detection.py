"""Stars are found where they are, and nothing else is."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from lnocl.detection import search
from lnocl.errors import InputError, LnoclError, LnoclWarning

pytest.importorskip("photutils", reason="photutils is not installed")
from lnocl.detection import defects, find_stars

SHAPE = (96, 110)
Y, X = np.indices(SHAPE)
PLACES = np.array([(30.3, 25.8), (80.1, 30.4), (45.0, 70.5), (36.0, 27.0), (105.2, 3.1)])
PEAKS = np.array([2000.0, 500.0, 90.0, 700.0, 300.0])


def gaussian(x, y, sigma=1.5, shape=SHAPE):
    rows, columns = np.indices(shape)
    return np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2.0 * sigma**2))


PSF = gaussian(15, 15, shape=(31, 31))


def make_image(seed=0, level=100.0, scatter=5.0, places=PLACES, peaks=PEAKS):
    noise = np.random.default_rng(seed).normal(level, scatter, SHAPE)
    return noise + sum(peak * gaussian(*place) for place, peak in zip(places, peaks, strict=True))


def assert_found(stars, places=PLACES, peaks=PEAKS, within=0.2):
    assert len(stars) == len(places)
    order = np.argsort(-peaks)
    found = np.array([stars["x"], stars["y"]]).T
    assert np.abs(found - places[order]).max() < within
    np.testing.assert_allclose(stars["peak"], peaks[order], rtol=0.25)


@pytest.mark.parametrize("psf", [None, PSF])
@pytest.mark.parametrize("seed", range(3))
def test_all_are_found_the_brightest_first(psf, seed):
    stars = find_stars(make_image(seed), psf)
    assert_found(stars)
    assert not stars["saturated"].any()
    if psf is not None:  # the constant of the fit takes a sixth
        sharpness = np.sqrt((PSF**2).sum())
        assert stars["significance"][0] == pytest.approx(0.84 * 2000 / 5 * sharpness, rel=0.06)


@pytest.mark.exhaustive
@pytest.mark.parametrize("scale", [2.0**-20, 2.0**20])
def test_units_do_not_matter(scale):
    one, other = find_stars(make_image()), find_stars(scale * make_image())
    np.testing.assert_allclose(one["x"], other["x"], atol=1e-6)
    np.testing.assert_allclose(scale * one["peak"], other["peak"])
    np.testing.assert_allclose(one["significance"], other["significance"])


def test_noise_alone_gives_no_stars():
    none = make_image(places=PLACES[:0], peaks=PEAKS[:0])
    assert len(find_stars(none)) == 0
    assert len(find_stars(none, PSF)) == 0
    assert find_stars(none).colnames == ["x", "y", "peak", "significance", "width", "saturated"]


def test_noise_that_pixels_share_is_no_star():
    from scipy.ndimage import gaussian_filter

    noise = 5.0 * gaussian_filter(np.random.default_rng(1).normal(0, 1, SHAPE), 0.8)
    assert len(find_stars(noise + 100.0, PSF)) == 0


def test_a_slope_and_an_extended_source_are_no_stars():
    image = make_image() + 0.3 * X + 400.0 * gaussian(60, 48, sigma=6.0)
    assert_found(find_stars(image, PSF), within=0.4)


def test_peaks_in_psf_wings_are_stars_only_where_brighter_than_the_wings():
    rows, columns = np.indices((61, 61)) - 30
    ring = gaussian(30, 30, shape=(61, 61))
    ring += 0.03 * np.exp(-((np.hypot(columns - 7, rows)) ** 2) / 4.5)  # a speckle
    image = np.random.default_rng(0).normal(100.0, 1.0, SHAPE)
    image[18:79, 20:81] += 5000.0 * ring
    assert len(find_stars(image, ring)) == 1
    image += 400.0 * gaussian(57, 48)
    assert len(find_stars(image, ring)) == 2


def fringes(x, y, shape=SHAPE):
    columns = np.arange(shape[1])
    envelope = gaussian(x, y, 5.0, shape)
    return envelope * np.cos(np.pi * (columns - x) / 6.0) ** 2


class TestOtherProfiles:
    PLACES = np.array([(30.3, 25.8), (40.2, 30.4), (80.6, 70.5)])

    def image(self):
        noise = np.random.default_rng(5).normal(100.0, 2.0, SHAPE)
        return noise + sum(
            peak * fringes(*at) for peak, at in zip((400, 250, 90), self.PLACES, strict=True)
        )

    def test_fringes_are_no_stars_of_their_own(self):
        found = find_stars(self.image(), fringes(30, 30, (61, 61)))
        assert np.abs(np.array([found["x"], found["y"]]).T - self.PLACES).max() < 0.3
        np.testing.assert_allclose(found["peak"], [400, 250, 90], rtol=0.05)

    def test_without_a_psf_one_that_is_not_round_is_noticed(self):
        with pytest.warns(LnoclWarning, match=r"4\.\d times as long as wide: give the PSF, unless"):
            find_stars(self.image())

    def test_a_psf_that_is_too_wide_is_noticed(self):
        with pytest.warns(LnoclWarning, match=r"are 3\.\d\d pixels wide and the PSF 7\.\d\d"):
            find_stars(make_image(), gaussian(30, 30, 3.0, (61, 61)))

    @pytest.mark.parametrize("sigma", [2.0, 3.0])
    def test_a_source_wider_than_the_psf_is_left_out_and_counted(self, sigma):
        image = make_image() + 600.0 * gaussian(60, 48, sigma)
        found = find_stars(image, PSF)
        assert_found(found)
        assert found.meta["n_extended"] == 1
        np.testing.assert_allclose(found["width"][:4], 2.355 * 1.5, rtol=0.05)

    @pytest.mark.exhaustive
    def test_without_a_psf_the_narrow_sources_are_the_stars(self):
        image = make_image()
        for k in range(8):
            image += 600.0 * gaussian(14.0 + 12.0 * k, 48.0 + 5 * (k % 2), sigma=2.3)
        found = find_stars(image)
        apart = np.hypot(*(PLACES[:, np.newaxis] - np.array([found["x"], found["y"]]).T).T)
        assert len(found) >= 4
        assert (apart.min(axis=1) < 0.2).all()

    @pytest.mark.parametrize("apart", [3.8, 4.3, 5.3])
    def test_two_stars_a_width_apart_are_two(self, apart):
        places = np.array([(30.3, 25.8), (30.3 + apart, 25.8)])
        peaks = np.array([2000.0, 1800.0])
        found = find_stars(make_image(places=places, peaks=peaks), PSF)
        assert_found(found, places, peaks, within=0.3)

    def speckled(self, share, places):
        """A star with speckles, each a share of it, in a square and in an image."""
        square = gaussian(30, 30, shape=(61, 61))
        square += share * sum(gaussian(30 + x, 30 + y, shape=(61, 61)) for x, y in places)
        image = np.random.default_rng(0).normal(100.0, 1.0, SHAPE)
        image[18:79, 20:81] += 5000.0 * square
        return square, image

    def test_a_speckle_that_the_psf_has_too_faint_is_no_star(self):
        _, image = self.speckled(0.03, [(5, 0)])
        assert len(find_stars(image, self.speckled(0.02, [(5, 0)])[0])) == 1

    def test_faint_speckles_are_no_stars_without_a_psf(self):
        _, image = self.speckled(0.02, 3.0 * np.array([(0.96, 0.3), (-0.74, 0.68), (-0.21, -0.98)]))
        assert len(find_stars(image)) == 1


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore::lnocl.errors.LnoclWarning")
@pytest.mark.parametrize("seed", range(3))
def test_between_holes_there_are_next_to_no_stars(seed):
    rng = np.random.default_rng(seed)
    image = make_image(seed)
    for _ in range(6):
        x, y = rng.uniform(10, 85, 2)
        image += rng.uniform(200, 2000) * gaussian(x, y, rng.uniform(1.5, 5))
    for psf in (PSF, None):
        assert len(find_stars(200 - image, psf)) <= 1


@pytest.mark.exhaustive
def test_a_star_that_a_fit_moves_away_is_not_found_again(monkeypatch):
    """In a field of galaxies the same star was found without end."""
    scenes = Path(__file__).parents[2] / "benchmarks" / "stars.py"
    counts, psf, *_ = runpy.run_path(str(scenes))["scene"]("moffat", "galaxies", 6, 740)
    rounds, points_among = [], search._points_among

    def among(*given):
        rounds.append(given)
        assert len(rounds) < 20
        return points_among(*given)

    monkeypatch.setattr(search, "_points_among", among)
    assert len(find_stars(counts, psf)) == 6


class TestSaturated:
    @pytest.mark.parametrize("core", ["level", "NaN", "mask", "hole"])
    def test_they_are_found_once_and_named(self, core):
        image = make_image(peaks=PEAKS * [20.0, 1.0, 1.0, 1.0, 1.0])
        given = {}
        lost = image > 9000.0
        lost[60:, :] = False
        assert lost.sum() > 10
        if core == "level":
            image[lost] = 9000.0
            given["saturation"] = 9000.0
        elif core == "NaN":
            image[lost] = np.nan
        elif core == "mask":
            image[lost] = 7.0
            given["mask"] = lost
        else:
            image[np.hypot(X - 30.3, Y - 25.8) < 1.6] = 3000.0
        stars = find_stars(image, PSF, **given)
        assert np.hypot(stars["x"][0] - 30.3, stars["y"][0] - 25.8) < 0.6
        assert stars["saturated"].tolist()[:1] == [True]
        assert stars["saturated"].sum() == 1
        others = np.array([stars["x"], stars["y"]]).T[1:]
        for place in PLACES[[1, 2, 4]]:
            assert np.hypot(*(others - place).T).min() < 0.3

    def test_trails_of_bleeding_are_no_stars(self):
        image = make_image(peaks=PEAKS * [40.0, 1.0, 1.0, 1.0, 1.0])
        image[5:80, 29:32] = 3e4
        image = image.clip(max=9000.0)
        stars = find_stars(image, PSF, saturation=9000.0)
        assert np.hypot(stars["x"][0] - 30.3, stars["y"][0] - 25.8) < 1.0
        assert stars["saturated"].tolist() == [True, False, False, False]

    @pytest.mark.exhaustive
    def test_a_large_core_is_one_star(self):
        image = make_image() + 3e6 * gaussian(60, 60, 4.0)
        stars = find_stars(image.clip(max=3000.0), PSF, saturation=3000.0)
        assert np.hypot(stars["x"][0] - 60, stars["y"][0] - 60) < 0.2
        assert stars["saturated"].sum() == 1

    @pytest.mark.parametrize("at", [(30, 26), (32, 26), (29, 24)])
    def test_a_bad_pixel_in_a_star_is_no_star_of_its_own(self, at):
        places, peaks = PLACES[:3], PEAKS[:3]
        image = make_image(places=places, peaks=peaks)
        mask = np.zeros(SHAPE, bool)
        mask[at[1], at[0]] = True
        stars = find_stars(image, PSF, mask=mask)
        assert len(stars) == 3
        assert np.hypot(stars["x"] - 30.3, stars["y"] - 25.8).min() < 0.7
        assert stars["saturated"].sum() <= 1

    @pytest.mark.exhaustive
    def test_bad_pixels_in_the_sky_are_no_stars(self):
        image = make_image()
        image[50:54, 60:63] = image[80, :] = np.nan
        image[10, 90] = 1e6
        mask = np.zeros(SHAPE, bool)
        mask[10, 90] = True
        assert_found(find_stars(image, PSF, mask=mask))
        assert_found(find_stars(np.ma.masked_array(image, mask), PSF))


@pytest.mark.parametrize(
    ("image", "given", "message"),
    [
        (np.ones((2, 9, 9)), {}, r"image has shape \(2, 9, 9\); give one image"),
        (np.full((9, 9), np.nan), {}, "image has no good pixel"),
        (np.ones((9, 9)), {"threshold": 0.0}, "threshold must be more than 0; 0.0 was given"),
        (np.ones((9, 9)), {"threshold": np.nan}, "threshold must be more than 0; nan was given"),
        (np.ones((9, 9)), {"threshold": "5"}, "threshold must be more than 0; 5 was given"),
        (np.ones((9, 9)), {"saturation": np.nan}, "saturation must be more than 0; nan was given"),
        (np.ones((9, 9)), {"saturation": -5.0}, "saturation must be more than 0; -5.0 was given"),
        (
            np.ones((9, 9)),
            {"mask": np.zeros((9, 8), bool)},
            r"the image has \(9, 9\)",
        ),
        (np.ones((9, 9)), {"mask": np.zeros((9, 9))}, "mask is of type float64; give booleans"),
        (np.ones((9, 9)), {"psf": np.zeros((5, 5))}, "psf of shape .* positive"),
        (np.ones((9, 9)), {"psf": np.ones(5)}, "psf of shape"),
    ],
)
def test_refusals(image, given, message):
    with pytest.raises(InputError, match=message):
        find_stars(image, **given)


@pytest.mark.exhaustive
@pytest.mark.parametrize("share", [0.35, 0.51, 0.7])
@pytest.mark.parametrize("outside", [0.0, np.nan])
def test_pixels_outside_the_field_give_no_stars(share, outside):
    inside = PLACES[:, 0] > share * SHAPE[1] + 4
    image = make_image(4, places=PLACES[inside], peaks=PEAKS[inside])
    image[:, : int(share * SHAPE[1])] = outside
    found = find_stars(image, PSF)
    assert len(found) == inside.sum()
    for place in PLACES[inside]:
        assert np.hypot(found["x"] - place[0], found["y"] - place[1]).min() < 0.3


@pytest.mark.exhaustive
def test_pixels_without_counts_are_data():
    counts = np.random.default_rng(3).poisson(0.03 + 40 * gaussian(50, 50)).astype(float)
    assert np.hypot(find_stars(counts, PSF)["x"][0] - 50, 0) < 0.3


def test_an_island_of_good_pixels():
    image = np.full(SHAPE, np.nan)
    image[16:36, 20:40] = make_image()[16:36, 20:40]
    assert np.hypot(find_stars(image, PSF)["x"][0] - 30.3, 0) < 0.3


@pytest.mark.parametrize("value", [0.0, 5.0])
def test_a_flat_image_has_no_star(value):
    assert len(find_stars(np.full((40, 40), value))) == 0


def test_missing_photutils_raises_an_error_with_its_install_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "photutils.background", None)
    with pytest.raises(LnoclError, match=r"pip install photutils$"):
        find_stars(make_image())


def test_the_sharpest_psf_is_a_gaussian_of_its_width_in_pixels():
    """Summed at a hundred points a pixel."""
    x = np.linspace(-3.495, 3.495, 700)
    profile = np.exp(-4.0 * np.log(2.0) * (x / defects.SHARPEST) ** 2).reshape(7, 100).sum(axis=1)
    expected = np.outer(profile, profile) / profile.sum() ** 2
    np.testing.assert_allclose(defects.sharpest_psf(), expected, rtol=1e-3)
