"""Regions: the shares of pixels within them, and those that are refused."""

import numpy as np
import pytest
from astropy.io import fits

import lnocl
from lnocl.io.regions import read_apertures, read_profiles

regions = pytest.importorskip("regions", reason="regions is not installed")
SHAPE = (40, 50)
WCS = fits.Header(
    {
        "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 30.0, "CRVAL2": 10.0,
        "CRPIX1": 20.0, "CRPIX2": 15.0, "CDELT1": -1e-4, "CDELT2": 1e-4,
        "CUNIT1": "deg", "CUNIT2": "deg",
    }
)  # fmt: skip


def read(text, tmp_path, header=None):
    path = tmp_path / "a.reg"
    path.write_text(text)
    return read_apertures(path, header, SHAPE)


def test_shares_sum_to_the_area_and_lie_where_the_region_is(tmp_path):
    found = read(
        "image\ncircle(11,21,4) # text={knot}\nellipse(25,20,6,3,30)\nbox(30,10,8.5,3,0)\n"
        "polygon(5,5,11,5,11,15)",
        tmp_path,
    )
    assert [each.name for each in found] == ["knot", "region 2", "region 3", "region 4"]
    areas = [np.pi * 16, np.pi * 18, 25.5, 30.0]
    np.testing.assert_allclose([each.n_pixels for each in found], areas, rtol=1e-6)
    y, x = np.indices(SHAPE, float)
    middles = [(10, 20), (24, 19), (29, 9), (8, 22 / 3)]
    for each, (x0, y0) in zip(found, middles, strict=True):
        middle = each.flux(x) / each.n_pixels, each.flux(y) / each.n_pixels
        np.testing.assert_allclose(middle, (x0, y0), atol=0.02)  # of pixels, not of their parts
        assert 0 <= each.weights.min() <= each.weights.max() <= 1 + 1e-12


def test_an_annulus_lacks_its_hole(tmp_path):
    annulus, disc, hole = read(
        "image\nannulus(21.3,20.6,3,6)\ncircle(21.3,20.6,6)\ncircle(21.3,20.6,3)", tmp_path
    )
    sky = np.random.default_rng(0).random(SHAPE)
    assert annulus.flux(sky) == pytest.approx(disc.flux(sky) - hole.flux(sky), rel=1e-12)
    turned = read("image\nellipse(21,20,2,3,4,6,30)\nbox(21,20,4,6,9,12,30)", tmp_path)
    areas = [np.pi * (4 * 6 - 2 * 3), 9 * 12 - 4 * 6]
    np.testing.assert_allclose([each.n_pixels for each in turned], areas, rtol=1e-6)


@pytest.mark.parametrize("frame", ["", "physical\n", "global color=red\nPhysical; "])
def test_a_file_that_names_no_coordinates_is_in_pixels(frame, tmp_path, caplog):
    with caplog.at_level("INFO", "lnocl"):
        (found,) = read(f"{frame}circle(20,15,5)\n", tmp_path)
    (expected,) = read("image\ncircle(20,15,5)", tmp_path)
    assert (found.y, found.x) == (expected.y, expected.x)
    np.testing.assert_array_equal(found.weights, expected.weights)
    assert "a.reg names no coordinates: its regions are taken in pixels" in caplog.text


def test_a_region_on_the_sky_is_that_in_pixels(tmp_path):
    (found,) = read('icrs\ncircle(30.0,10.0,1.8")', tmp_path, WCS)
    (expected,) = read("image\ncircle(20,15,5)", tmp_path)
    assert (found.y, found.x) == (expected.y, expected.x)
    np.testing.assert_allclose(found.weights, expected.weights, atol=2e-4)


def test_regions_may_be_given_themselves():
    circle = regions.CirclePixelRegion(regions.PixCoord(12.5, 8.0), 2.5)
    (found,) = read_apertures([circle], None, SHAPE)
    assert found.n_pixels == pytest.approx(np.pi * 6.25)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("image\ncircle(100,21,4)", r"^region 1 \(circle\) lies outside the image of 50 x 40"),
        ("image\ncircle(2,21,4) # text={a}", r"^a of .*a.reg \(circle\) lies .*, or partly$"),
        ("image\npoint(3,3)", r"^region 1 \(point\) cannot be summed over: give circles, ellipses"),
        ("icrs\ncircle(30,10,1\")", r"is on the sky, and the image has no header: give pixels$"),
        ("image\n-circle(20,20,4)", r"^region 1 \(circle\) is an exclusion region"),
        ("image\ncircle(20,20,1e7)", r"^region 1 \(circle\) lies outside the image of 50 x 40"),
    ],
)  # fmt: skip
def test_regions_that_cannot_be_measured_are_refused(text, message, tmp_path):
    with pytest.raises(lnocl.InputError, match=message):
        read(text, tmp_path)


