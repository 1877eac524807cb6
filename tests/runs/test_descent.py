"""An objective that rises ends the run at its least, and the warning names what in the PSFs did."""

import warnings

import numpy as np
import pytest
from scenes import paper, same

import lnocl
from lnocl import checkpoint
from lnocl.core.runs.descent import MAX_RISE, N_ABOVE, Descent, explain_rise
from lnocl.core.scene.scene import Scene
from lnocl.errors import DivergedError, NotFiniteError

SIZE = 32
FWHM = 5.9
FLUX = 3e4


def gaussian(off=0.0):
    y, x = np.indices((SIZE, SIZE)) - SIZE // 2
    return np.exp(-4 * np.log(2) * ((x - off) ** 2 + y**2) / FWHM**2)


def disc():
    y, x = np.indices((SIZE, SIZE)) - SIZE // 2
    return np.where(x**2 + y**2 <= 36, FLUX, 0.0)


def observe(seed, noise=0.03, level=0.0):
    """A disc through a Gaussian; the PSF given has noise and a level, as a frame of a star has."""
    rng = np.random.default_rng(seed)
    transfer = np.fft.rfft2(np.fft.ifftshift(gaussian() / gaussian().sum()))
    image = rng.poisson(np.maximum(np.fft.irfft2(np.fft.rfft2(disc()) * transfer), 0) + 50)
    psf = gaussian() + noise * rng.standard_normal((SIZE, SIZE)) + level
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".* psf pixels are negative and were kept.*")
        return lnocl.Observation(image, psf, background=50.0)


ENGINES = ["numpy", pytest.param("opencl", marks=pytest.mark.exhaustive)]
rises = pytest.warns(lnocl.LnoclWarning, match="the objective rises: .* is that of iteration")


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("seed", [1, 4])
def test_the_result_is_the_estimate_of_the_least_objective(engine, seed):
    iterations = []
    with rises as caught:
        result = paper(observe(seed), engine=engine, callback=lambda k, _: iterations.append(k))
    assert result.stop_reason == "diverged"
    assert len(iterations) < 200  # of 1000
    objective = result.history["objective"]
    assert len(objective) == result.n_iter + 1 > 2
    assert objective.argmin() == result.n_iter
    same(result, paper(observe(seed), engine=engine, n_iter=result.n_iter))
    assert result.extended.sum() == pytest.approx(disc().sum(), rel=0.02)
    assert result.extended.max() < 0.2 * result.extended.sum()
    of_run = [each for each in caught if each.category is lnocl.LnoclWarning]
    assert [each.filename for each in of_run] == [__file__]
    negative = observe(seed).psfs[0][observe(seed).psfs[0] < 0]
    assert f"{negative.size} pixels of psf 0 are negative, {-100 * negative.sum():.3g} % " in str(
        caught[0].message
    )


def test_without_it_all_the_light_is_in_one_pixel(monkeypatch):
    """The trap is there."""
    monkeypatch.setattr("lnocl.core.runs.descent.N_ABOVE", 10**9)
    result = paper(observe(4), engine="numpy")
    assert result.stop_reason == "n_iter"
    assert result.extended.max() > 0.9 * result.extended.sum()


def test_the_scaled_gradient_projection_method_is_not_trapped():
    result = paper(observe(4), engine="numpy", solver="sgp")
    assert (np.diff(result.history["objective"]) <= 0).all()
    assert result.extended.sum() == pytest.approx(disc().sum(), rel=0.02)
    assert result.extended.max() < 0.05 * result.extended.sum()


@pytest.mark.parametrize("every", [0.0, 1e9], ids=["always", "once"])
@pytest.mark.parametrize("cut", [1, 6, 13])
def test_a_run_cut_off_ends_where_it_would_have(cut, every, tmp_path, monkeypatch):
    """With checkpoints before the least objective, and after it."""
    path, given = tmp_path / "run.fits", {"engine": "numpy", "stop": "discrepancy"}
    with rises:
        whole = paper(observe(1), **given)
    assert 1 < whole.n_iter < 6
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "EVERY", every)
        paper(observe(1), **given, checkpoint=path, callback=lambda k, _: k == cut)
    with rises:
        resumed = paper(observe(1), **given, resume=path)
    same(resumed, whole)
    assert (resumed.stop_reason, resumed.n_iter) == ("diverged", whole.n_iter)
    with rises:
        same(paper(observe(1), **given, resume=path, checkpoint=path), whole)


