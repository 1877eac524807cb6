"""Images that a file holds packed: in compressed tiles, or through an asinh."""

import gzip

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from wcs_headers import TPV

from lnocl.errors import FileError, InputError, LnoclWarning
from lnocl.io import encoded, fitsread

COUNTS = np.random.default_rng(5).poisson(60.0, (21, 34)).astype("i4")
# As in the stacks of Pan-STARRS.
CARDS = {"BSOFTEN": 95.41472414983, "BOFFSET": 2.246295928955}
LINEAR = np.array([[-30.0, 0.0, 2.25], [95.0, 1e3, 5e5]])


def save(path, *hdus, **options):
    primary = fits.PrimaryHDU(header=fits.Header({"TELESCOP": "CTIO", "EXPTIME": 30.0}))
    fits.HDUList([primary, *hdus]).writeto(path, **options)
    return str(path)


def spoil(path, old, new):
    content = path.read_bytes()
    assert content.count(old) == 1
    path.write_bytes(content.replace(old, new))
    return str(path)


class TestTiles:
    @pytest.mark.exhaustive
    @pytest.mark.parametrize(
        ("kind", "tile"), [("RICE_1", (1, 34)), ("GZIP_2", (10, 9)), ("HCOMPRESS_1", (7, 17))]
    )
    def test_the_image_is_the_one_that_was_packed(self, tmp_path, kind, tile):
        tiles = fits.CompImageHDU(COUNTS, compression_type=kind, tile_shape=tile)
        path = save(tmp_path / "a.fits.fz", tiles)
        stack = fitsread.read_stack([path])
        np.testing.assert_array_equal(stack.data, COUNTS[np.newaxis])
        assert fitsread.read_keyword(path, stack.header, "EXPTIME") == 30.0

    @pytest.mark.exhaustive
    def test_of_several_extensions_it_is_the_science_array(self, tmp_path):
        """As DECam, LCO and ZTF pack them; floats are rounded to a share of their noise."""
        image = np.random.default_rng(6).normal(5.0, 1.0, COUNTS.shape).astype("f4")
        image[3, 4] = np.nan
        flags = (COUNTS > 70).astype("i2")
        science = fits.CompImageHDU(image, fits.Header({**TPV, "BUNIT": "adu"}), name="SCI")
        science.quantize_level = 64
        path = save(
            tmp_path / "a.fits.fz",
            science,
            fits.BinTableHDU.from_columns([fits.Column("a", "D", array=np.zeros(3))], name="CAT"),
            fits.CompImageHDU(flags, name="DQ", compression_type="PLIO_1"),
            checksum=True,
        )
        stack = fitsread.read_stack([path])
        assert np.isnan(stack.data[0, 3, 4])
        np.testing.assert_allclose(stack.data[0], image, atol=1.0 / 64.0)
        np.testing.assert_array_equal(fitsread.read_extension(path, "DQ"), flags)
        assert stack.header["BUNIT"] == "adu"
        np.testing.assert_allclose(
            WCS(fitsread.wcs_cards(stack.header)).wcs_pix2world([[7.0, 3.0]], 0),
            WCS(fits.Header(TPV)).wcs_pix2world([[7.0, 3.0]], 0),
        )

    def test_one_of_several_detectors_is_named(self, tmp_path):
        path = save(
            tmp_path / "a.fz",
            fits.CompImageHDU(COUNTS, name="S29"),
            fits.CompImageHDU(2 * COUNTS, name="N4"),
        )
        with pytest.raises(InputError, match=r"HDU 1 \(S29\) .* name the one .*'.*a.fz\[S29\]'"):
            fitsread.read_stack([path])
        np.testing.assert_array_equal(fitsread.read_stack([f"{path}[N4]"]).data[0], 2 * COUNTS)

    def test_damaged_tiles_are_refused(self, tmp_path):
        path = tmp_path / "a.fz"
        save(path, fits.CompImageHDU(COUNTS, compression_type="GZIP_1"))
        content = bytearray(path.read_bytes())
        content[content.index(b"\x1f\x8b", 2880)] = 0
        path.write_bytes(content)
        with pytest.raises(FileError, match=r"a\.fz is damaged: its tiles cannot be unpacked: "):
            fitsread.read_stack([str(path)])

    @pytest.mark.parametrize(
        ("old", "new"),
        [(b"ZTILE1  =                   34", b"ZTILE1  =                    1"),
         (b"ZTILE1  =                   34", b"ZTILE1  =                    0"),
         (b"ZNAXIS2 =                   21", b"ZNAXIS2 =                99999")],
    )  # fmt: skip
    def test_tiles_that_a_header_claims_are_counted(self, tmp_path, old, new):
        path = tmp_path / "a.fz"
        save(path, fits.CompImageHDU(COUNTS, compression_type="RICE_1"))
        with pytest.raises(FileError, match=r"a\.fz is damaged: it has 21 tiles, and its shape"):
            fitsread.read_stack([spoil(path, old, new)])

    def test_tiles_that_do_not_match_their_checksum_are_warned_of(self, tmp_path):
        path = tmp_path / "a.fz"
        save(path, fits.CompImageHDU(COUNTS), checksum=True)
        content = bytearray(path.read_bytes())
        digit = content.rindex(b"DATASUM = '") + len("DATASUM = '")
        content[digit] = ord("1") if content[digit] == ord("2") else ord("2")
        path.write_bytes(gzip.compress(content))
        with pytest.warns(LnoclWarning, match="the data do not match their DATASUM"):
            fitsread.read_stack([str(path)])


class TestAsinh:
    """The stored values are magnitudes."""

    def test_it_is_undone(self, tmp_path, caplog):
        caplog.set_level("INFO", "lnocl")
        softening, offset = CARDS.values()
        x = (LINEAR - offset) / (2.0 * softening)
        stored = 2.5 * np.log10(x + np.sqrt(x**2 + 1.0))
        hdu = fits.CompImageHDU(stored, fits.Header(CARDS), quantize_level=0.0)
        hdu.compression_type = "GZIP_1"
        path = save(tmp_path / "stk.fits", hdu)
        read = fitsread.read_stack([path]).data[0]
        np.testing.assert_allclose(read, LINEAR, rtol=1e-12, atol=1e-12)
        assert "stk.fits: its pixels are stored by an asinh (BSOFTEN), and made lin" in caplog.text

    def test_without_one_of_its_numbers_it_is_refused(self):
        for lost, held in (("BSOFTEN", "BOFFSET"), ("BOFFSET", "BSOFTEN")):
            header = fits.Header({held: 2.0})
            with pytest.raises(InputError, match=f"it has {held} in its header, and no {lost}"):
                encoded.linear("a.fits", LINEAR, header)
            with pytest.raises(InputError, match=r"BSOFTEN of a.fits is 'a', not a finite number"):
                encoded.linear("a.fits", LINEAR, fits.Header({"BSOFTEN": "a", "BOFFSET": 1.0}))
