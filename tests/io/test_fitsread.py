"""FITS in: what is read, what is refused, and where an image lies."""

import gzip
import hashlib
import warnings

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from wcs_headers import LINEAR, PHYSICAL, SIP, TPV

from lnocl.errors import FileError, InputError, LnoclWarning
from lnocl.io import fitsread, fitswrite

IMAGE = np.arange(1.0, 121.0).reshape(10, 12)


def save(path, *hdus, checksum=False):
    fits.HDUList(list(hdus)).writeto(path, checksum=checksum)
    return str(path)


def table():
    return fits.BinTableHDU.from_columns([fits.Column("a", "D", array=np.zeros(3))])


class TestReading:
    @pytest.mark.parametrize("dtype", ["u1", "i2", "u2", "i4", "i8", "f4", "f8"])
    def test_every_type_of_pixel_becomes_float64_of_this_machine(self, tmp_path, dtype):
        path = save(tmp_path / "a.fits", fits.PrimaryHDU(IMAGE.astype(dtype)))
        data = fitsread.read_stack([path]).data
        assert data.dtype == np.float64
        assert data.dtype.isnative
        np.testing.assert_array_equal(data, IMAGE[None])

    def test_scaling_is_applied_and_blank_pixels_are_nan(self, tmp_path):
        hdu = fits.PrimaryHDU(IMAGE.astype("i2"))
        hdu.header.update(BLANK=7, BSCALE=0.5, BZERO=100.0)
        data = fitsread.read_stack([save(tmp_path / "a.fits", hdu)]).data[0]
        assert np.isnan(data[0, 6])
        assert data[0, 7] == 104.0
        assert np.isnan(data).sum() == 1

    def test_hdus_without_pixels_are_passed_over(self, tmp_path):
        header = fits.Header(LINEAR)
        path = save(
            tmp_path / "a.fits",
            fits.PrimaryHDU(),
            table(),
            fits.ImageHDU(),
            fits.ImageHDU(np.zeros((3, 0))),
            fits.ImageHDU(IMAGE, header, name="SCI"),
            fits.ImageHDU(IMAGE + 1.0, name="ERR"),
        )
        stack = fitsread.read_stack([path])
        np.testing.assert_array_equal(stack.data, IMAGE[None])
        assert stack.header["EXTNAME"] == "SCI"
        assert stack.header["CRVAL1"] == LINEAR["CRVAL1"]

    def test_a_cube_and_single_files_are_the_same_stack(self, tmp_path):
        planes = [IMAGE, 2.0 * IMAGE, 3.0 * IMAGE]
        cube = save(tmp_path / "cube.fits", fits.PrimaryHDU(np.array(planes)))
        files = [
            save(tmp_path / f"{j}.fits", fits.PrimaryHDU(plane)) for j, plane in enumerate(planes)
        ]
        np.testing.assert_array_equal(fitsread.read_stack([cube]).data, np.array(planes))
        np.testing.assert_array_equal(fitsread.read_stack(files).data, np.array(planes))

    def test_a_compressed_file_is_read(self, tmp_path):
        image = np.random.default_rng(1).normal(size=(200, 150))  # more than a buffer holds
        plain = save(tmp_path / "a.fits", fits.PrimaryHDU(), fits.ImageHDU(image), checksum=True)
        packed = tmp_path / "a.fits.gz"
        packed.write_bytes(gzip.compress((tmp_path / "a.fits").read_bytes()))
        np.testing.assert_array_equal(
            fitsread.read_stack([str(packed)]).data, fitsread.read_stack([plain]).data
        )

    def test_checksums_are_those_of_the_files(self, tmp_path):
        paths = [save(tmp_path / name, fits.PrimaryHDU(IMAGE)) for name in ("a.fits", "b.fits")]
        with open(paths[1], "ab") as stream:
            stream.write(bytes(2880))
        expected = [
            hashlib.sha256((tmp_path / name).read_bytes()).hexdigest()
            for name in ("a.fits", "b.fits")
        ]
        assert fitsread.read_stack(paths).sha256 == expected
        assert expected[0] != expected[1]

    def test_a_failed_datasum_is_announced(self, tmp_path):
        path = tmp_path / "a.fits"
        save(path, fits.PrimaryHDU(IMAGE), checksum=True)
        fitsread.read_stack([str(path)])
        damaged = bytearray(path.read_bytes())
        damaged[2880 + 8 * 3 + 2] ^= 1
        path.write_bytes(damaged)
        with pytest.warns(LnoclWarning, match="a.fits: the data do not match their DATASUM"):
            fitsread.read_stack([str(path)])

    def test_missing_padding_is_announced(self, tmp_path):
        path = tmp_path / "a.fits"
        save(path, fits.PrimaryHDU(IMAGE))
        path.write_bytes(path.read_bytes()[: 2880 + IMAGE.nbytes])
        with pytest.warns(LnoclWarning, match="truncated"):
            data = fitsread.read_stack([str(path)]).data
        np.testing.assert_array_equal(data, IMAGE[None])


