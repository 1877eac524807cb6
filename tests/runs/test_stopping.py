"""When a run stops, and what held-out counts choose, on scenes whose truth is known."""

import functools
import io
import warnings

import numpy as np
import pytest
import scipy.special
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

import lnocl
from lnocl.errors import LnoclWarning
from lnocl.runs import held_out
from lnocl.runs.stopping import CHANGE_WINDOW, expected_deviance
from lnocl.runs.thinning import split_counts
from lnocl.scene.penalty import Penalty

SIZE, STAR = 64, (40, 24)


@functools.cache
def scene(mask=False, p=2, seed=0):
    """Return an observation of smooth emission and a star, its means and the true emission."""
    y, x = np.mgrid[:SIZE, :SIZE]
    truth = 400.0 * np.exp(-((x - 30) ** 2) / 60.0 - (y - 34) ** 2 / 200.0)
    sky = truth.copy()
    sky[STAR[1], STAR[0]] += 1e5
    r = np.arange(SIZE) - SIZE // 2
    widths = (3.0, 8.0), (8.0, 3.0), (5.0, 5.0)
    psfs = np.array([np.exp(-(r**2)[:, None] / (2 * v) - r**2 / (2 * h)) for v, h in widths[:p]])
    psfs /= psfs.sum(axis=(1, 2), keepdims=True)
    spectra = np.fft.rfft2(np.fft.ifftshift(psfs, axes=(1, 2)))
    means = np.fft.irfft2(np.fft.rfft2(sky) * spectra) + 20.0
    rng = np.random.default_rng(seed)
    images = rng.poisson(means).astype(float)
    bad = None
    if mask:
        bad = rng.random(images.shape) < 0.2
        images[bad] = 1e6
    return lnocl.Observation(images, psfs, background=20.0, mask=bad), means, truth


def run(observation, **keywords):
    """Deconvolve with the scaled gradient projection method on the reference."""
    return lnocl.deconvolve(
        observation, [STAR], **{"solver": "sgp", "engine": "numpy", "n_iter": 200} | keywords
    )


def error(result, truth):
    """Return the relative error of the extended source."""
    return np.linalg.norm(result.extended - truth) / np.linalg.norm(truth)


def deviance(counts, means):
    """Return 2 (g ln(g / m) + m - g)."""
    return 2.0 * (scipy.special.xlogy(counts, counts / means) + means - counts)


@pytest.mark.parametrize("mean", [1e-4, 0.03, 0.5, 2.0, 20.0, 500.0, 1e5])
def test_expected_deviance(mean):
    """Against the sum over scipy's Poisson distribution."""
    counts = np.arange(int(mean + 40.0 * np.sqrt(mean) + 100.0))
    expected = (scipy.stats.poisson.pmf(counts, mean) * deviance(counts, mean)).sum()
    assert expected_deviance(mean) == pytest.approx(expected, abs=5e-7)  # measured: 1.7e-7


class TestChange:
    def test_stops_as_soon_as_the_mean_change_is_small_enough(self):
        observation, *_ = scene()
        result = run(observation, stop=1e-4)
        objective = result.history["objective"]
        changes = (objective[:-CHANGE_WINDOW] - objective[CHANGE_WINDOW:]) / CHANGE_WINDOW
        changes /= objective[CHANGE_WINDOW:]
        assert result.stop_reason == "change"
        assert result.n_iter < 200
        assert changes[-1] < 1e-4 <= changes[1:-1].min()

    def test_goes_to_the_end_where_it_does_not_settle(self):
        result = run(scene()[0], stop=1e-9, n_iter=20)
        assert (result.stop_reason, result.n_iter) == ("n_iter", 20)


@pytest.mark.parametrize("solver", ["sgm", "sgp"])
@pytest.mark.parametrize("mask", [False, True], ids=["", "masked"])
def test_discrepancy_stops_where_noise_is_reached(mask, solver):
    observation, *_ = scene(mask)
    estimates = {}

    def keep(iteration, estimate):
        sky = estimate.extended.copy()
        sky[STAR[1], STAR[0]] += estimate.star_fluxes[0]
        psfs = np.fft.ifftshift(observation.psfs, axes=(1, 2))
        means = np.fft.irfft2(np.fft.rfft2(sky) * np.fft.rfft2(psfs)) + 20.0
        good = ~observation.mask
        fit = deviance(observation.images[good], means[good]).sum()
        estimates[iteration] = fit / expected_deviance(means[good]).sum()

    result = run(observation, stop="discrepancy", solver=solver, callback=keep)
    assert result.stop_reason == "discrepancy"
    # The split-gradient method knows the data term of the estimate before, and creeps over the
    # line while the expectation is an earlier one.
    creeping = solver == "sgm"
    last = result.n_iter - creeping
    assert estimates[last] <= 1.0 < estimates[last - 1 - creeping]


