"""A step for PSFs and stars: its slopes by differences, the step by an explicit matrix."""

import numpy as np
import pytest
from scenes import named
from scipy.ndimage import gaussian_filter

import lnocl
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.psf_families import PsfFamilies, PsfParameters
from lnocl.core.scene.scene import Scene
from lnocl.core.solvers import least_squares, psf_fit

N, P = 16, 2
Y, X = np.indices((N, N)) - N // 2
RNG = np.random.default_rng(5)
PSFS = np.array([np.exp(-(X**2 + (Y / s) ** 2) / 4.0) for s in (1.0, 1.3)])
PSFS /= PSFS.sum(axis=(1, 2), keepdims=True)
IDEALS = np.array([np.exp(-(X**2 + Y**2) / 3.0)] * P)
MODES = 0.05 * (PSFS * (X * Y + X))[:, None]
STARS = np.array([(5.2, 9.1), (11.0, 4.6)])
NAMES = ("shift", "jitter", "strehl", "pupil", "modes")
PUPIL = (np.hypot(X, Y) < 3.8).astype(float)
SKY = 4.0 * np.exp(-((X - 2) ** 2 + (Y + 1) ** 2) / 10.0)
FLUXES = np.array([300.0, 80.0])
MASK = RNG.random((P, N, N)) < 0.05
EXPOSURE = np.array([1.0, 1.5])
OFFSETS = np.array([(0.0, 0.0), (0.6, -0.3)])
MAP = RNG.uniform(0.5, 1.5, (P, N, N))
HALO = np.exp(-np.hypot(X - 1, 1.2 * Y) / 4.0)
KNOWN = {"masked": {"mask": MASK}, "exposures": {"exposure": EXPOSURE, "offsets": OFFSETS},
         "exposure map": {"exposure": MAP}, "epochs": {"epochs": [1, 0]},
         "halos": {"halos": [HALO], "exposure": EXPOSURE},
         "transmission": {"transmission": np.where(X < 0.0, 0.4, 0.9)},
         "own PSF": {"star_psfs": 0.3 * PSFS[:, ::-1, :], "star_places": STARS[:1]}}  # fmt: skip


pytestmark = pytest.mark.filterwarnings("ignore:the images are shifted")


def a_scene(psfs=PSFS, stars=STARS, **known):
    means = 30.0 + np.zeros((P, N, N))
    counts = np.random.default_rng(1).poisson(means + 20.0 * SKY).astype(float)
    observation = lnocl.Observation(
        counts, PSFS, background=30.0, ideal_psfs=IDEALS, psf_modes=MODES, pupils=PUPIL, **known
    )
    return Scene(observation.replace(psfs=psfs), stars)


def families(scene, names=NAMES):
    given = scene.observation.replace(psfs=PSFS)
    return PsfFamilies(names, given, 0.1 * PSFS)


@pytest.mark.parametrize("known", named(KNOWN, "exposures", "own PSF"))
def test_slopes_are_the_derivatives_of_the_models(known):
    family = families(a_scene(**known))
    scene = a_scene(family.psfs(family.first()), **known)
    k, n, h = len(family.prior), scene.n_fluxes, 1e-6
    grid = scene.image_grid
    sky, fluxes = np.zeros(scene.grid), np.linspace(3.0, 0.8, n)
    sky[:N, :N] = SKY / 10.0
    start = family.first()
    images = psf_fit._linearise(
        Estimate.of_scaled(scene, sky, fluxes), family, start.values, Model(scene), True
    )
    unknowns = np.concatenate([np.zeros(n + 4), start.values.ravel()])

    def models(unknowns):
        amounts, moves, values = np.split(unknowns, [n, n + 4])
        psfs = family.psfs(start._replace(values=values.reshape(P, k)))
        moved = a_scene(psfs, STARS + moves.reshape(2, 2).T, **known)
        return Model(moved).images(sky, fluxes + amounts)[:, :N, :N]

    for which in range(len(unknowns)):
        up, down = unknowns.copy(), unknowns.copy()
        up[which] += h
        down[which] -= h
        change = (models(up) - models(down)) / (2 * h)
        for j, image in enumerate(images):
            at = np.flatnonzero(image.unknowns == which)
            expected = image.slopes[at[0]].reshape(grid)[:N, :N] if at.size else np.zeros((N, N))
            # Offsets and fractions move PSFs by aliases too, which slopes leave out.
            bound = 4e-4 * max(abs(change[j]).max(), 1e-6)
            np.testing.assert_allclose(change[j], expected, rtol=0, atol=bound)