def no_image(path):
    save(path, fits.PrimaryHDU(), table())


def text(path):
    path.write_text("no FITS at all\n" * 400)


def truncated(path):
    save(path, fits.PrimaryHDU(IMAGE))
    path.write_bytes(path.read_bytes()[: 2880 + IMAGE.nbytes - 1])


def truncated_header(path):
    save(path, fits.PrimaryHDU(IMAGE))
    path.write_bytes(path.read_bytes()[:2000])


def truncated_gzip(path):
    save(path, fits.PrimaryHDU(np.random.default_rng(1).normal(size=(60, 60))))
    packed = gzip.compress(path.read_bytes())
    path.write_bytes(packed[: len(packed) // 2])


def random_groups(path):
    header = fits.Header(
        {
            "SIMPLE": True,
            "BITPIX": -32,
            "NAXIS": 3,
            "NAXIS1": 0,
            "NAXIS2": 3,
            "NAXIS3": 3,
            "GROUPS": True,
            "PCOUNT": 1,
            "GCOUNT": 2,
        }
    )
    path.write_bytes(header.tostring().encode() + bytes(2880))


def circle(path):
    """Write a file whose second header has a size that leads back to the first."""
    save(path, fits.PrimaryHDU(), table(), table())
    content = path.read_bytes()
    at = content.rindex(b"PCOUNT  =                    0")
    size = (content.rindex(b"XTENSION") + 2880) + 3 * 8
    card = b"PCOUNT  = " + f"{-size:20d}".encode()
    path.write_bytes(content[:at] + card + content[at + len(card) :])


class TestRefusedFiles:
    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (lambda path: None, "cannot be opened: No such file"),
            (lambda path: path.mkdir(), "cannot be opened: Is a directory"),
            (lambda path: path.touch(), "is not a FITS file, or is damaged: it ends too early"),
            (text, "is not a FITS file"),
            (truncated, f"is truncated: it should have {2880 + 960} bytes and has {2880 + 959}"),
            (truncated_header, "is not a FITS file, or is damaged"),
            (truncated_gzip, "is not a FITS file, or is damaged"),
            (no_image, "holds no image"),
            (random_groups, "holds no image"),
            (circle, "the size of an extension is negative"),
        ],
    )
    def test_unusable_file(self, tmp_path, make, message):
        path = tmp_path / "a.fits"
        make(path)
        with pytest.raises(FileError) as caught:
            fitsread.read_stack([str(path)])
        assert str(caught.value).startswith(f"{path} ")
        assert message in str(caught.value)

    @pytest.mark.parametrize(
        ("kind", "n", "is_read"),
        [
            *((kind, 2, False) for kind in ("WAVE", "FREQ-LSR", "stokes", "RGB", "VELO", "ENERGY")),
            *((kind, 2, True) for kind in ("TIME", "", "EXPOSURE")),
            *((kind, 1, True) for kind in ("FREQ", "STOKES")),
        ],
    )
    def test_cubes_of_exposures_are_read_and_of_colours_refused(self, tmp_path, kind, n, is_read):
        hdu = fits.PrimaryHDU(np.array([IMAGE] * n))
        hdu.header["CTYPE3"] = kind
        path = save(tmp_path / "a.fits", hdu)
        if is_read:
            assert len(fitsread.read_stack([path]).data) == n
            return
        with pytest.raises(InputError) as caught:
            fitsread.read_stack([path])
        assert str(caught.value) == (
            f"{path} is a cube along {kind.upper()}, whose planes are not images of one sky; give "
            "one plane, in a file of its own, or components each for a sky of each. If they are "
            "images of one sky, take CTYPE3 out of its header"
        )
        assert len(fitsread.read_stack([path], of_one_sky=False).data) == n

    def test_a_cube_among_several_files(self, tmp_path):
        image = save(tmp_path / "a.fits", fits.PrimaryHDU(IMAGE))
        cube = save(tmp_path / "b.fits", fits.PrimaryHDU(np.array([IMAGE, IMAGE])))
        with pytest.raises(InputError, match=r"b.fits holds 2 images, such as integrations; each"):
            fitsread.read_stack([image, cube])
        one = save(tmp_path / "c.fits", fits.PrimaryHDU(np.array([IMAGE])))
        assert fitsread.read_stack([image, one]).data.shape == (2, *IMAGE.shape)