class TestHalves:
    def test_are_whole_counts_that_add_up(self):
        observation, *_ = scene()
        ((first, second),) = split_counts(observation)
        np.testing.assert_array_equal(first.images + second.images, observation.images)
        assert (first.images == np.floor(first.images)).all()
        assert min(first.images.min(), second.images.min()) >= 0
        np.testing.assert_array_equal(first.background, observation.background / 2)

    @pytest.mark.parametrize("fraction", [0.0, 0.3])
    def test_are_independent_poisson_counts(self, fraction):
        """Variance and covariance of a million pixels, six standard errors wide."""
        n, mean = 1000, 20.0
        images = np.random.default_rng(5).poisson(mean, (n, n)) + fraction
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LnoclWarning)
            ((first, second),) = split_counts(lnocl.Observation(images, np.ones((1, 1))))
        covariance = np.cov(first.images.ravel(), second.images.ravel())
        allowed = 6.0 * mean / 2.0 * np.sqrt(2.0) / n
        # Of a fraction, which is no count, 1/4 of its square goes to each.
        shift = fraction**2 / 4.0
        np.testing.assert_allclose(np.diag(covariance), mean / 2.0 + shift, atol=allowed)
        assert abs(covariance[0, 1] + shift) < allowed

    def test_leave_masked_pixels_out(self):
        observation, *_ = scene(mask=True)
        ((first, second),) = split_counts(observation)
        np.testing.assert_array_equal(first.mask, observation.mask)
        assert first.images[observation.mask].max() == second.images[observation.mask].max() == 0

    def test_keep_exposures_and_offsets(self):
        exposure = np.where(np.arange(16).reshape(4, 4) == 5, 0.0, [[[2.0]], [[3.0]]])
        observation = lnocl.Observation(
            np.full((2, 4, 4), 9.0), np.ones((1, 1)), exposure=exposure, offsets=[(0, 0), (1, -0.5)]
        )
        for half in split_counts(observation)[0]:
            seen = ~observation.mask
            np.testing.assert_array_equal(half.mask, observation.mask)
            np.testing.assert_array_equal(half.offsets, observation.offsets)
            np.testing.assert_array_equal(half.exposure[seen], observation.exposure[seen])

    def test_say_that_images_are_no_whole_counts(self):
        for images, read_noise in ((2.5, 0.0), (2.25, 0.5), (3e5 + 0.4, 1.0)):
            observation = lnocl.Observation(
                np.full((4, 4), images), np.ones((1, 1)), read_noise=read_noise
            )
            with pytest.warns(LnoclWarning, match="the images are not whole counts"):
                split_counts(observation)

    @pytest.mark.parametrize("read_noise", [0.0, 2.3, np.full((16, 16), 2.3)])
    @pytest.mark.parametrize("gain", [1.0, 0.7], ids=["counts", "rounded"])
    def test_whole_counts_with_read_noise_or_rounding_are_whole_counts(self, read_noise, gain):
        """As a camera's counts are, divided by a gain and multiplied by it in single precision."""
        counts = np.random.default_rng(2).poisson(3000.0, (16, 16)).astype(np.float32)
        counts[0, :4] = -9.0, -1.0, 0.0, 1.0
        images = counts / np.float32(gain) * np.float32(gain)
        assert (images == np.round(images)).all() == (gain == 1.0)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".* negative and w.* set to 0")
            observation = lnocl.Observation(images, np.ones((1, 1)), read_noise=read_noise)
        split_counts(observation)

    @pytest.mark.parametrize(
        ("value", "message"),
        [
            (0.0, "the images hold no counts to hold out"),
            (1e20, "1e\\+20 electrons is too bright to be split"),
        ],
    )
    def test_refuse_what_cannot_be_dealt_out(self, value, message):
        observation = lnocl.Observation(np.full((4, 4), value), np.ones((1, 1)))
        with pytest.raises(lnocl.InputError, match=message):
            split_counts(observation)


