"""PSFs of their own of stars, beside explicit sums of arrays that are moved by whole pixels."""

import numpy as np
import pytest
from scenes import make_psfs

import lnocl
from lnocl.core.runs.inputs import inputs_of
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.forward_model import Model, largest_window
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.star_check import _masked_stars, check_stars
from lnocl.core.solvers.marginal import marginal
from lnocl.core.solvers.positions import StarFit, Stars

N = 48
STAR, PLANET = (17.0, 21.0), (26.0, 14.0)
# Lopsided, of images that differ, larger than the PSFs; their sums are far below 1.
SHARES = np.array([0.05, 0.02])


def whole(psfs):
    return psfs / psfs.sum(axis=(1, 2), keepdims=True)


PSFS = whole(make_psfs(2, (9, 7)))
OWN = SHARES[:, None, None] * whole(make_psfs(4, (23, 31))[2:])
OFFSETS = np.array([(0.0, 0.0), (3.0, -2.0)])
QUARTER = np.array([[[1.0, 0, 0], [0, 1, 0]], [[0.0, -1, N - 1], [1, 0, 0]]])


def observe(**changes):
    given = {
        "images": np.random.default_rng(1).poisson(50.0, (2, N, N)),
        "psfs": PSFS,
        "psf_centre": "given",
        "star_psfs": OWN,
        "star_places": STAR,
    }
    return lnocl.Observation(**(given | changes))


