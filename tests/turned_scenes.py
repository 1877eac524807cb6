"""A small scene whose images are turned against the sky, and its model as an explicit matrix.

PSFs are Gaussians with a ghost beside each, so that what an image sees of a pixel of the sky is
known between pixels too, and no PSF has a symmetry.
Its program is that of the case "turned" of tests/kernel_cases.py.
"""

import numpy as np

import lnocl

SHAPE = NY, NX = 22, 40
GRID = 64, 64
ANGLES = np.degrees([0.25, -0.2, 0.0])
LARGER = 13, 23
CENTRE = np.array([19.5, 10.5])
STARS = np.array([(11.3, 8.2), (27.8, 12.4)])
FLUXES = np.array([900.0, 600.0])
# Covariances of the PSFs, pixels of the images.
COVARIANCES = [np.array(each) for each in ([[2.6, 0.5], [0.5, 1.7]], [[1.8, 0], [0, 2.4]])]
COVARIANCES += [np.array([[2.0, -0.4], [-0.4, 2.2]])]


def gaussian(dx, dy, covariance):
    """Return a Gaussian of unit flux at these distances from its middle."""
    (a, b), (_, c) = np.linalg.inv(covariance)
    exponent = a * dx**2 + 2 * b * dx * dy + c * dy**2
    return np.exp(-0.5 * exponent) / (2 * np.pi * np.sqrt(np.linalg.det(covariance)))


def psf(dx, dy, covariance):
    """Return a PSF at these distances from its middle."""
    ghost = gaussian(dx - 1.4, dy + 0.9, covariance)
    return 0.75 * gaussian(dx, dy, covariance) + 0.25 * ghost


def psfs():
    """Return the PSFs of the three images."""
    y, x = np.indices((19, 19)) - 9
    return np.array([psf(x, y, each) for each in COVARIANCES])


def transforms(angles=ANGLES):
    """Return the maps of images turned about the middle, and then moved a little."""
    maps = lnocl.rotations(angles, CENTRE)
    maps[:, :, 2] += [(0.3 * j, -0.4 * j) for j in range(len(angles))]
    return maps


def scaled():
    """Return the same maps, but that the last image is turned, and has pixels 1.7 times as large.

    Its good pixels are `LARGER`.
    """
    maps = transforms()
    turn = lnocl.rotations([10.0], CENTRE)[0, :, :2] / 1.7
    maps[2] = np.column_stack([turn, (11.2, 6.1) - turn @ CENTRE])
    return maps


def matrix(maps):
    """Return the A_j on the grid as a matrix, its rows the pixels of the images."""
    y, x = np.indices(SHAPE).reshape(2, -1)
    v, u = np.indices(GRID).reshape(2, -1)
    rows = []
    for each, covariance in zip(maps, COVARIANCES, strict=True):
        turn, shift = each[:, :2], each[:, 2]
        seen = np.linalg.solve(turn, np.array([x, y]) - shift[:, None])
        apart = seen[:, :, None] - np.array([u, v])[:, None]
        period = np.array(GRID[::-1])[:, None, None]
        apart = (apart + period / 2) % period - period / 2  # the sky is periodic
        dx, dy = np.einsum("ij,jnu->inu", turn, apart)
        rows.append(psf(dx, dy, covariance))
    return np.concatenate(rows)


def star_columns(maps, stars=STARS):
    """Return the images of stars as columns of the same matrix."""
    y, x = np.indices(SHAPE).reshape(2, -1)
    columns = []
    for star in stars:
        there = [each[:, :2] @ star + each[:, 2] for each in maps]
        images = [
            psf(x - at[0], y - at[1], covariance)
            for at, covariance in zip(there, COVARIANCES, strict=True)
        ]
        columns.append(np.concatenate(images))
    return np.array(columns).T


def background():
    """Return a map of the background."""
    return 4.0 + 0.05 * np.indices(SHAPE)[1]


def sky():
    """Return an extended source on the grid: two blobs and a faint floor."""
    y, x = np.indices(GRID)
    first = 6000.0 * gaussian(x - 17, y - 12, np.diag([9.0, 4.0]))
    return first + 3000.0 * gaussian(x - 30, y - 7, np.diag([4.0, 6.0])) + 0.5


def means(fluxes=FLUXES, maps=None):
    """Return the expected counts, shape (3, ny, nx)."""
    maps = transforms() if maps is None else maps
    light = matrix(maps) @ sky().ravel() + star_columns(maps) @ fluxes
    return light.reshape(3, *SHAPE) + background()


def mask(maps=None):
    """Return a few bad pixels."""
    bad = np.random.default_rng(1).random((3, *SHAPE)) < 0.04
    if maps is not None:
        bad[2, LARGER[0] :] = bad[2, :, LARGER[1] :] = True
    return bad


def coarser(maps):
    """Return maps into pixels of twice the side, each the middle of every second of the images.

    The sky's pixels stay: it is finer then, by an `oversample` of 2.
    """
    corners = maps[:, :, :2].sum(axis=2) / 2
    return np.concatenate([maps[:, :, :2], (maps[:, :, 2:] + corners[:, :, None]) / 2], axis=2)


def finer_observation(maps, seed=2):
    """Return the observation by every second pixel along each axis, of four times the light."""
    maps = transforms() if maps is None else maps
    known = background()[::2, ::2]
    light = 4 * (means(maps=maps) - background())[:, ::2, ::2]
    return lnocl.Observation(
        np.random.default_rng(seed).poisson(light + known).astype(float),
        psfs(),
        background=known,
        mask=mask(maps)[:, ::2, ::2],
        transforms=coarser(maps),
        oversample=2,
        effective_psfs=True,
    )


def observation(maps=None, **changes):
    """Return the scene's observation, or one with other maps or arguments."""
    given = {
        "images": np.random.default_rng(2).poisson(means(maps=maps)).astype(float),
        "psfs": psfs(),
        "background": background(),
        "mask": mask(maps),
        "transforms": transforms() if maps is None else maps,
    }
    return lnocl.Observation(**(given | changes))