@given(seed=st.integers(0, 2**32 - 1))
def test_estimated_errors_are_unbiased(seed):
    """Against the truth, with halves that are it and noise."""
    rng = np.random.default_rng(seed)
    truth = rng.random(10_000).astype(np.float32)
    noise = [rng.normal(0.0, 0.1, truth.shape).astype(np.float32) for _ in range(4)]
    a, b, a_end, b_end = (truth / 2 + part for part in noise)
    trial = held_out._Trial([])
    trial.snapshots = [(1, [(a, b)])]
    (excess,) = trial.excess([(a_end, b_end)])
    error = np.linalg.norm(a + b - truth) ** 2
    # Six standard errors: 4 |truth / 2| 0.1 twice.
    allowed = 6.0 * 4.0 * 0.1 * np.linalg.norm(truth)
    assert abs(excess + np.linalg.norm(truth) ** 2 - error) < allowed
    assert trial.noise(0) == pytest.approx(error, rel=0.2)


class TestHeldOut:
    @pytest.mark.parametrize("mask", [False, True], ids=["", "masked"])
    def test_chooses_nearly_the_best_iteration(self, mask):
        observation, _, truth = scene(mask)
        errors = []
        run(observation, callback=lambda _, estimate: errors.append(
            np.linalg.norm(estimate.extended - truth) / np.linalg.norm(truth)
        ))  # fmt: skip
        result = run(observation, stop="held-out")
        assert result.stop_reason == "held-out"
        assert error(result, truth) == errors[result.n_iter - 1]
        # Measured over 48 such scenes: within 1.83; the last iteration is at 7 to 12.
        assert error(result, truth) <= 1.9 * min(errors) < errors[-1]

    @pytest.mark.parametrize(
        "engine", ["numpy", pytest.param("opencl", marks=pytest.mark.exhaustive)]
    )
    def test_is_repeated_bit_for_bit(self, engine):
        first, second = (run(scene()[0], stop="held-out", engine=engine) for _ in range(2))
        np.testing.assert_array_equal(first.extended, second.extended)
        np.testing.assert_array_equal(first.held_out, second.held_out)

    def test_says_that_more_iterations_are_needed(self):
        with pytest.warns(LnoclWarning, match="too near the end to be sure; give n_iter") as caught:
            run(scene()[0], stop="held-out", n_iter=12)
        assert caught[0].filename == __file__

    def test_keeps_the_curve(self):
        result = run(scene()[0], stop="held-out", mu=1e-6)
        assert set(result.held_out["mu"]) == {1e-6}
        errors = result.held_out["error"]
        chosen = result.held_out["iteration"] == result.n_iter
        assert (errors[chosen] <= 1.1 * errors.min()).all()
        assert errors[np.flatnonzero(chosen)[0] + 1 :].min() > 1.1 * errors.min()

    def test_without_the_rule_there_is_no_curve(self):
        assert run(scene()[0], n_iter=2).held_out.size == 0

    def test_says_once_that_images_are_no_whole_counts(self):
        observation, *_ = scene()
        fractions = lnocl.Observation(observation.images + 0.25, observation.psfs, background=20.25)
        with pytest.warns(LnoclWarning) as caught:
            run(fractions, stop="held-out", n_iter=100)
        assert [str(each.message) for each in caught if "whole" in str(each.message)] == [
            "the images are not whole counts: they are split as if they were Poisson counts"
        ]

    @pytest.mark.parametrize("n_iter", [7, 10, 20])
    def test_errors_are_measured_from_the_noise_of_the_best_estimate(self, n_iter):
        """Some snapshots before it are dropped, the last time after the last one."""
        rng = np.random.default_rng(1)

        class Trial(held_out._Trial):
            def advance(self):
                for k in range(1, n_iter + 1):
                    # Halves of a truth of 10, first far from it, then noisy; best is iteration 12.
                    wide = np.float32(5.0 + 0.5 * max(12 - k, 0))
                    noise = 0.1 * k * rng.standard_normal((2, 4000), np.float32)
                    self.snapshots.append((k, [(wide + noise[0], wide + noise[1])]))
                    yield k

        trial = Trial([])
        candidate = held_out._run_trial(trial, Penalty(), True, None, lambda _: None, lambda: None)
        assert trial.iterations[0] > 1
        excess = trial.excess(trial.last)
        least = int(np.argmin(excess))
        a, b = trial.snapshots[least][1][0]
        noise = np.linalg.norm(a - b) ** 2
        expected = np.sqrt(noise / max(candidate.squared_norm, noise - excess[least]))
        assert candidate.curve["error"][least] == pytest.approx(expected, rel=1e-6)

    def test_halves_that_end_at_once_are_refused(self):
        with pytest.raises(lnocl.InputError, match="no iteration betters the start"):
            held_out._run_trial(held_out._Trial([((), ())]), Penalty(), False, None, print, print)

    def test_start_that_is_no_number_is_refused(self):
        with pytest.raises(lnocl.InputError, match="initial_extended"):
            run(scene()[0], stop="held-out", initial_extended="flat")


