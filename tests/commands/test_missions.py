"""Files of space telescopes as they come, with no option but the PSF and the star."""

import re
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.time import Time
from astropy.wcs import WCS
from commandline import NUMPY, gaussian

from lnocl.commands import cli
from lnocl.io.missions import calibrate

HEADERS = Path(__file__).parent / "headers"
N, AT = 72, (37, 31)
Y, X = np.indices((N, N))
SKY, STAR = 400.0, 2.0e5
GOOD = (np.hypot(X - AT[0], Y - AT[1]) > 12) & (X > 8) & (Y > 8) & (X < N - 8) & (Y < N - 8)


def electrons(seed, sky=SKY):
    means = STAR * gaussian(N, *AT, 1.6) + sky
    return np.random.default_rng(seed).poisson(means).astype(float)


def noise(seed, scatter):
    return np.random.default_rng(seed + 100).normal(0.0, scatter, (N, N))


def headers_of(name):
    """Return the cards of the HDUs of a real file, by their names, from its copy in headers/."""
    parts = re.split(r"^# (\w+)\n", (HEADERS / f"{name}.hdr").read_text(), flags=re.MULTILINE)
    return {
        part: fits.Header.fromstring(cards, sep="\n")
        for part, cards in zip(parts[1::2], parts[2::2], strict=True)
    }


def write(path, headers, science, **extensions):
    """Write a file as a pipeline does: no pixels in the primary HDU, then SCI and others."""
    hdus = [fits.PrimaryHDU(header=headers["PRIMARY"])]
    for name, values in {"SCI": science, **extensions}.items():
        cards = headers.get(name, fits.Header())
        if "CRPIX1" in cards:
            cards["CRPIX1"] = cards["CRPIX2"] = N / 2
        hdus.append(fits.ImageHDU(values.astype("f4") if values.dtype == float else values, cards))
        hdus[-1].name = name
    fits.HDUList(hdus).writeto(path)


def of_nircam(kind):
    """Return MJy/sr, of a gain of 1.8 electrons in a DN."""
    headers = headers_of(f"nircam_{kind}")
    seconds, in_dn = headers["PRIMARY"]["EFFEXPTM"], headers["SCI"]["PHOTMJSR"]
    each = 1.8 * seconds / in_dn
    image = (electrons(1) + noise(1, 12.0)) / each
    counts = (image / each).clip(0.0)
    read = np.full((N, N), (12.0 / each) ** 2)
    planes = {"ERR": np.sqrt(counts + read), "VAR_POISSON": counts, "VAR_RNOISE": read}
    if kind == "cal":
        flags = np.random.default_rng(2).choice([0, 4], (N, N), p=[0.8, 0.2]).astype("u4")
        # The ramps in the core of the star saturated after a third, and a fifth has jumps.
        flags[np.hypot(X - AT[0], Y - AT[1]) < 3] |= 2
        cut = flags > 0
        more = 0.5 * (counts + read)[cut]
        image[cut] += np.random.default_rng(3).normal(0.0, np.sqrt(more))
        for plane in (counts, read):
            plane[cut] *= 1.5
        planes["ERR"] = np.sqrt(counts + read)
        flags[3, 5] = 1 + 2
        image[flags % 2 == 1] = np.nan
        planes = {"DQ": flags, **planes}
    else:
        for values in (image, *planes.values()):
            values[:, :2] = np.nan
        planes |= {"CON": np.ones((1, N, N), "i4"), "WHT": np.ones((N, N))}
    write(f"{kind}.fits", headers, image, **planes)
    return each, "MJy/sr"


def of_acs(kind):
    image = electrons(3) + noise(3, 5.0)
    errors = np.sqrt(image.clip(0.0) + 25.0)
    flags = np.random.default_rng(4).choice([0, 64], (N, N), p=[0.8, 0.2]).astype("i2")
    flags[50, 20], image[50, 20] = 4096, 1e5  # a cosmic ray
    write(f"{kind}.fits", headers_of(f"acs_{kind}"), image, ERR=errors, DQ=flags)
    return 1.0, "electron"


def of_wfc3_ir(kind):
    headers = headers_of("wfc3_ir_flt")
    seconds = headers["PRIMARY"]["EXPTIME"]
    image = (electrons(5) + noise(5, 14.0)) / seconds
    errors = np.sqrt((seconds * image).clip(0.0) + 14.0**2) / seconds
    flags = np.random.default_rng(4).choice([0, 512, 16], (N, N), p=[0.6, 0.2, 0.2]).astype("i2")
    flags[10, 12], image[10, 12] = 4, 900.0
    write(f"{kind}.fits", headers, image, ERR=errors, DQ=flags)
    return seconds, "electron/s"


def of_drizzle(kind):
    """Return a mosaic, of which the sky was subtracted, or not, with bad pixels of no weight."""
    headers = headers_of("wfc3_ir_drz")
    seconds = headers["PRIMARY"]["EXPTIME"]
    sky = 0.0 if kind == "single" else SKY
    image = (electrons(6) + noise(6, 8.0) - sky) / seconds
    weights = np.full((N, N), seconds, "f4")
    weights[:, -3:] = weights[50:53, 20:23] = 0.0
    image[:, -3:], image[50:53, 20:23] = np.nan, 999.0
    write(f"{kind}.fits", headers, image, WHT=weights, CTX=np.ones((N, N), "i4"))
    return seconds, "electron/s"


