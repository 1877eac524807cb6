"""Hostile files: no claim of theirs costs time or memory, and lnocl's own errors refuse them."""

import bz2
import gzip
import io
import lzma
import os
import re
import time
import tracemalloc
from collections import namedtuple

import numpy as np
import pytest
from astropy.io import fits
from sound_files import (
    COUNTS,
    draw,
    image,
    read_checkpoint,
    read_observation,
    read_saved,
    read_scene,
    read_stars,
    votable,
)
from wcs_headers import SIP

from lnocl.errors import FileError, InputError, LnoclWarning
from lnocl.io import fitsread, fitswrite, packed, saved_results, sky, star_files
from lnocl.process import ignored_warnings

BLOCK = 2880
BIG = 10**12
CLAIMS = {
    "a million million pixels": {"NAXIS1": 10**6, "NAXIS2": 10**6},
    "a long row": {"NAXIS1": BIG},
    "a negative side": {"NAXIS1": -34},
    "two negative sides": {"NAXIS1": -34, "NAXIS2": -32},
    "999 axes": {"NAXIS": 999},
    "too many axes": {"NAXIS": BIG},
    "pixels of no size": {"BITPIX": 0},
    "large pixels": {"BITPIX": -BIG},
    "a long heap": {"PCOUNT": BIG},
    "many groups": {"GCOUNT": BIG},
    "a word": {"NAXIS1": "many"},
}


def hostile(claims):
    header = fits.PrimaryHDU(COUNTS.astype("i2")).header
    header.update(claims)
    return header.tostring().encode() + bytes(BLOCK)


@pytest.mark.usefixtures("limits")
@pytest.mark.parametrize("compress", [bytes, gzip.compress])
@pytest.mark.parametrize("use", [read_observation, read_scene, read_saved])
@pytest.mark.parametrize("claims", CLAIMS.values(), ids=CLAIMS)
def test_false_image_sizes_in_headers_are_refused_at_once(sound, tmp_path, use, claims, compress):
    path = tmp_path / "damaged"
    path.write_bytes(compress(hostile(claims)))
    began = time.monotonic()
    tracemalloc.start()
    try:
        with pytest.raises(FileError) as caught:
            use(sound, str(path), "image.dat")
        assert tracemalloc.get_traced_memory()[1] < 2**24
    finally:
        tracemalloc.stop()
    assert str(caught.value).startswith(f"{path} ")
    assert time.monotonic() - began < 2


@pytest.mark.usefixtures("limits")
@pytest.mark.parametrize("compress", [bytes, gzip.compress, bz2.compress, lzma.compress])
@pytest.mark.parametrize("keyword", ["NAXIS1", "BITPIX", "GCOUNT"])
def test_data_of_two_sizes_are_refused(tmp_path, keyword, compress):
    """Astropy would read by the first, and go on by the last, which leads back to the start."""
    header = fits.PrimaryHDU(COUNTS.astype("i2")).header
    header.set("GCOUNT", 1)
    header.append((keyword, -99999999999))
    path = tmp_path / "damaged"
    path.write_bytes(compress(header.tostring().encode() + bytes(BLOCK)))
    with pytest.raises(FileError, match=rf"damaged: {keyword} is both \d+ and -99999999999; del"):
        fitsread.read_stack([str(path)])


def test_a_size_that_is_given_twice_alike_is_read(tmp_path):
    header = fits.PrimaryHDU(COUNTS.astype("i2")).header
    header.append(("NAXIS1", header["NAXIS1"]))
    path = tmp_path / "a.fits"
    path.write_bytes(header.tostring().encode() + bytes(BLOCK))
    assert fitsread.read_stack([str(path)]).data.shape[1:] == COUNTS.shape


@pytest.mark.usefixtures("limits")
def test_an_image_larger_than_the_memory_is_not_read(sound, tmp_path):
    path = tmp_path / "damaged"
    path.write_bytes(hostile({"NAXIS1": 10**6, "NAXIS2": 10**6}))
    os.truncate(path, 2 * BIG + 2 * BLOCK)  # a file with a hole takes no room
    with pytest.raises(FileError, match=r"shape \(1000000, 1000000\), 7.45e\+03 GiB; this mach"):
        read_saved(sound, str(path), "image.dat")


