"""Files of space telescopes as they come, with no option but the PSF and the star."""

import re

import numpy as np
import pytest
from astropy.io import fits

from lnocl.commands import cli
from lnocl.io.missions import calibrate

N, AT = 72, (37, 31)
Y, X = np.indices((N, N))
SKY, STAR = 400.0, 2.0e5
GOOD = (np.hypot(X - AT[0], Y - AT[1]) > 12) & (X > 8) & (Y > 8) & (X < N - 8) & (Y < N - 8)


def gaussian(n, x, y, width=1.6):
    y0, x0 = np.indices((n, n))
    psf = np.exp(-((x0 - x) ** 2 + (y0 - y) ** 2) / (2.0 * width**2))
    return psf / psf.sum()


def electrons(seed, sky=SKY):
    means = STAR * gaussian(N, *AT) + sky
    return np.random.default_rng(seed).poisson(means).astype(float)


def noise(seed, scatter):
    return np.random.default_rng(seed + 100).normal(0.0, scatter, (N, N))


def write(path, primary, science, **extensions):
    """Write a file as a pipeline does: no pixels in the primary HDU, then SCI and others."""
    image, cards = science
    hdus = [fits.PrimaryHDU(header=fits.Header(primary))]
    hdus.append(fits.ImageHDU(image.astype("f4"), fits.Header(cards), name="SCI"))
    hdus += [fits.ImageHDU(values, name=name) for name, values in extensions.items()]
    fits.HDUList(hdus).writeto(path)


def of_nircam(kind):
    """Return MJy/sr, of a gain of 1.8 electrons in a DN, 300 s, and 0.4 MJy/sr in a DN/s."""
    each = 1.8 * 300.0 / 0.4
    image = (electrons(1) + noise(1, 12.0)) / each
    counts = (image / each).clip(0.0)
    read = np.full((N, N), (12.0 / each) ** 2)
    planes = {"ERR": np.sqrt(counts + read), "VAR_POISSON": counts, "VAR_RNOISE": read}
    primary = {"TELESCOP": "JWST", "INSTRUME": "NIRCAM", "DETECTOR": "NRCALONG", "FILTER": "F444W"}
    cards = {"BUNIT": "MJy/sr", "PHOTMJSR": 0.4, "PIXAR_SR": 9.3e-14, "XPOSURE": 300.0}
    if kind == "cal":
        flags = np.random.default_rng(2).choice([0, 4], (N, N), p=[0.8, 0.2]).astype("u4")
        flags[3, 5] = flags[40, 60] = 1 + 2
        image[flags % 2 == 1] = np.nan
        planes = {"DQ": flags, "AREA": np.ones((N, N)), **planes}
    else:
        for values in (image, *planes.values()):
            values[:, :2] = np.nan
        planes |= {"CON": np.ones((1, N, N), "i4"), "WHT": np.ones((N, N))}
    write(f"{kind}.fits", primary, (image, cards), **{k: v.astype("f4") if v.dtype == float else v
          for k, v in planes.items()})  # fmt: skip
    return each, "MJy/sr"


def of_acs(kind):
    image = electrons(3) + noise(3, 5.0)
    errors = np.sqrt(image.clip(0.0) + 25.0)
    flags = np.random.default_rng(4).choice([0, 64], (N, N), p=[0.8, 0.2]).astype("u2")
    flags[50, 20], image[50, 20] = 4096, 1e5  # a cosmic ray
    primary = {"TELESCOP": "HST", "INSTRUME": "ACS", "DETECTOR": "WFC", "EXPTIME": 500.0}
    write(
        f"{kind}.fits", primary, (image, {"BUNIT": "ELECTRONS"}), ERR=errors.astype("f4"), DQ=flags
    )
    return 1.0, "electron"


def of_wfc3_ir(kind):
    image = (electrons(5) + noise(5, 14.0)) / 250.0
    errors = np.sqrt((250.0 * image).clip(0.0) + 14.0**2) / 250.0
    flags = np.full((N, N), 8192, "u2")
    flags[10, 12], image[10, 12] = 4, 900.0
    primary = {"TELESCOP": "HST", "INSTRUME": "WFC3", "DETECTOR": "IR", "EXPTIME": 250.0}
    cards = {"BUNIT": "ELECTRONS/S"}
    write(f"{kind}.fits", primary, (image, cards), ERR=errors.astype("f4"), DQ=flags)
    return 250.0, "electron/s"