def write_plainly(path, primary, cards, **extensions):
    headers = {"PRIMARY": fits.Header(primary), "SCI": fits.Header(cards)}
    write(path, headers, np.ones((N, N)), **extensions)


def write_stpsf():
    """Write a PSF in the four extensions that STPSF has."""
    detected, finer = gaussian(33, 16, 16, 1.6), gaussian(132, 65.5, 65.5, 6.4)
    hdus = [fits.PrimaryHDU(finer)]
    for name, psf in (("DET_SAMP", detected), ("OVERDIST", finer), ("DET_DIST", detected)):
        hdus.append(fits.ImageHDU(psf, name=name))
    hdus[0].header["OVERSAMP"] = hdus[2].header["OVERSAMP"] = 4
    fits.HDUList(hdus).writeto("stpsf.fits")


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("make", "kind"),
    [
        (of_nircam, "cal"),
        (of_nircam, "i2d"),
        (of_acs, "flt"),
        (of_wfc3_ir, "ir"),
        (of_acs, "flc"),
        (of_drizzle, "drz"),
        (of_drizzle, "single"),
    ],
)
def test_photometry_and_noise(command_folder, capsys, make, kind):
    each, unit = make(kind)
    write_stpsf()
    options = ["--psf", "stpsf.fits", "--star", f"{AT[0]},{AT[1]}", "--residuals", *NUMPY]
    options += ["-o", "o.fits", "--verbose"]
    assert cli.main(["deconvolve", f"{kind}.fits", *options]) == 0
    said = capsys.readouterr().err
    if make is of_nircam:
        (electrons_said,) = re.findall(
            r"image 1: (\S+) electrons in its unit, by VAR_POISSON", said
        )
        assert float(electrons_said) == pytest.approx(each, rel=0.01)
    assert f"as for images of {'JWST' if make is of_nircam else 'HST'}" in said
    with fits.open("o.fits") as file:
        assert file[0].header["BUNIT"].replace("ELECTRONS", "electron") == unit
        near = np.hypot(X - AT[0], Y - AT[1]) < 9
        found = file["STARS"].data["flux"][0] + (file[0].data * near).sum()
        assert found * each == pytest.approx(STAR, rel=0.01)
        sky = file["RESIDUALS"].data[0][GOOD]
        assert file[0].header["TELESCOP"] in said
        assert "DATE-OBS" in file[0].header
        assert file[0].header["CTYPE1"].startswith("RA---TAN")
        command = "".join(file[0].header["HISTORY"]).replace("\\", "")
    assert np.nanstd(sky) == pytest.approx(1.0, abs=0.05)
    for option in EXPECTED[kind]:
        assert f" {option} " in command


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", ["photutils", "SExtractor", "Gaia"])
def test_tables_of_stars(command_folder, capsys, kind):
    seconds, _ = of_wfc3_ir("ir")
    write_stpsf()
    x, y = (np.array([float(at)]) for at in AT)
    header = fits.getheader("ir.fits", "SCI")
    place = WCS(header).pixel_to_world(x, y)
    epoch = Time(fits.getval("ir.fits", "DATE-OBS")).jyear
    columns = {
        "photutils": {"id": [1], "xcentroid": x, "ycentroid": y},
        "SExtractor": {"NUMBER": [1], "X_IMAGE": x + 1, "Y_IMAGE": y + 1},
        # It was elsewhere, and has come to its place by the date of the image.
        "Gaia": {
            "ra": place.ra.deg,
            "dec": place.dec.deg - (epoch - 2016.0) * 40.0 / 3.6e6,
            "ref_epoch": [2016.0],
            "pmra": [0.0],
            "pmdec": [40.0],
        },
    }
    Table(columns[kind]).write("t.vot", format="votable")
    options = ["--psf", "stpsf.fits", "--stars", "t.vot", *NUMPY, "-o", "o.fits"]
    assert cli.main(["deconvolve", "ir.fits", *options]) == 0
    with fits.open("o.fits") as file:
        stars = file["STARS"].data
        np.testing.assert_allclose([stars["x"][0], stars["y"][0]], AT, atol=0.01)
        near = np.hypot(X - AT[0], Y - AT[1]) < 9
        found = stars["flux"][0] + (file[0].data * near).sum()
    assert found * seconds == pytest.approx(STAR, rel=0.01)


EXPECTED = {
    "cal": ["--gain VAR_POISSON", "--noise err", "--mask dq"],
    "i2d": ["--gain VAR_POISSON", "--noise err"],
    "flt": ["--noise err", "--mask dq"],
    "flc": ["--noise err", "--mask dq"],
    "ir": ["--exposure EXPTIME", "--noise err", "--mask dq"],
    "drz": ["--exposure EXPTIME", "--mask wht"],
    "single": ["--exposure EXPTIME", "--mask wht"],
}