@pytest.mark.usefixtures("limits")
@pytest.mark.parametrize("keyword", ["TFIELDS", "NAXIS2", "PCOUNT", "NAXIS"])
@pytest.mark.parametrize("name", ["star_table.dat", "result.dat"])
def test_false_table_sizes_in_headers_are_refused(sound, tmp_path, keyword, name):
    content = bytearray(sound[name].read_bytes())
    at = content.index(f"{keyword:8}= ".encode(), content.index(b"XTENSION= 'BINTABLE'"))
    content[at + 10 : at + 30] = f"{BIG:20}".encode()
    path = tmp_path / "damaged"
    path.write_bytes(content)
    with pytest.raises(FileError, match=rf"{path} is (damaged: {keyword} is|truncated)"):
        (read_stars if name.startswith("star") else read_saved)(sound, str(path), name)


def rows_in_fits():
    columns = [fits.Column(name, "B", array=np.zeros(10**6 + 1)) for name in "xy"]
    content = io.BytesIO()
    fits.BinTableHDU.from_columns(columns).writeto(content)
    return content.getvalue()


@pytest.mark.usefixtures("limits")
@pytest.mark.parametrize("make", [
    lambda: b"x,y\n" + b"1,2\n" * 10**6, lambda: b"x,y\r" + b"1,2\r" * 10**6, rows_in_fits,
    lambda: b"x,y\n1,2" + b" " * 2**23,
], ids=["lines", "of old Macs", "FITS", "one line"])  # fmt: skip
def test_a_table_of_stars_does_not_unpack_without_end(tmp_path, monkeypatch, make):
    monkeypatch.setattr(star_files, "MAX_MEBIBYTES", 8)
    path = tmp_path / "stars.csv.gz"
    path.write_bytes(gzip.compress(make(), 1))
    with pytest.raises(FileError) as caught:
        star_files.read_stars(str(path), fits.Header(SIP), "a.fits")
    assert str(caught.value) == (
        f"{path} is too large for a table of stars: at most 1000000 rows and, but for FITS, 8 "
        "MiB are read; cut it to the stars of the image"
    )


NO_BYTES = {
    "rows of no bytes": {"NAXIS1": 0},
    "a heap that takes them back": {"NAXIS1": 1, "PCOUNT": -(10**8)},
    "no groups": {"NAXIS1": 1, "GCOUNT": 0},
}


@pytest.mark.usefixtures("limits")
@pytest.mark.parametrize("compress", [bytes, gzip.compress])
@pytest.mark.parametrize("use", [read_stars, read_saved, read_checkpoint])
@pytest.mark.parametrize("claims", NO_BYTES.values(), ids=NO_BYTES)
def test_rows_that_take_no_room_are_not_read(sound, tmp_path, use, claims, compress):
    columns = [fits.Column(name, "0A") for name in ("x", "y", "flux", "name", "value")]
    name = "RUN" if use is read_checkpoint else "STARS"
    with ignored_warnings():  # older versions of astropy warn of the test's empty columns
        table = fits.BinTableHDU.from_columns(columns, name=name).header
    table.update({"NAXIS2": 10**8} | claims)
    primary = fits.PrimaryHDU(header=fits.Header({"ENDED": "", "DIGEST": ""})).header
    path = tmp_path / "damaged"
    path.write_bytes(compress((primary.tostring() + table.tostring()).encode()))
    began = time.monotonic()
    with pytest.raises(FileError) as caught:
        use(sound, str(path), "star_table.dat")
    assert str(caught.value) == f"{path} is damaged: it has 100000000 rows in 5760 bytes"
    assert time.monotonic() - began < 2


@pytest.mark.usefixtures("limits")
@pytest.mark.parametrize("use", [read_observation, read_stars, read_saved, read_checkpoint])
@pytest.mark.parametrize("path", ["/dev/zero", "pipe"])
def test_device_files_and_pipes_are_refused(sound, tmp_path, monkeypatch, use, path):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    with pytest.raises(FileError) as caught:
        use(sound, path, "image.dat")
    how = "read as a table" if use is read_stars else "opened"
    why = "it is not a regular file; save its content to one first"
    assert str(caught.value) == f"{path} cannot be {how}: {why}"