# PSFs that are dark at their edges: where images are turned the grid is larger than they are.
V, U = np.indices((33, 33)) - 16
WIDE = np.exp(-(U**2 + (V / np.array([1.0, 1.3])[:, None, None]) ** 2) / 5.0)
WIDE *= 1.0 + 0.1 * np.tanh(U / 3.0)
WIDE /= WIDE.sum(axis=(1, 2), keepdims=True)
TURNED = lnocl.rotations([0.0, 25.0], centre=(7.5, 7.5))
SCALED = np.concatenate([TURNED[:1], TURNED[1:] / 1.25 + [[0, 0, 1.5], [0, 0, 1.5]]])
NODES = [(0, 0), (15, 0)]
FIELDS = [lnocl.PsfField([psf, psf[::-1]], NODES) for psf in WIDE]
IN_FRAMES = {
    "turned": {"transforms": TURNED},
    "scaled": {"transforms": SCALED, "exposure": EXPOSURE},
    "turned, dimmed": {
        "transforms": TURNED,
        "transmission": np.array([np.where(X < 0.0, 0.4, 0.9), np.full((N, N), 0.7)]),
    },
    "turned, finer": {"transforms": TURNED, "oversample": 2},
    "scaled, effective": {"transforms": SCALED, "oversample": 2, "effective_psfs": True},
    "a field": {"psfs": FIELDS},
    "a turned field": {"psfs": FIELDS, "transforms": TURNED},
}


def wide_scene(changed, stars=STARS, **known):
    known = {"psfs": WIDE, **known}
    observation = lnocl.Observation(
        np.full((P, N, N), 30.0),
        background=30.0,
        psf_modes=0.05 * (WIDE * (U * V + U))[:, None],
        ideal_psfs=[np.exp(-(U**2 + V**2) / 4.0)] * P,
        psf_centre="given",
        **known,
    )
    observation = observation if changed is None else observation.replace(psfs=changed)
    return Scene(observation, stars, pad=20)


@pytest.mark.exhaustive
@pytest.mark.parametrize("known", IN_FRAMES.values(), ids=IN_FRAMES)
def test_slopes_and_pixels_of_images_with_frames_and_psfs_of_their_own(known):
    """Models turn PSFs and the extended source by shears; slopes take their spectra."""
    scene, h = wide_scene(None, **known), 1e-6
    family = PsfFamilies(
        ("shift", "jitter", "strehl", "modes", "pixels"), scene.observation, 0.1 * WIDE
    )
    k, fluxes, sky = len(family.prior), np.array([3.0, 0.8]), np.zeros(scene.grid)
    first = (scene.oversample - 1) * N // 2  # in the middle of the images
    sky[first : first + N, first : first + N] = SKY / 10.0
    start, estimate = family.first(), Estimate.of_scaled(scene, sky, fluxes)
    images = psf_fit._linearise(estimate, family, start.values, Model(scene), True)

    def models(unknowns, pixels=start.pixels):
        moves, values = np.split(unknowns, [4])
        psfs = family.psfs_over_images(PsfParameters(values.reshape(P, k), pixels))
        moved = wide_scene(psfs, STARS + moves.reshape(2, 2).T, **known)
        return Model(moved).images(sky, fluxes)[:, :N, :N]

    at = 2 + np.arange(4 + P * k)
    for which, step in zip(at, h * np.eye(len(at)), strict=True):
        change = (models(step) - models(-step)) / (2 * h)
        for j, image in enumerate(images):
            (here,) = np.nonzero(image.unknowns == which)
            slope = image.slopes[here].sum(axis=0).reshape(scene.image_grid)[:N, :N]
            bound = 4e-4 * max(abs(change).max(), 1e-6)
            np.testing.assert_allclose(change[j], slope, rtol=0, atol=bound)

    white = np.random.default_rng(9).standard_normal(start.pixels.shape)
    x = gaussian_filter(white, (0, 1.5, 1.5), mode="wrap")
    field = psf_fit._PixelErrors(Model(scene), family.pixels, sky, fluxes, start.pixels)
    change = models(np.zeros(len(at)), x) - models(np.zeros(len(at)))
    found = np.array(list(field.forward(x)))[:, :N, :N]
    np.testing.assert_allclose(found, change, rtol=0, atol=2e-3 * abs(change).max())


