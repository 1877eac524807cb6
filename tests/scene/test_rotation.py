"""Rotation by three shears: its adjoint, flux, and error by spatial frequency; PSFs turned."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import worst
from turned_scenes import gaussian

import lnocl
from lnocl.core.scene.rotation import Rotation, turned_psf
from lnocl.core.scene.transforms import rotation


def box(ny, nx):
    """Return the rows and columns of an image of this shape."""
    return range(ny), range(nx)


angles = st.floats(-45.0, 45.0).map(np.radians)
sides = st.sampled_from([16, 48, 64, 80])


@settings(max_examples=40)
@given(angle=angles, ny=sides, nx=sides, seed=st.integers(0, 99))
def test_adjoint_and_flux(angle, ny, nx, seed):
    rng = np.random.default_rng(seed)
    turn = Rotation(angle, rng.uniform(-200, 200, 2), (ny, nx), box(ny - 5, nx - 5))
    sky, image = rng.normal(size=(2, ny, nx))
    forward, back = turn.forward(sky), turn.adjoint(image)
    size = np.linalg.norm(forward) * np.linalg.norm(image)
    assert abs((forward * image).sum() - (sky * back).sum()) <= 1e-14 * size
    assert forward.sum() == pytest.approx(sky.sum(), abs=1e-11)
    assert worst(turn.forward(np.ones((ny, nx))), np.ones((ny, nx))) <= 1e-14
    assert worst(turn.adjoint(np.ones((ny, nx))), np.ones((ny, nx))) <= 1e-14


# Cycles per pixel, and the largest error allowed, as a share of the wave's amplitude: about 1.5
# times that measured over these angles.
@pytest.mark.parametrize(
    ("frequency", "allowed"),
    [(0.02, 6e-5), (0.1, 9e-5), (0.2, 1.6e-4), (0.3, 2.7e-4), (0.35, 6e-4), (0.4, 1.6e-2)],
)
def test_waves(frequency, allowed):
    """Waves in a round window, which no edge of the grid cuts, in eight directions."""
    n, errors = 128, []
    y, x = np.indices((n, n))
    middle = np.array([64.0, 64.0])
    for degrees in (-45.0, -20.0, 1.0, 10.0, 33.0, 45.0):
        turn = rotation(np.radians(degrees))
        shift = middle - turn @ middle + (0.3, -2.2)
        each = Rotation(np.radians(degrees), shift, (n, n), box(n, n))
        for direction in np.arange(8) * np.pi / 8:
            wave = frequency * np.array([np.cos(direction), np.sin(direction)])

            def seen(u, v, wave=wave):
                du, dv = u - middle[0], v - middle[1]
                window = np.exp(-0.5 * (du**2 + dv**2) / 13.0**2)
                return window * np.cos(2 * np.pi * (wave[0] * du + wave[1] * dv))

            spectrum = np.fft.rfft2(seen(x, y)) * each.undone()
            found = each.forward(np.fft.irfft2(spectrum, (n, n)))
            u, v = np.einsum("ij,jyx->iyx", turn.T, np.array([x, y]) - shift[:, None, None])
            errors.append(abs(found - seen(u, v)).max())
    assert max(errors) <= allowed
    assert max(errors) >= allowed / 2  # else the bound is too wide


def test_its_matrix():
    rng = np.random.default_rng(1)
    turn, sky = Rotation(0.4, np.array([3.3, -40.2]), (48, 64), box(20, 30)), rng.random((48, 64))
    sheared = np.fft.irfft(np.fft.rfft(sky, axis=1) * turn.row_phases(), 64, axis=1)
    found = (turn.matrix((20, 30)) @ sheared.ravel()).reshape(20, 30)
    assert worst(found, turn.forward(sky)[:20, :30]) <= 1e-14


def test_no_turn_is_a_shift():
    """Whole pixels move bit for bit, and pixels of twice the side are every second."""
    sky = np.random.default_rng(0).random((32, 48))
    still = Rotation(0.0, np.array([5.0, -3.0]), (32, 48), box(20, 30))
    np.testing.assert_array_equal(still.column_shifts, 3.0)
    expected = np.roll(sky, (-3, 5), (0, 1))
    assert worst(still.forward(sky), expected) <= 1e-15  # of the transform of the first shear
    assert (still.undone() == 1.0).all()
    larger = Rotation(0.0, np.array([2.0, 1.0]), (64, 64), box(10, 12), 2.0)
    sky = np.random.default_rng(1).random((64, 64))
    assert worst(larger.forward(sky)[1:10, 2:12], sky[0:18:2, 0:20:2]) <= 1e-15
    assert (larger.undone() == 1.0).all()


@settings(max_examples=40)
@given(angle=angles, scale=st.floats(1.01, 8.0), ny=sides, nx=sides, seed=st.integers(0, 99))
def test_adjoint_of_larger_pixels(angle, scale, ny, nx, seed):
    rng = np.random.default_rng(seed)
    used = box(math.ceil(ny / scale), math.ceil(nx / scale))
    turn = Rotation(angle, rng.uniform(-200, 200, 2), (ny, nx), used, scale)
    sky, image = rng.normal(size=(2, ny, nx))
    forward, back = turn.forward(sky), turn.adjoint(image)
    size = np.linalg.norm(forward) * np.linalg.norm(image)
    assert abs((forward * image).sum() - (sky * back).sum()) <= 1e-14 * size


# Scale, angle, and the largest error allowed: about 1.5 times that measured. A step of whole pixels
# and no turn is exact, but for the PSFs' edges.
@pytest.mark.parametrize(
    ("scale", "degrees", "allowed"),
    [(1.07, 0.0, 1e-4), (1.5, 17.0, 9e-4), (2.8, -34.0, 6e-5), (5.6, 0.0, 1e-5), (5.6, 23.0, 1e-3)],
)
def test_larger_pixels(scale, degrees, allowed):
    """Blobs as sharp as a PSF of 2.4 pixels of the image, at places between pixels."""
    n, covariance = 256, np.array([[3.0, 1.0], [1.0, 2.0]])
    turn = rotation(np.radians(degrees)) / scale
    m = math.ceil(144 / scale)
    shift = np.array([m / 2, m / 2]) + 0.37 - turn @ [n / 2, n / 2]
    each = Rotation(np.radians(degrees), shift, (n, n), box(m, m), scale)
    stars = np.array([(120.3, 131.2), (90.0, 100.4), (150.0, 140.0)])
    y, x = np.indices((n, n))
    back = np.linalg.inv(turn)
    of_sky = back @ covariance @ back.T
    blurred = sum(gaussian(x - u, y - v, of_sky) for u, v in stars)
    spectrum = np.fft.rfft2(blurred) * each.undone()
    found = each.forward(np.fft.irfft2(spectrum, (n, n)))[:m, :m]
    y, x = np.indices((m, m))
    there = stars @ turn.T + shift
    expected = sum(gaussian(x - u, y - v, covariance) for u, v in there) / scale**2
    assert allowed / 2 <= worst(found, expected) <= allowed


@pytest.mark.parametrize("degrees", [-45.0, -10.0, 20.0, 45.0])
@pytest.mark.parametrize("scale", [1.0, 2.6])
@pytest.mark.parametrize("shape", [(31, 31), (24, 37)])
def test_a_psf_is_turned_about_its_centre(degrees, shape, scale):
    covariance = np.array([[5.0, 1.0], [1.0, 3.0]])
    y, x = np.indices(shape)
    psf = gaussian(x - shape[1] // 2, y - shape[0] // 2, covariance)
    found = turned_psf(psf, np.radians(degrees), scale)
    n = len(found)
    turn = rotation(np.radians(degrees)) / scale
    v, u = np.indices((n, n)) - n // 2
    expected = gaussian(*np.einsum("ij,jyx->iyx", turn, np.array([u, v])), covariance) / scale**2
    assert worst(found, expected) <= 2e-5  # the PSF is cut off at its edges
    assert found.sum() == pytest.approx(psf.sum(), rel=1e-9)


def test_images_upright_have_the_maps_of_the_images_as_given():
    quarter = np.array([[0.0, -1.0, 31.5], [1.0, 0.0, 2.25]])
    back = np.array([[0.0, 1.0, -2.5], [-1.0, 0.0, 40.0]])
    maps = np.array([np.eye(2, 3), quarter, back])
    observation = lnocl.Observation(np.ones((3, 30, 44)), np.ones((3, 3)), transforms=maps)
    assert observation.upright().geometry.orientations
    np.testing.assert_allclose(observation.upright().transforms, maps, atol=1e-12)