@pytest.mark.usefixtures("limits")
@pytest.mark.parametrize("keyword", ["A_ORDER", "BP_ORDER", "WCSAXES"])
def test_wcs_with_excessive_orders_or_axes_is_left_out_with_a_warning(keyword):
    header = fits.Header(SIP | {keyword: 10**5})
    began = time.monotonic()
    with pytest.warns(
        LnoclWarning, match=f"cannot be copied and are left out: {keyword} is 100000"
    ):
        assert len(fitsread.wcs_cards(header)) == 0
    assert not sky.has_celestial(header)
    assert time.monotonic() - began < 2


def test_unreadable_card_is_left_out_with_a_warning(tmp_path):
    content = bytearray()
    image(str(tmp_path / "a.fits"))
    content += (tmp_path / "a.fits").read_bytes()
    at = content.index(b"EXPTIME =")
    content[at + 10 : at + 30] = b"1.2.3".rjust(20)
    (tmp_path / "a.fits").write_bytes(content)
    with pytest.warns(LnoclWarning, match=r"a\.fits: a card .* left out: .*\(EXPTIME\)"):
        stack = fitsread.read_stack([str(tmp_path / "a.fits")])
    assert "EXPTIME" not in stack.header
    assert stack.header["BUNIT"] == "electron"


def test_no_table_has_another_file_read(tmp_path, monkeypatch):
    def fetch(address):
        raise AssertionError(address)

    monkeypatch.setattr("urllib.request.urlopen", fetch)
    path = tmp_path / "stars.vot"
    votable(str(path))
    text = path.read_text()
    start, end = text.index("<STREAM"), text.index("</STREAM>")
    path.write_text(f"{text[:start]}<STREAM href='file:///etc/passwd'>{text[end:]}")
    with pytest.raises(FileError, match=r"has its rows elsewhere, at file:///etc/passwd; give"):
        star_files.read_stars(str(path), fits.Header(), "a.fits")


def test_damage_to_a_compressed_file_beyond_the_image_is_seen(sound, tmp_path):
    content = bytearray(sound["telescope.gz"].read_bytes())
    content[-8] ^= 1  # the checksum of it all
    path = tmp_path / "a.fits.gz"
    path.write_bytes(content)
    with pytest.raises(FileError, match="CRC check failed"):
        fitsread.read_stack([str(path)])


COMPRESS = [gzip.compress, bz2.compress, lzma.compress]


@pytest.mark.usefixtures("limits")
@pytest.mark.parametrize("compress", COMPRESS)
def test_a_compressed_file_is_unpacked_as_far_as_its_headers_say(
    sound, tmp_path, monkeypatch, compress
):
    """Gigabytes may follow its zeros; that these are not read, their damaged end shows."""
    monkeypatch.setattr(packed, "PART", 2**14)
    rest = bytes(BLOCK) + np.random.default_rng(0).bytes(3 * 2**19)
    path = tmp_path / "a.fits.packed"
    whole = sound["image.dat"].read_bytes()
    path.write_bytes(compress(whole + rest)[:-24] + bytes(24))
    with pytest.raises((EOFError, OSError, lzma.LZMAError)):
        {gzip.compress: gzip, bz2.compress: bz2, lzma.compress: lzma}[compress].open(path).read()
    found, expected = (fitsread.read_stack([str(p)]) for p in (path, sound["image.dat"]))
    np.testing.assert_array_equal(found.data, expected.data)


