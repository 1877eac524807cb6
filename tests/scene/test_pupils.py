"""Pupils: their PSFs against the simulated telescope, their phases against what these stand for."""

import astropy.units as u
import numpy as np
import pytest

import lnocl
from lnocl.core.scene.pupils import Pupil
from lnocl.simulation import circular_pupil, fizeau_psf, fizeau_pupil

N = 64
Y, X = np.indices((N, N)) - N // 2
DISC = np.clip(12.5 - np.hypot(X, Y), 0.0, 1.0)
SCALE = 2.12 * u.um, 5 * u.mas
PUPILS = {"a disc": (DISC, 7), "two apertures": (fizeau_pupil((N, N), 30 * u.deg, *SCALE), 17)}
each_pupil = pytest.mark.parametrize(("pupil", "n"), PUPILS.values(), ids=PUPILS)


def psf_by_hand(pupil, phase):
    field = np.fft.fft2(np.fft.ifftshift(pupil * np.exp(1j * phase)))
    psf = np.fft.fftshift(abs(field) ** 2)
    return psf / psf.sum()


def phase_map(pupil, k):
    phase = np.zeros(pupil.shape)
    phase[pupil > 0] = Pupil(pupil)._phases[k]
    return phase


@each_pupil
def test_phases_are_orthogonal_and_of_one_radian(pupil, n):
    found = Pupil(pupil)
    assert found.n_phases == n
    weights = pupil[pupil > 0] ** 2
    products = (found._phases * weights / weights.sum()) @ found._phases.T
    np.testing.assert_allclose(products, np.eye(n), rtol=0, atol=1e-12)
    for each in (np.ones_like(X), X, Y):  # piston and tilt
        assert abs((found._phases * weights) @ each[pupil > 0]).max() < 1e-9 * weights.sum()


@each_pupil
def test_the_psf_is_that_of_the_field(pupil, n):
    z = np.random.default_rng(0).normal(0.0, 0.3, n)
    phase = sum(c * phase_map(pupil, k) for k, c in enumerate(z))
    np.testing.assert_allclose(Pupil(pupil).psf(z), psf_by_hand(pupil, phase), rtol=0, atol=1e-15)
    np.testing.assert_allclose(
        Pupil(pupil).ideal_psf(), psf_by_hand(pupil, 0.0), rtol=0, atol=1e-15
    )


@each_pupil
def test_slopes_are_the_derivatives(pupil, n):
    found, h = Pupil(pupil), 1e-6
    z = np.random.default_rng(1).normal(0.0, 0.2, n)
    for k, slope in enumerate(found.slopes(z)):
        step = h * np.eye(n)[k]
        change = (found.psf(z + step) - found.psf(z - step)) / (2 * h)
        np.testing.assert_allclose(slope, change, rtol=0, atol=1e-7 * abs(change).max())


def test_stray_pixels_are_no_aperture():
    stray = DISC.copy()
    stray[3, 3] = 0.5
    assert Pupil(stray).n_phases == 7


@pytest.mark.parametrize("angle", [0, 45, 110])
def test_two_apertures_have_the_psf_of_the_telescope(angle):
    """Whose pupil is sampled more finely: edges of pixels of 0.3 m are what is left."""
    pupil = fizeau_pupil((256, 256), angle * u.deg, *SCALE)
    psf = fizeau_psf((256, 256), angle * u.deg, *SCALE)
    error = np.linalg.norm(Pupil(pupil).ideal_psf() - psf) / np.linalg.norm(psf)
    assert error < 0.03


def test_a_circular_pupil_has_its_area_and_place():
    pixel = (1 * u.um / (10 * u.mas).to(u.rad, u.dimensionless_angles()).value / N).to_value(u.m)
    pupil = circular_pupil(
        (N, N), 1 * u.um, 10 * u.mas, 6 * u.m, 2 * u.m, [(1.0, -2.0) * u.m, (-4.0, 5.0) * u.m]
    )
    assert pupil.sum() * pixel**2 == pytest.approx(2 * np.pi * (9 - 1), rel=0.01)
    assert (pupil * X).sum() / pupil.sum() * pixel == pytest.approx(-1.5, abs=0.02)
    assert (pupil * Y).sum() / pupil.sum() * pixel == pytest.approx(1.5, abs=0.02)


def test_apertures_that_overlap_are_open_once():
    pupil = circular_pupil((N, N), 1 * u.um, 10 * u.mas, 6 * u.m, centres=np.zeros((2, 2)) * u.m)
    np.testing.assert_array_equal(pupil, circular_pupil((N, N), 1 * u.um, 10 * u.mas, 6 * u.m))


REFUSED = [
    ({"obscuration": 8 * u.m}, "obscuration must be less than diameter"),
    ({"diameter": 30 * u.m}, "an aperture reaches beyond the frame of 20.3 m"),
    ({"diameter": 8 * u.s}, "diameter must be a quantity in m"),
    ({"shape": (7, 8)}, "the image is 8 x 7 pixels"),
    ({"centres": [0, 0] * u.m}, r"centres must be \(x, y\) of each aperture"),
    ({"centres": [[0, 0, 0]] * u.m}, r"centres must be \(x, y\) of each aperture"),
    ({"centres": np.zeros((0, 2)) * u.m}, "no pixel of the pupil is open"),
    ({"diameter": 1 * u.mm}, "no pixel of the pupil is open"),
]


@pytest.mark.parametrize(("changed", "message"), REFUSED)
def test_invalid_pupil_parameters_are_refused(changed, message):
    given = {"shape": (N, N), "wavelength": 1 * u.um, "pixel_scale": 10 * u.mas}
    with pytest.raises(lnocl.InputError, match=message):
        circular_pupil(**given | {"diameter": 8 * u.m} | changed)