def test_a_region_on_the_sky_needs_coordinates(tmp_path):
    with pytest.raises(lnocl.InputError, match=r"no sky coordinates .* give regions in"):
        read('icrs\ncircle(30,10,1")', tmp_path, fits.Header())


@pytest.mark.parametrize(
    "text", ["", "image\n", "no regions at all\n", "image\ncircle(1,\n", "\0\1"]
)
def test_a_file_without_regions_is_refused(text, tmp_path):
    with pytest.raises(lnocl.FileError, match=r"a\.reg holds no regions"):
        read(text, tmp_path)


def test_missing_region_file_and_invalid_regions_are_refused(tmp_path):
    with pytest.raises(lnocl.FileError, match=r"nix\.reg is not there: give a file of regions"):
        read_apertures(tmp_path / "nix.reg", None, SHAPE)
    with pytest.raises(lnocl.InputError, match=r"^regions must be those of the package regions; 3"):
        read_apertures([3], None, SHAPE)


@pytest.mark.parametrize("at", ['210,-10,1"', "30.0,10.0,20d"])
def test_a_region_of_another_field_is_refused(at, tmp_path):
    with pytest.raises(lnocl.InputError, match=r"\(circle\) lies outside the image of 50 x 40"):
        read(f"icrs\ncircle({at})", tmp_path, WCS)


def test_regions_of_one_name_are_numbered(tmp_path):
    found = read("image\n" + "circle(20,20,4) # text={ a }\n" * 2 + "circle(9,9,3)", tmp_path)
    assert [each.name for each in found] == ["a 1", "a 2", "region 3"]


def test_labels_beside_regions_are_no_regions(tmp_path):
    found = read("image\ncircle(20,20,4)\n# text(9,9) text={a label}\n", tmp_path)
    assert [each.name for each in found] == ["region 1"]


def test_labels_of_casa_are_names(tmp_path):
    path = tmp_path / "a.crtf"
    path.write_text('#CRTFv0\ncircle[[20pix, 20pix], 4pix], coord=image, label="knot"\n')
    assert [each.name for each in read_apertures(path, None, SHAPE)] == ["knot"]


# --- Profiles


def ridge(turn, x0=24.0, y0=19.0, width=2.0):
    """Return a Gaussian ridge along a line turned by so many degrees, and light along it."""
    y, x = np.indices(SHAPE, float)
    cos, sin = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    along, across = (x - x0) * cos + (y - y0) * sin, (y - y0) * cos - (x - x0) * sin
    return (2.0 + np.sin(along / 4.0)) * np.exp(-0.5 * (across / width) ** 2), along


@pytest.mark.parametrize(
    ("sides", "turn"), [("18,14", 0), ("14,18", 0), ("18,14", 35), ("14,18", 35)]
)
def test_a_profile_is_along_the_longer_side(sides, turn, tmp_path):
    path = tmp_path / "p.reg"
    path.write_text(f"image\nbox(25,20,{sides},{turn}) # text={{jet}}")
    (profile,) = read_profiles(path, None, SHAPE)
    is_tall = sides == "14,18"
    # The ridge lies beside the axis of the box.
    shift = np.radians(turn + 90 * is_tall)
    sky, _ = ridge(turn + 90 * is_tall, 24.0 - 1.2 * np.sin(shift), 19.0 + 1.2 * np.cos(shift))
    assert profile.name == "jet"
    np.testing.assert_allclose(profile.at, np.arange(18) - 8.5)
    # Light beside the sky is in the fluxes alone.
    fluxes, widths = profile.measure(sky, sky - 1e-3).reshape(2, -1)
    fluxes += [1e-3 * each.n_pixels for each in profile.slices]
    expected = 2.0 + np.sin(np.array(profile.at) / 4.0)
    np.testing.assert_allclose(fluxes / expected, fluxes[0] / expected[0], rtol=0.02)
    # A pixel is 1 / sqrt(12) wide itself.
    np.testing.assert_allclose(widths, 2.355 * 2.0, rtol=0.03)
    inside = read_apertures(path, None, SHAPE)[0].flux(sky)
    assert fluxes.sum() == pytest.approx(inside, rel=1e-9)
    labels = profile.labels()
    assert [each.kind for each in labels] == ["flux"] * 18 + ["length"] * 18
    assert labels[0] == ("jet flux", "flux", profile.at[0])


def test_a_slice_without_light_has_no_width(tmp_path):
    (tmp_path / "p.reg").write_text("image\nbox(25,20,8,6,0)")
    (profile,) = read_profiles(tmp_path / "p.reg", None, SHAPE)
    assert not profile.measure(np.zeros(SHAPE), np.zeros(SHAPE)).any()


def test_a_profile_of_no_box_is_refused(tmp_path):
    (tmp_path / "p.reg").write_text("image\ncircle(25,20,8)")
    with pytest.raises(
        lnocl.InputError, match=r"^region 1 \(circle\) is not a box: a profile is along"
    ):
        read_profiles(tmp_path / "p.reg", None, SHAPE)