@pytest.mark.usefixtures("limits")
@pytest.mark.parametrize("compress", [bytes, gzip.compress])
@pytest.mark.parametrize("filling", [b" ", b"COMMENT a".ljust(80)], ids=["blanks", "comments"])
def test_a_header_without_an_end_is_not_read_for_ever(
    sound, tmp_path, monkeypatch, compress, filling
):
    monkeypatch.setattr(packed, "MAX_HEADER", 2**20)
    path = tmp_path / "damaged"
    start = hostile({})[:BLOCK].replace(b"END ", b"    ")
    path.write_bytes(compress(start + filling * (2**22 // len(filling))))
    tracemalloc.start()
    try:
        with pytest.raises(FileError, match="a header does not end within 1 MiB"):
            read_observation(sound, str(path), "image.dat")
        assert tracemalloc.get_traced_memory()[1] < 2**23
    finally:
        tracemalloc.stop()


@pytest.mark.exhaustive
@pytest.mark.parametrize("compress", COMPRESS)
def test_compressed_multi_extension_file_leaves_no_temporary_files(tmp_path, monkeypatch, compress):
    monkeypatch.setattr(packed, "IN_MEMORY", 2**16)  # and so is on the disk
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    images = np.random.default_rng(5).normal(50.0, 5.0, (6, 90, 110))
    made = fits.HDUList([fits.PrimaryHDU()])
    for k, each in enumerate(images):
        made.append(fits.ImageHDU(each, name="SCI", ver=k + 1))
        made.append(fits.BinTableHDU.from_columns([fits.Column("a", "D", array=np.ones(k))]))
    content = io.BytesIO()
    made.writeto(content, checksum=True)
    path = tmp_path / "a.fits.packed"
    path.write_bytes(compress(content.getvalue()))
    for k, each in enumerate(images):
        np.testing.assert_array_equal(
            fitsread.read_single(f"{path}[SCI,{k + 1}]").data[0], each.astype(float)
        )
    assert list((tmp_path / "temporary").iterdir()) == []


def test_compressed_file_too_large_for_the_disk_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(packed, "IN_MEMORY", 2**10)
    usage = namedtuple("usage", "free")(2**11)
    monkeypatch.setattr("shutil.disk_usage", lambda folder: usage)
    path = tmp_path / "a.fits.gz"
    image(str(path))
    with pytest.raises(FileError, match="has no room: name another folder by TMPDIR, or unpack it"):
        fitsread.read_stack([str(path)])


def test_errors_of_ours_are_not_taken_for_the_file_s(sound, monkeypatch):
    def fail(*given, **options):
        raise ZeroDivisionError

    monkeypatch.setattr(fitsread, "_check_shape", fail)
    with pytest.raises(ZeroDivisionError):
        fitsread.read_stack([str(sound["image.dat"])])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"NITER": "many"}, "NITER of {} is 'many', not a finite number"),
        ({"OF": "truth", "NITER": "many"}, "NITER of {} is 'many', not a finite number"),
    ],
)
def test_non_numeric_header_values_are_refused(sound, tmp_path, quick_figures, changes, message):
    path = tmp_path / "damaged"
    name = f"{changes.get('OF', 'result')}.dat"
    path.write_bytes(sound[name].read_bytes())
    with fits.open(path, mode="update") as hdus:
        hdus[0].header.update(changes)
    with pytest.raises(InputError, match=re.escape(message.format(path))):
        draw(sound, str(path), name)


@pytest.mark.parametrize("position", [(1e300, 3.0), (3.0, np.nan), (-4.0, 3.0), (3.0, 35.0)])
def test_a_star_outside_its_image_is_not_drawn(sound, tmp_path, quick_figures, position):
    path = tmp_path / "damaged"
    fitswrite.write_result(str(path), COUNTS, [position], [1e5])
    with pytest.raises(InputError, match=rf"{path} has a star at \(.*\), outside its image"):
        draw(sound, str(path), "result.dat")


def test_a_table_that_does_not_match_its_datasum_is_announced(sound, tmp_path):
    content = bytearray(sound["truth.dat"].read_bytes())
    start = content.index(b"XTENSION= 'BINTABLE'")
    content[content.index(b"END ", start) // BLOCK * BLOCK + BLOCK + 7] ^= 1
    path = tmp_path / "damaged"
    path.write_bytes(content)
    with pytest.warns(LnoclWarning, match="the data do not match their DATASUM"):
        saved_results.read_result(str(path))


def test_a_column_with_several_numbers_in_a_row(tmp_path):
    columns = [fits.Column(name, "2D", array=np.ones((1, 2))) for name in ("x", "y", "flux")]
    path = tmp_path / "a.fits"
    table = fits.BinTableHDU.from_columns(columns, name="STARS")
    fits.HDUList([fits.PrimaryHDU(COUNTS), table]).writeto(path)
    with pytest.raises(FileError, match=r"several numbers in a row of column x of STARS"):
        saved_results.read_result(str(path))