@pytest.mark.usefixtures("command_folder")
class TestWhatIsGiven:
    def test_given_calibration_takes_precedence_over_the_telescope_header(self):
        of_wfc3_ir("ir")
        every = {"noise", "mask", "background", "exposure"}
        assert calibrate("ir.fits", {}).keys() == every
        for name, value, without in [
            ("noise", ["rms=a.fits"], {"noise"}),
            ("read_noise", [3.0], {"noise"}),
            ("mask", ["a.fits"], {"mask"}),
            ("background", [5.0], {"background"}),
            ("gain", 2.0, set()),
            ("exposure", [9.0], {"exposure"}),
        ]:
            assert calibrate("ir.fits", {name: value}).keys() == every - without

    def test_rate_image_without_exposure_time_is_refused(self, capsys):
        cards = {"BUNIT": "ELECTRONS/S"}
        write_plainly("ir.fits", {"TELESCOP": "HST"}, cards)
        assert calibrate("ir.fits", {}).keys() == {"read_noise", "background"}
        assert cli.main(["deconvolve", "ir.fits", "--psf", "k1.fits", "-o", "o.fits"]) == 2
        assert "ir.fits holds counts per time; give --exposure, in " in capsys.readouterr().err

    def test_counts_of_a_converter_are_not_taken_for_electrons(self, capsys):
        cards = {"BUNIT": "COUNTS"}
        write_plainly("wfpc2.fits", {"TELESCOP": "HST", "INSTRUME": "WFPC2"}, cards)
        assert cli.main(["deconvolve", "wfpc2.fits", "--psf", "k1.fits", "-o", "o.fits"]) == 2
        assert "wfpc2.fits is in counts of its converter; give --gain" in capsys.readouterr().err
        assert "gain" not in calibrate("wfpc2.fits", {"gain": "ATODGAIN"})
        write_plainly("sbc.fits", {"TELESCOP": "HST", "DETECTOR": "SBC"}, cards)
        assert calibrate("sbc.fits", {}).keys() == {"read_noise", "background"}

    @pytest.mark.exhaustive
    def test_nicmos_needs_no_option(self, capsys):
        """Its converter's gain is ADCGAIN; ERR may lack the noise of the source."""
        seconds, gain = 703.9, 5.4
        image = (electrons(7) + noise(7, 20.0)) / (seconds * gain)
        errors = np.full((N, N), 15.0 / (seconds * gain))
        headers = {
            "PRIMARY": fits.Header({"TELESCOP": "HST", "INSTRUME": "NICMOS", "EXPTIME": seconds,
                                    "ADCGAIN": gain, "CAMERA": 2}),
            "SCI": fits.Header({"BUNIT": "COUNTS/S"}),
        }  # fmt: skip
        write("nicmos.fits", headers, image, ERR=errors, DQ=np.zeros((N, N), "i2"))
        write_stpsf()
        command = ["deconvolve", "nicmos.fits", "--psf", "stpsf.fits", "--star", f"{AT[0]},{AT[1]}"]
        assert cli.main([*command, "-o", "o.fits", *NUMPY]) == 0
        said = capsys.readouterr().err
        assert "nicmos.fits: with gain ADCGAIN, as for images of HST" in said
        assert "nicmos.fits: with exposure EXPTIME, as for images of HST" in said
        assert "--noise err is not taken, and the sky measured: --read-noise auto" in said
        with fits.open("o.fits") as file:
            near = np.hypot(X - AT[0], Y - AT[1]) < 9
            found = file["STARS"].data["flux"][0] + (file[0].data * near).sum()
            assert found * seconds * gain == pytest.approx(STAR, rel=0.01)
            repeated = "".join(file[0].header["HISTORY"]).replace("\\", "")
            assert "--noise" not in repeated
            assert "--gain ADCGAIN" in repeated
            assert float(file[0].header["RON1"]) == pytest.approx(20.0, rel=0.05)
        assert cli.main([*command, "-o", "p.fits", "--noise", "err"]) == 2
        assert "is less than the noise of its counts" in capsys.readouterr().err

    def test_other_telescopes_say_nothing(self):
        write_plainly("other.fits", {"TELESCOP": "Keck"}, {}, ERR=np.ones((N, N)))
        assert calibrate("other.fits", {}) == {}
        assert calibrate("a.fits", {}) == {}

    def test_variances_that_tell_no_gain(self, capsys):
        of_nircam("cal")
        with fits.open("cal.fits", mode="update") as file:
            file["VAR_POISSON"].data[:] = 1.0
        write_stpsf()
        command = ["deconvolve", "cal.fits", "--psf", "stpsf.fits", "-o", "o.fits"]
        assert cli.main(command) == 2
        assert (
            "error: the variance of the counts of cal.fits does not grow with its image; give "
            "--gain as a number, the electrons in its unit"
        ) in capsys.readouterr().err
        assert cli.main([*command, "--exposure", "3", "--gain", "VAR_POISSON"]) == 2