class Screen(io.StringIO):
    """A terminal to show progress on."""

    def isatty(self):
        """Return True."""
        return True


@pytest.mark.parametrize(
    ("stop", "words"),
    [
        (None, "objective"),
        (1e-3, "change"),
        ("discrepancy", "discrepancy"),
        ("held-out", "objective"),
    ],
)
@pytest.mark.parametrize("interval", [0.0, 1e9], ids=["each", "last alone"])
def test_progress_ends_at_the_last_iteration(stop, words, interval, monkeypatch):
    screen = Screen()
    monkeypatch.setattr("sys.stderr", screen)
    monkeypatch.setattr("lnocl.runs.progress.PROGRESS_INTERVAL", interval)
    result = run(scene()[0], n_iter=60, stop=stop, progress=True)
    last = screen.getvalue().rstrip().rsplit("\r", 1)[-1]
    total = 60 if stop != "held-out" else result.n_iter
    assert f"{result.n_iter}/{total}" in last
    assert words in last
    assert "nan" not in screen.getvalue()


class TestMu:
    def test_auto_is_the_value_of_least_error(self):
        result = run(scene()[0], stop="held-out", mu="auto")
        curve = result.held_out
        least = {mu: curve["error"][curve["mu"] == mu].min() for mu in np.unique(curve["mu"])}
        assert result.mu == min(least, key=least.get)
        assert len(least) > 1

    @pytest.mark.exhaustive
    def test_without_stop_it_is_the_best_at_the_end(self):
        """After far too many iterations a Tikhonov term is better than none."""
        observation, _, truth = scene()
        result = run(observation, mu="auto", n_iter=150)
        assert result.n_iter == 150 or result.stop_reason == "converged"
        assert result.mu > 0
        assert error(result, truth) < error(run(observation, n_iter=150), truth)

    def test_halves_have_the_minimum_of_the_whole(self):
        """Half the counts with twice mu: half the data term, a quarter of the squares."""
        observation, *_ = scene()
        half = lnocl.Observation(observation.images / 2, observation.psfs, background=10.0)
        penalty = Penalty(1e-4, 1e-3)
        of_half = penalty.of_half()
        whole = run(observation, mu=penalty.mu, smoothing=penalty.smoothing, n_iter=30)
        halved = run(half, mu=of_half.mu, smoothing=of_half.smoothing, n_iter=30)
        np.testing.assert_array_equal(2.0 * halved.extended, whole.extended)


class TestSmoothing:
    def test_auto_is_the_weight_of_least_error(self):
        result = run(scene()[0], stop="held-out", smoothing="auto")
        curve = result.held_out
        weights = np.unique(curve["smoothing"])
        least = {w: curve["error"][curve["smoothing"] == w].min() for w in weights}
        assert result.smoothing == min(least, key=least.get)
        assert len(least) > 1
        assert set(curve["mu"]) == {0.0}

    @pytest.mark.exhaustive
    def test_after_too_many_iterations_it_is_better_than_none(self):
        observation, _, truth = scene()
        result = run(observation, smoothing="auto", n_iter=150)
        assert result.smoothing > 0
        assert error(result, truth) < 0.8 * error(run(observation, n_iter=150), truth)

    def test_both_auto_are_refused(self):
        with pytest.raises(lnocl.InputError, match="mu and smoothing cannot both be auto"):
            run(scene()[0], mu="auto", smoothing="auto")

    @pytest.mark.parametrize("exposure", [(4.0, 4.0, 4.0), (2.0, 4.0, 6.0)])
    def test_grid_is_the_noise_of_the_gradient(self, exposure):
        """As the counts of a flat sky scatter it."""
        rng = np.random.default_rng(3)
        images = np.stack([rng.poisson(50.0 * e, (64, 64)) for e in exposure]).astype(float)
        psfs = np.array([[[0, 0, 1, 0, 0]], [[0, 1, 1, 0, 0]], [[1, 1, 1, 1, 1]]])
        observation = lnocl.Observation(images, psfs, exposure=np.array(exposure))
        gradient = np.zeros((64, 64))
        for image, psf, e in zip(images, observation.psfs, exposure, strict=True):
            excess = e * (image / (50.0 * e) - 1.0)
            gradient += sum(v * np.roll(excess, 2 - x, 1) for x, v in enumerate(psf.ravel()))
        grid = held_out.smoothing_grid(0.0)(observation, 1.0)
        found = [penalty.smoothing for penalty in grid] / held_out.SMOOTHING_GRID
        np.testing.assert_allclose(found, gradient.std(), rtol=0.04)