@pytest.mark.parametrize("engine", ENGINES)
def test_it_is_noticed_at_the_end_of_a_short_run(engine):
    """Long before the device is asked for objectives."""
    with rises:
        result = paper(observe(1), engine=engine, n_iter=20)
    assert (result.stop_reason, result.n_iter) == ("diverged", 4)


def test_halves_of_held_out_counts_end_there(monkeypatch):
    monkeypatch.setattr("lnocl.core.runs.held_out.MIN_ITERATIONS", 50)
    with pytest.warns(lnocl.LnoclWarning, match="held-out counts choose among") as caught:
        result = paper(observe(1), engine="numpy", stop="held-out", n_iter=100)
    end = int(str(caught[0].message).rsplit(" ", 1)[1])
    assert result.held_out["iteration"][-1] == end < 20
    assert result.extended.sum() == pytest.approx(disc().sum(), rel=0.02)


def test_halves_that_rise_from_the_start_are_refused(monkeypatch):
    monkeypatch.setattr("lnocl.core.runs.held_out.MIN_ITERATIONS", 50)
    monkeypatch.setattr("lnocl.core.runs.run.Run.best_iteration", lambda run: 0)
    with pytest.raises(DivergedError, match=r"the objective rises: .*; mend the psfs, or take"):
        paper(observe(1), engine="numpy", stop="held-out", n_iter=100)


class TestDescent:
    SCENE = Scene(lnocl.Observation(np.full((8, 8), 100.0), np.ones((1, 1))))

    def check(self, *objectives):
        Descent(self.SCENE).check(objectives)

    def test_objectives_above_the_least_in_turn_are_refused(self):
        above = [1.001 + MAX_RISE] * N_ABOVE
        with pytest.raises(DivergedError):
            self.check(2.0, 1.0, *above)
        self.check(2.0, 1.0, *above[1:])
        self.check(2.0, 1.0, *above[1:], 0.999 + MAX_RISE, *above[1:])

    def test_they_may_come_in_parts(self):
        descent = Descent(self.SCENE)
        descent.check([1.0, *[1.2] * (N_ABOVE - 1)])
        with pytest.raises(DivergedError):
            descent.check([1.2])

    def test_objectives_that_alternate_are_not(self):
        """As with a Tikhonov term that outweighs the data."""
        self.check(*[value for k in range(50) for value in (3.6 - 0.01 * k, 12.7 - 0.1 * k)])

    def test_rounding_of_a_perfect_fit_is_not(self):
        self.check(1.0, 1e-9, *[1e-8] * 100)

    @pytest.mark.parametrize("value", [np.inf, np.nan])
    def test_non_finite_objective_is_refused(self, value):
        with pytest.raises(NotFiniteError):
            self.check(1.0, value)


def explain(psf):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lnocl.LnoclWarning)
        return explain_rise(lnocl.Observation(np.ones((1, SIZE, SIZE)), psf, psf_centre="given"))


NEGATIVE = gaussian() / gaussian().sum()
NEGATIVE[0, 0] = -0.01
EXPLAINED = [
    (NEGATIVE, "1 pixel of `psfs[0]` is negative, 1.01 % of its sum; mend"),
    (gaussian(off=2.5), "the core of `psfs[0]` lies (2.5, 0.0) pixels off its centre; m"),
    (gaussian() + 0.05, "`psfs[0]` lies on a background that makes 56.5 % of its sum; m"),
    (gaussian(), "nothing in the psfs explains it; take precision double, and if it ri"),
    (gaussian(off=0.9), "nothing"),
    (gaussian() ** 0.05, "`psfs[0]` lies on a background"),
]


@pytest.mark.parametrize(("psf", "expected"), EXPLAINED)
def test_warning_names_the_psf_feature_that_explains_the_rise(psf, expected):
    assert expected in explain(psf)


def test_of_several_psfs_the_worst_is_named():
    worst = np.array([NEGATIVE, NEGATIVE - np.eye(SIZE) * 0.01, gaussian()])
    with pytest.warns(lnocl.LnoclWarning):
        observation = lnocl.Observation(np.ones((3, SIZE, SIZE)), worst)
    assert " of `psfs[1]` are negative, " in explain_rise(observation)