# Fast tests have each setting with moving stars and with others; CI has all.
@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("known", "moves", "names"),
    [
        pytest.param(
            KNOWN[known],
            moves,
            names,
            id=f"{known}-{moves}-{'-'.join(names)}",
            marks=[] if (i + k) % 3 == moves else [pytest.mark.exhaustive],
        )
        for i, known in enumerate(list(KNOWN)[:3])
        for moves in (False, True)
        for k, names in enumerate([NAMES, (*NAMES, "pixels"), ("pixels",)])
    ],
)
def test_the_step_is_that_of_the_whole_least_squares(known, moves, names, monkeypatch):
    """Measured, the extended source in single precision: 8e-7, and 1.2e-7 of variances."""
    monkeypatch.setattr(psf_fit, "N_STEPS", 2000)
    monkeypatch.setattr(psf_fit, "FINISHED", 1e-13)
    monkeypatch.setattr(least_squares, "NEGLIGIBLE", 1e-12)
    scene = a_scene(**known)
    family, model = families(scene, names), Model(scene)
    sky, fluxes = SKY / 10.0, FLUXES / 100.0
    n = 2 * (3 if moves else 1)
    at = np.append(np.zeros(n), np.zeros(P * len(family.prior)))
    at[n : n + 1] = 0.2
    prior = np.append(np.zeros(n), np.tile(family.prior**-2.0, P))
    estimate = Estimate.of_scaled(scene, sky, fluxes)
    images = psf_fit._linearise(estimate, family, family.first().values, model, moves)
    fields = [psf_fit._source_error(model, sky)]
    if "pixels" in names:
        pixels = 0.3 * RNG.standard_normal((P, N, N))
        fields.append(psf_fit._PixelErrors(Model(scene), family.pixels, sky, fluxes, pixels))
    fit = psf_fit._fit(images, fields, prior)
    found, of_fields = fit.solve(at)

    slopes = np.zeros((P, N * N, len(at)))
    for each, block in zip(images, slopes, strict=True):
        block[:, each.unknowns] = each.slopes.T
    x = np.concatenate([field.at.ravel() for field in fields])
    spread = np.array([fit._forward(unit).ravel() for unit in np.eye(len(x))]).T
    root = np.sqrt([each.precision for each in images]).reshape(-1, 1)
    left = np.array([each.left for each in images]).reshape(-1)
    matrix = np.block(
        [
            [root * slopes.reshape(-1, len(at)), root * spread],
            [np.diag(np.sqrt(prior)), np.zeros((len(at), len(x)))],
            [np.zeros((len(x), len(at))), np.eye(len(x))],
        ]
    )
    wanted = np.concatenate([root[:, 0] * left, -np.sqrt(prior) * at, -x])
    expected = np.linalg.lstsq(matrix, wanted, rcond=None)[0]
    everything = np.concatenate([found, *(each.ravel() for each in of_fields)])
    np.testing.assert_allclose(everything, expected, rtol=0, atol=2e-6 * abs(expected).max())
    covariance = np.linalg.inv(matrix.T @ matrix)
    monkeypatch.setattr(least_squares, "MISSING", 1e-12)
    unknowns = [0, len(at) - 1]
    expected = covariance[unknowns, unknowns]
    np.testing.assert_allclose(fit.variances(unknowns), expected, rtol=3e-7)


def test_pixels_change_the_images_as_another_psf_does():
    scene = a_scene(exposure=EXPOSURE)
    family, model = families(scene, ("pixels",)), Model(scene)
    sky, fluxes = SKY / 10.0, FLUXES / 100.0
    start = family.first()
    field = psf_fit._PixelErrors(Model(scene), family.pixels, sky, fluxes, start.pixels)
    # Fractions of a pixel lose the highest frequencies, which a step leaves in.
    white = np.random.default_rng(9).standard_normal(start.pixels.shape)
    x = gaussian_filter(white, (0, 1.5, 1.5), mode="wrap")
    changed = a_scene(family.psfs(start._replace(pixels=x)), exposure=EXPOSURE)
    change = Model(changed).images(sky, fluxes) - model.images(sky, fluxes)
    expected = np.array(list(field.forward(x)))
    np.testing.assert_allclose(expected, change, rtol=0, atol=1e-3 * abs(change).max())


def test_the_error_of_the_extended_source_has_unit_variance_and_a_width():
    scene = a_scene()
    model = Model(scene)
    error = psf_fit._source_error(model, np.ones((N, N)))
    fields = [error._smooth.apply(RNG.standard_normal((N, N))) for _ in range(400)]
    assert np.mean(np.square(fields)) == pytest.approx(1.0, rel=0.05)
    products = [np.mean(f * np.roll(f, 3, axis=1)) for f in fields]
    assert np.mean(products) == pytest.approx(np.exp(-(3.0**2) / (2 * 1.5**2)), abs=0.03)


def test_steps_are_bounded(monkeypatch):
    scene = a_scene()
    family = families(scene)
    start = family.first()
    free = psf_fit.step(Estimate.of_scaled(scene, SKY / 10.0, FLUXES), family, start, True)
    assert (abs(free.parameters.values) / family.prior).max() > 0.02
    monkeypatch.setattr(psf_fit, "MAX_STEP", 0.01)
    monkeypatch.setattr(psf_fit, "MAX_MOVE", 1e-4)
    short = psf_fit.step(Estimate.of_scaled(scene, SKY / 10.0, FLUXES), family, start, True)
    assert (abs(short.parameters.values) / family.prior).max() == pytest.approx(0.01)
    share = short.parameters.values / free.parameters.values
    np.testing.assert_allclose(share, share[0, 0], rtol=1e-9)
    assert abs(short.positions - STARS).max() == pytest.approx(1e-4)
    faint = psf_fit.step(Estimate.of_scaled(scene, SKY / 10.0, 1e4 * FLUXES), family, start, True)
    assert (faint.star_fluxes >= 0.1 * 1e4 * FLUXES * scene.unit * (1 - 1e-12)).all()