class TestCoordinates:
    @pytest.mark.parametrize("cards", [LINEAR, SIP, TPV], ids=["linear", "sip", "tpv"])
    @pytest.mark.parametrize("shape", [(10, 12), (2, 10, 12)], ids=["image", "cube"])
    def test_a_result_lies_where_the_image_lies(self, tmp_path, cards, shape):
        header = fits.Header(cards | PHYSICAL)
        if len(shape) == 3:
            header.update(CTYPE3="TIME", CRVAL3=1.0, CD3_3=60.0)
        source = save(tmp_path / "a.fits", fits.PrimaryHDU(np.ones(shape), header))
        stack = fitsread.read_stack([source])
        output = str(tmp_path / "out.fits")
        fitswrite.write_result(output, IMAGE, [], [], wcs=fitsread.wcs_cards(stack.header))
        pixels = np.array([[0.0, 0.0], [11.0, 3.0], [-20.0, 50.5]])
        for key in (" ", "P"):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                before = WCS(stack.header, key=key, naxis=2)
            after = WCS(fits.getheader(output), key=key)  # pytest lets no warning pass
            assert list(after.wcs.ctype) == list(before.wcs.ctype)
            np.testing.assert_allclose(
                after.all_pix2world(pixels, 0), before.all_pix2world(pixels, 0), rtol=1e-13
            )
        assert "CTYPE3" not in fits.getheader(output)

    def test_deprecated_cards_are_written_mended(self):
        cards = fitsread.wcs_cards(fits.Header(LINEAR | {"RADECSYS": "FK5", "EQUINOX": 2000.0}))
        assert cards["RADESYS"] == "FK5"
        WCS(cards)

    def test_sip_coefficients_without_the_ctype_suffix_are_copied_silently(self, capfd):
        cards = fitsread.wcs_cards(fits.Header(SIP | {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN"}))
        assert capfd.readouterr() == ("", "")
        assert cards["A_2_0"] == SIP["A_2_0"]
        assert cards["CTYPE1"] == "RA---TAN-SIP"

    @pytest.mark.parametrize(
        "broken",
        [
            {"CTYPE1": "DEC--TAN"},
            {"CD1_1": 0.0, "CD1_2": 0.0},
            {"CTYPE1": "WAVE-TAB", "CTYPE2": "STOKES", "PS1_0": "coordinates"},
        ],
        ids=["axes", "singular", "tab"],
    )
    def test_unusable_wcs_is_left_out_with_a_warning(self, broken):
        with pytest.warns(LnoclWarning, match="of the first image cannot be copied"):
            cards = fitsread.wcs_cards(fits.Header(LINEAR | broken))
        assert len(cards) == 0

    @pytest.mark.parametrize("shape", [(64, 3), (9, 1), (3, 64)])
    def test_a_narrow_image_is_one(self, shape, tmp_path):
        fits.writeto(tmp_path / "a.fits", np.ones(shape))
        assert fitsread.read_stack([str(tmp_path / "a.fits")]).data.shape == (1, *shape)

    def test_lookup_table_distortions_are_left_out_and_reported(self, caplog):
        tabled = {"CPDIS1": "Lookup", "DP1.EXTVER": 1.0, "D2IMDIS2": "LOOKUP", "D2IMERR2": 0.06}
        with caplog.at_level("INFO", "lnocl"):
            cards = fitsread.wcs_cards(fits.Header(LINEAR | tabled))
        assert "distortions in tables" in caplog.text
        assert repr(cards) == repr(fitsread.wcs_cards(fits.Header(LINEAR)))

    def test_a_broken_system_leaves_the_others(self):
        with pytest.warns(LnoclWarning, match=r"\(WCS\) of the first image") as caught:
            cards = fitsread.wcs_cards(fits.Header(LINEAR | {"CTYPE1": "DEC--TAN"} | PHYSICAL))
        assert len(caught) == 1
        assert "CTYPE1" not in cards
        assert cards["CTYPE1P"] == "x"


def test_a_fault_of_lnocl_is_no_damage_of_a_file(tmp_path, monkeypatch):
    path = save(tmp_path / "a.fits", fits.PrimaryHDU(IMAGE))
    monkeypatch.delattr(fitsread, "choose")
    with pytest.raises(NameError, match="choose"):
        fitsread.read_stack([path])