def of_drizzle(kind):
    """Return a mosaic of which the sky was subtracted."""
    image = (electrons(6) + noise(6, 8.0) - SKY) / 1200.0
    image[:, -3:] = np.nan
    primary = {"TELESCOP": "HST", "INSTRUME": "ACS", "DETECTOR": "WFC", "EXPTIME": 1200.0}
    weights = np.full((N, N), 1200.0, "f4")
    context = np.ones((N, N), "i4")
    write(f"{kind}.fits", primary, (image, {"BUNIT": "ELECTRONS/S"}), WHT=weights, CTX=context)
    return 1200.0, "electron/s"


def write_stpsf():
    """Write a PSF in the four extensions that STPSF has."""
    detected, finer = gaussian(33, 16, 16), gaussian(132, 65.5, 65.5, 6.4)
    hdus = [fits.PrimaryHDU(finer)]
    for name, psf in (("DET_SAMP", detected), ("OVERDIST", finer), ("DET_DIST", detected)):
        hdus.append(fits.ImageHDU(psf, name=name))
    hdus[0].header["OVERSAMP"] = hdus[2].header["OVERSAMP"] = 4
    fits.HDUList(hdus).writeto("stpsf.fits")


@pytest.mark.parametrize(
    ("make", "kind"),
    [
        (of_nircam, "cal"),
        (of_nircam, "i2d"),
        (of_acs, "flt"),
        (of_wfc3_ir, "ir"),
        (of_drizzle, "drz"),
    ],
)
def test_photometry_and_noise(command_folder, capsys, make, kind):
    each, unit = make(kind)
    write_stpsf()
    options = ["--psf", "stpsf.fits", "--star", f"{AT[0]},{AT[1]}", "--residuals", "-o", "o.fits"]
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
        command = "".join(file[0].header["HISTORY"]).replace("\\", "")
    assert np.nanstd(sky) == pytest.approx(1.0, abs=0.05)
    for option in EXPECTED[kind]:
        assert f" {option} " in command


EXPECTED = {
    "cal": ["--gain VAR_POISSON", "--error err", "--mask dq"],
    "i2d": ["--gain VAR_POISSON", "--error err"],
    "flt": ["--error err", "--mask dq"],
    "ir": ["--exposure EXPTIME", "--error err", "--mask dq"],
    "drz": ["--exposure EXPTIME"],
}


@pytest.mark.usefixtures("command_folder")
class TestWhatIsGiven:
    def test_goes_before_what_the_telescope_says(self):
        of_wfc3_ir("ir")
        every = {"error", "mask", "background", "exposure"}
        assert calibrate("ir.fits", {}).keys() == every
        for name, value, without in [
            ("rms", ["a.fits"], {"error"}),
            ("read_noise", [3.0], {"error"}),
            ("mask", ["a.fits"], {"mask"}),
            ("background", [5.0], {"background"}),
            ("gain", 2.0, {"exposure"}),
            ("exposure", [9.0], {"exposure"}),
        ]:
            assert calibrate("ir.fits", {name: value}).keys() == every - without

    def test_a_rate_without_its_exposure_says_none(self, capsys):
        cards = {"BUNIT": "ELECTRONS/S"}
        write("ir.fits", {"TELESCOP": "HST"}, (np.ones((N, N)), cards))
        assert calibrate("ir.fits", {}).keys() == {"read_noise"}
        assert cli.main(["deconvolve", "ir.fits", "--psf", "k1.fits", "-o", "o.fits"]) == 2
        assert "ir.fits holds counts per time; give --exposure, in " in capsys.readouterr().err

    def test_other_telescopes_say_nothing(self):
        write("other.fits", {"TELESCOP": "Keck"}, (np.ones((N, N)), {}), ERR=np.ones((N, N)))
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