def placed(psf, place, grid=(N, N)):
    """Return a PSF with its middle at a whole pixel of an image."""
    laid = np.zeros((3 * grid[0], 3 * grid[1]))
    y, x = (int(at) + n - k // 2 for at, n, k in zip(place[::-1], grid, psf.shape, strict=True))
    laid[y : y + psf.shape[0], x : x + psf.shape[1]] = psf
    return laid[grid[0] : 2 * grid[0], grid[1] : 2 * grid[1]]


def shown(scene, j, s):
    return scene.star_image(j, s)[:N, :N]


KINDS = {
    "plain": ({}, [STAR, STAR], [1.0, 1.0]),
    "offsets": ({"offsets": OFFSETS}, [STAR, np.add(STAR, OFFSETS[1])], [1.0, 1.0]),
    "exposures": ({"exposure": [1.0, 3.0]}, [STAR, STAR], [0.5, 1.5]),
    "PSF field": ({"psfs": [lnocl.PsfField([p, p], [(0, 0), (9, 0)]) for p in PSFS]},
                  [STAR, STAR], [1.0, 1.0]),
    "quarter turn": ({"transforms": QUARTER}, [STAR, (N - 1 - STAR[1], STAR[0])], [1.0, 1.0]),
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_a_star_has_its_own_psf_in_the_axes_of_each_image_and_all_else_the_common_one(kind):
    changes, places, gains = KINDS[kind]
    scene = Scene(observe(**changes), [PLANET, STAR], pad=12)
    for j, (place, gain) in enumerate(zip(places, gains, strict=True)):
        expected = gain * placed(OWN[j], place)
        found = scene.observation.as_given(np.array([shown(scene, k, 1) for k in (0, 1)]))[j]
        np.testing.assert_allclose(found, expected, atol=1e-14)
        assert shown(scene, j, 0).sum() == pytest.approx(gain, rel=1e-6)


def test_two_stars_have_the_psfs_of_their_places():
    """In whatever order they are given."""
    own = np.array([OWN, 3.0 * OWN[::-1, ::-1]])
    scene = Scene(observe(star_psfs=own, star_places=[PLANET, STAR]), [STAR, (9.0, 30.0), PLANET])
    for j in range(2):
        np.testing.assert_allclose(shown(scene, j, 0), placed(own[1, j], STAR), atol=1e-15)
        np.testing.assert_allclose(shown(scene, j, 2), placed(own[0, j], PLANET), atol=1e-15)


def test_the_models_are_sums_of_both_psfs():
    obs = observe(background=5.0, exposure=[1.0, 3.0])
    sky = np.random.default_rng(2).uniform(1.0, 2.0, (N, N))
    result = lnocl.deconvolve(
        obs, [STAR, PLANET], stop=None, n_iter=2, smoothing=0, engine="numpy",
        initial_extended=sky, initial_star_fluxes=[4e4, 500.0], pad=0,
    )  # fmt: skip
    for j, model in enumerate(result.models()):
        light = result.star_fluxes[0] * placed(OWN[j], STAR)
        light += result.star_fluxes[1] * placed(PSFS[j], PLANET)
        kernel = np.fft.fft2(np.fft.ifftshift(placed(PSFS[j], (N // 2, N // 2))))
        light += np.fft.ifft2(np.fft.fft2(result.extended) * kernel).real
        np.testing.assert_allclose(model, 5 + [1.0, 3.0][j] * light, rtol=1e-12)


def test_a_star_of_each_epoch_has_the_psf_of_its_images():
    scene = Scene(observe(epochs=["a", "b"]), [PLANET, STAR], pad=12)
    for s, j in [(2, 0), (3, 1)]:
        np.testing.assert_allclose(shown(scene, j, s), placed(OWN[j], STAR), atol=1e-15)
        assert not shown(scene, 1 - j, s).any()
    np.testing.assert_allclose(scene.star_weights, [1, 1, 0.05, 0.02], rtol=1e-6)


@pytest.mark.parametrize("is_effective", [False, True])
def test_pixels_see_a_finer_psf_of_its_own_as_they_see_the_common_one(is_effective):
    fine = whole(make_psfs(2, (22, 18)))
    given = {"psfs": fine, "oversample": 2, "effective_psfs": is_effective}
    star = (17.3, 21.1)
    own = Scene(observe(**given, star_psfs=0.1 * fine, star_places=star), [star])
    common = Scene(observe(**given, star_psfs=None, star_places=None), [star])
    for j in range(2):
        np.testing.assert_allclose(
            own.star_image(j, 0), 0.1 * common.star_image(j, 0), rtol=1e-12, atol=1e-17
        )
    np.testing.assert_allclose(own.star_weights, 0.1 * common.star_weights, rtol=1e-12)


def test_weights_are_the_shares_that_good_pixels_show():
    mask = np.zeros((N, N), bool)
    mask[:, :22] = True
    wide = 1e-6 * np.add.outer([1.0, 5.0], np.tile(np.arange(31.0), (23, 1)))
    obs = observe(mask=mask, exposure=[1.0, 3.0], star_psfs=wide)
    scene = Scene(obs, [PLANET, STAR])
    first, second = (placed(own, STAR)[:, 22:].sum() for own in wide)
    assert scene.star_weights[1] == pytest.approx(0.5 * first + 1.5 * second, rel=1e-12)
    assert scene.is_shown.tolist() == [True, True]  # however small its share is
    # As a tile asks of stars that it may not see; of the common PSF it would not.
    assert Scene(obs).observes(np.array([PLANET, STAR])).tolist() == [True, True]
    assert list(_masked_stars(scene)) == []


def test_light_of_a_wide_psf_does_not_come_in_at_the_other_edge():
    wide = np.full((71, 81), 1e-5)
    scene = Scene(observe(star_psfs=wide, star_places=(45.0, 3.0)), [(45.0, 3.0)])
    np.testing.assert_allclose(shown(scene, 0, 0), placed(wide, (45.0, 3.0)), atol=1e-18)


TURNS = {
    "upright": {},
    "turned": {"transforms": lnocl.rotations([0.0, 25.0], (20.0, 20.0))},
    "scaled": {"transforms": QUARTER[:1] * np.reshape([1.0, 0.7], (2, 1, 1))},
}


@pytest.mark.parametrize("turn", TURNS)
def test_the_psf_on_the_sky_is_turned_back_as_the_common_one_is(turn):
    given = TURNS[turn] | {"psfs": whole(make_psfs(2, (23, 23)))}
    own = Scene(observe(**given, star_psfs=0.1 * given["psfs"]), [PLANET, STAR])
    common = Scene(observe(**given, star_psfs=None, star_places=None), [PLANET, STAR])
    for j in range(2):
        found, expected = (each.psf_on_sky(j, 1) for each in (own, common))
        np.testing.assert_allclose(found.values, 0.1 * expected.values, atol=1e-15)
        assert found[1:] == expected[1:]


def test_largest_window_covers_the_adjoint_of_the_star_cutouts():
    scene = Scene(observe(star_psfs=np.full((101, 121), 1e-5)), [STAR], pad=100)
    model = Model(scene)
    shared = model.adjoint_of_cutouts([scene.star_cutout(j, 0) for j in range(2)])
    assert (np.array(shared.values.shape) <= largest_window(scene)).all()


def test_margins_of_tiles_hold_the_psf():
    with pytest.raises(lnocl.InputError, match=r"margins of half a PSF, 15 pixels"):
        lnocl.deconvolve_tiles(observe(), [STAR], tile=40, pad=0)


def test_a_psf_of_its_own_like_the_common_one_gives_the_flux_over_its_share():
    """With a number for smoothing PSFs are not judged either way."""
    under = 4e3 * placed(whole(make_psfs(1, (25, 25)))[0], STAR)
    counts = np.random.default_rng(5).poisson(
        [20 + 2e4 * placed(psf, STAR) + 2e3 * placed(psf, PLANET) + under for psf in PSFS]
    )
    given = {"images": counts, "background": 18.0, "epochs": [0, 1]}
    of_own = observe(**given, star_psfs=PSFS / 8)
    of_common = observe(**given, star_psfs=None, star_places=None)
    own, common = (
        lnocl.deconvolve(obs, [STAR, PLANET], n_iter=30, stop=None, smoothing=0.5, engine="numpy")
        for obs in (of_own, of_common)
    )
    factors = np.array([8.0, 8.0, 1.0, 1.0])
    np.testing.assert_allclose(own.star_fluxes, factors * common.star_fluxes, rtol=1e-4)
    # Those of own PSFs have what the extended source might take of the star: 0.002 in squares.
    np.testing.assert_allclose(own.star_flux_errors, factors * common.star_flux_errors, rtol=2e-3)
    scale = common.extended.max()
    np.testing.assert_allclose(own.extended, common.extended, atol=1e-3 * scale)
    for found, expected in zip(own.star_residuals(), common.star_residuals(), strict=True):
        assert found.halo == pytest.approx(expected.halo, rel=1e-2, abs=1e-6)
        assert found.core.n_pixels == expected.core.n_pixels


def test_sky_gains_only_the_share_of_lost_star_flux_that_images_show():
    """The estimate has a hole under a star that is too bright by less than the hole."""
    y, x = np.indices((N, N)) - np.array(STAR[::-1])[:, None, None]
    under = 40 * np.exp(-(x**2 + y**2) / 128)
    counts = np.random.default_rng(5).poisson([20 + 2e4 * placed(p, STAR) + under for p in PSFS])
    obs = observe(images=counts, background=18.0, star_psfs=PSFS / 8)
    scene = Scene(obs, [STAR])
    sky = 2 + under * (1 - 0.9 * np.exp(-(x**2 + y**2) / 8))
    before = Estimate(scene, sky, np.array([8 * 2.02e4]))
    after = marginal(before)
    lost = before.star_fluxes - after.star_fluxes
    assert lost > 8 * 100
    assert (after.sky - sky).sum() == pytest.approx(lost[0] / 8, rel=1e-6)


def test_residuals_at_the_star_are_those_where_its_own_psf_shines():
    result = lnocl.deconvolve(observe(), [STAR], stop=None, n_iter=1, smoothing=0, engine="numpy")
    found = result.star_residuals()[0]
    bright = [(own > 0.5 * own.max()).sum() for own in OWN]
    assert found.core.n_pixels == sum(bright)
    lit = [(placed(own, STAR) > 1e-3 * own.max()).sum() for own in OWN]
    assert found.core.n_pixels + found.wings.n_pixels == sum(lit)


def test_the_common_psf_is_not_checked_by_the_width_of_the_star():
    counts = np.array([20 + 1e6 * placed(psf, STAR) for psf in PSFS])
    assert len(list(check_stars(Scene(observe(images=counts, star_psfs=None, star_places=None),
                                      [STAR])))) == 2  # fmt: skip
    assert list(check_stars(Scene(observe(images=counts), [STAR]))) == []


def test_a_tested_point_beside_the_star_has_the_common_psf():
    scene = Scene(observe(), [STAR], pad=12).with_star(np.add(STAR, (0.0, 0.25)))
    assert shown(scene, 0, 0).sum() == pytest.approx(0.05, rel=1e-6)
    assert shown(scene, 0, 1).sum() == pytest.approx(1.0, rel=1e-6)


def test_the_psf_of_a_window_is_at_the_place_in_it():
    part = observe().window(range(9, 35), range(5, 33))
    scene = Scene(part, [np.subtract(STAR, (5, 9))])
    np.testing.assert_allclose(
        scene.star_image(1, 0)[:26, :28], placed(OWN[1], STAR)[9:35, 5:33], atol=1e-15
    )


@pytest.mark.filterwarnings("ignore:psf . is undersampled")
def test_derivatives_by_the_place_of_the_star_are_those_of_differences():
    scene = Scene(observe(star_places=(17.3, 21.2)), [(17.3, 21.2), PLANET], pad=12)
    model, sky = Model(scene), np.ones(scene.grid)
    fit = StarFit(scene, model, sky, scene.stars)
    stars = Stars(np.array([5e4, 40.0]), scene.stars)

    def value(fluxes):
        """Return the data term over all pixels."""
        models = model.forward(sky) + np.array(list(model.starlight(fluxes)))
        images = list(scene.images())
        pairs = zip(models[:, :N, :N], (each[:N, :N] for each in images), strict=True)
        return sum(float((m - g * np.log(m)).sum()) for m, g in pairs)

    brighter = Stars(stars.fluxes * [1.1, 1.0], stars.positions)
    change = fit.objective(brighter) - fit.objective(stars)
    assert change == pytest.approx(value(brighter.fluxes) - value(stars.fluxes), rel=1e-9)
    gradient = fit._gradient(fit._try(stars))
    for k in range(4):
        step = np.zeros(4)
        step[k] = 1e-4
        ends = [
            fit.objective(Stars(stars.fluxes, stars.positions + side * step.reshape(2, 2).T))
            for side in (1, -1)
        ]
        assert gradient[2 + k] == pytest.approx((ends[0] - ends[1]) / 2e-4, rel=1e-4)


def test_a_planet_in_the_halo_of_the_star_and_the_star_have_fluxes_within_errors():
    """Noise makes light beside a wide PSF that it lacks itself: 4 %, where errors were 1 %."""
    rng, y, x = np.random.default_rng(8), *np.indices((N, N))
    star, planet = (18.3, 20.6), (25.2, 15.9)

    def blob(dx, dy, width):
        return np.exp(-(dx**2 + 1.3 * dy**2) / 2 / width**2) * np.sqrt(1.3) / 2 / np.pi / width**2

    def behind(dx, dy):
        return 0.1 * (blob(dx + 0.7, dy, 6.0) - 0.5 * blob(dx, dy, 4.5))

    v, u = np.indices((95, 95)) - 47
    light = 4e6 * behind(x - star[0], y - star[1]) + 4e3 * blob(x - planet[0], y - planet[1], 1.5)
    obs = lnocl.Observation(
        rng.poisson(light + 20.0), blob(u, v, 1.5), background=20.0,
        star_psfs=behind(u, v), star_places=star,
    )  # fmt: skip
    result = lnocl.deconvolve(obs, [star, planet], engine="numpy")
    pulls = (result.star_fluxes - [4e6, 4e3]) / result.star_flux_errors
    assert (abs(pulls) < 2).all(), pulls
    assert (result.star_flux_errors < [0.1 * 4e6, 0.1 * 4e3]).all()
    assert result.verdict() == ["the model fits"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"star_psfs": [OWN] * 2}, "has shape (2, 2, 23, 31), and `star_places` 1 place"),
        ({"star_psfs": None}, "has shape (0, 2, 1, 1), and `star_places` 1 place"),
        ({"star_places": None}, "and `star_places` 0 places; give (n, p, ky, kx)"),
        ({"star_psfs": np.ones((3, 5, 5)) / 99}, "PSFs of each star there in each of 2 images"),
        ({"star_psfs": 30 * OWN}, "has the sum 1.5: it is the share of the star's light"),
        ({"star_psfs": OWN * [[[np.nan]], [[1.0]]]}, "`star_psfs[0]` is not finite"),
        ({"star_psfs": -OWN}, "`star_psfs[0]` has the sum -0.05; it must be positive"),
        ({"star_places": [(1.0, np.inf)]}, "`star_places` must be finite; inf was given"),
        ({"star_places": [1.0, 2.0, 3.0]}, "has shape (3,); give pairs (x, y)"),
        (
            {"star_psfs": [OWN] * 2, "star_places": [STAR, np.add(STAR, 0.5)]},
            "has (17.5, 21.5) twice",
        ),
    ],
)
def test_invalid_psfs_and_places_of_stars_are_refused(changes, message):
    with pytest.raises(lnocl.InputError) as refused:
        observe(**changes)
    assert message in refused.value.message


def test_a_place_without_a_star_is_refused():
    with pytest.raises(lnocl.InputError, match=r"no star is within 0.5 pixels of \(17, 21\)"):
        lnocl.plan(observe(), [PLANET, np.add(STAR, (0.0, 0.6))])


def test_psfs_are_not_judged_by_a_star_that_has_its_own():
    with pytest.raises(lnocl.InputError, match="refine_psfs needs a star"):
        lnocl.deconvolve(observe(), [STAR], engine="numpy", refine_psfs=["jitter"])
    assert not lnocl.plan(observe(psf_scatter=0.1 * PSFS), [STAR]).does("judge PSFs before the run")
    alone, both = lnocl.plan(observe(), [STAR]), lnocl.plan(observe(), [STAR, PLANET])
    assert alone.why_not("judge PSFs before the run") == "all stars have PSFs of their own"
    assert alone.does("take marginal star fluxes")
    assert both.does("judge PSFs before the run")


def test_another_psf_of_its_own_is_another_input():
    first, second = inputs_of(observe()), inputs_of(observe(star_places=np.add(STAR, 0.1)))
    assert (first["star_places"] != second["star_places"]).all()
    np.testing.assert_array_equal(first["star_psfs"][0], OWN)
