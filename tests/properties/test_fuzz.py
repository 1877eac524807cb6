"""Damaged and hostile files: they are read, or refused by lnocl's own errors; nothing else."""

import gzip
import os
import random
import re
import resource
import signal
import time
import tracemalloc
import warnings
from collections import Counter

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from scenes import make_psfs
from test_fitsread import PHYSICAL, SIP

from lnocl.errors import FileError, InputError, LnoclError, LnoclWarning
from lnocl.io import fitsread, fitswrite, sky
from lnocl.io.frames import Calibration, read_frames
from lnocl.runs import checkpoint
from lnocl.simulation import load_target
from lnocl.studies import demo

SHAPE = (32, 34)
BLOCK = 2880
# Seconds that one file may take, and memory that all may take together beyond what is there.
PATIENCE = 10
ROOM = 2 * 2**30

RNG = np.random.default_rng(8)
COUNTS = RNG.poisson(100.0, SHAPE)
MAGZERO = ("MAGZERO", 1e9, "electrons of magnitude 0")


def image(path):
    header = fits.Header(SIP | PHYSICAL | {"BUNIT": "electron", "EXPTIME": 30.0})
    fits.PrimaryHDU(COUNTS.astype("i2"), header).writeto(path, checksum=True)


def telescope(path):
    """Write what telescopes leave: an empty primary HDU, image, errors and flags as extensions."""
    header = fits.Header(SIP | {"BUNIT": "electron/s", "BSCALE": 0.5, "BZERO": 3.0, "BLANK": -1})
    primary = fits.PrimaryHDU(header=fits.Header({"EXPTIME": 30.0, "STARX": 5, "STARY": 6}))
    flags = fits.ImageHDU((COUNTS > 120).astype("i2"), name="DQ")
    hdus = [primary, fits.ImageHDU(COUNTS.astype("i4"), header, name="SCI"), flags]
    fits.HDUList(hdus).writeto(path)


def psfs(path):
    fits.writeto(path, make_psfs(2, (8, 10)).astype("f4"))


def mask(path):
    fits.writeto(path, (COUNTS > 130).astype("u1"))


def star_table(path):
    table = Table({"id": ["a", "b"], "x": [3.0, 7.5], "y": [4.0, 9.25], "n": [[1, 2], [3, 4]]})
    table.write(path, format="fits")


def sky_table(path):
    Table({"ra": [248.6211, 248.6212], "dec": [70.531, 70.5311]}).write(path, format="ascii.ecsv")


def text_table(path):
    Table({"x": [3.0, 7.5], "y": [4.0, 9.25]}).write(path, format="ascii.csv")


def votable(path):
    table = Table({"x": [3.0, 7.5], "y": [4.0, 9.25]})
    table.write(path, format="votable", tabledata_format="binary")


def tiles(path):
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(COUNTS.astype("i4"))]).writeto(path)


def truth(path):
    fitswrite.write_result(
        path, COUNTS, [(12.0, 13.0)], [1e5], cards=[MAGZERO, ("PIXSCALE", 2.5, "")]
    )


def result(path):
    curve = np.array(
        [(i, 0.5 / i, 0.4 / i, 12.5) for i in range(1, 9)],
        dtype=[("iteration", int), ("rho", float), ("rho_star", float), ("magnitude", float)],
    )
    history = np.array(
        [(i, 9.0 / (i + 1)) for i in range(9)], dtype=[("iteration", int), ("objective", float)]
    )
    held_out = np.array(
        [(mu, 0.0, i, 1.0 / i) for mu in (0.0, 1e-3) for i in (1, 2, 4)],
        dtype=[("mu", float), ("smoothing", float), ("iteration", int), ("error", float)],
    )
    fitswrite.write_result(
        path, COUNTS, [(12.0, 13.0)], [1e5], history, curve=curve, held_out=held_out,
        cards=[("MU", 0.25, ""), ("PIXSCALE", 2.5, "")],
        cubes={"MODELS": (COUNTS[None], "electron")},
    )  # fmt: skip


MAKERS = [
    image, telescope, psfs, mask, star_table, sky_table, text_table, votable, tiles, truth, result
]  # fmt: skip


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """Return the paths of sound files by name, among them compressed ones."""
    folder = tmp_path_factory.mktemp("sound")
    paths = {}
    for make in MAKERS:
        path = folder / f"{make.__name__}.dat"
        make(str(path))
        packed = folder / f"{make.__name__}.gz"
        packed.write_bytes(gzip.compress(path.read_bytes()))
        paths |= {path.name: path, packed.name: packed}
    return paths


def read_observation(sound, damaged, name):
    """Read a damaged file in the role that it has, all others being sound."""
    files = {key: str(sound[f"{key}.dat"]) for key in ("image", "psfs", "mask")}
    files[name.partition(".")[0]] = damaged
    is_telescope = "telescope" in files
    frames = read_frames(
        [files["telescope"]] * 2 if is_telescope else [files["image"], str(sound["image.dat"])],
        [files["psfs"]],
        Calibration(
            background=[files.get("tiles", "auto")],
            exposure=["EXPTIME"],
            mask=["dq" if is_telescope else files["mask"]],
            align="wcs",
        ),
    )
    fitsread.wcs_cards(frames.images.header)
    if sky.has_celestial(frames.images.header):
        sky.to_sky(np.array([(3.0, 4.0)]), frames.images.header)


def read_stars(sound, damaged, name):
    sky.read_stars(damaged, fits.Header(SIP), "a.fits")


def read_scene(sound, damaged, name):
    load_target(damaged)


def read_saved(sound, damaged, name):
    fitsread.read_result(damaged)


def draw(sound, damaged, name):
    files = {"truth": str(sound["truth.dat"]), "result": str(sound["result.dat"])}
    files[name.partition(".")[0]] = damaged
    # What matplotlib says of damaged numbers; that they are damaged is said by their DATASUM.
    warnings.filterwarnings("ignore", "Data has no positive values")
    list(demo.draw(f"{damaged}.figures", [files["result"]], files["truth"], overwrite=True))


USES = [
    *((read_observation, name) for name in ("image", "telescope", "psfs", "mask", "tiles")),
    *((read_stars, name) for name in ("star_table", "sky_table", "text_table", "votable")),
    *((read_scene, name) for name in ("image", "telescope", "tiles", "truth")),
    *((read_saved, name) for name in ("result", "truth")),
]
# Drawing takes a hundred times as long as reading, and so is done less often.
DRAWS, SHARE_OF_DRAWS = [(draw, name) for name in ("result", "truth")], 0.015


def flip(chance, content):
    for _ in range(chance.choice([1, 3, 10])):
        content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)


def cut(chance, content):
    del content[chance.randrange(len(content)) :]


def drop(chance, content):
    start = chance.randrange(len(content))
    del content[start : start + chance.choice([1, 80, BLOCK])]


def type_over(chance, content):
    """Change characters of the headers, or of a text."""
    for _ in range(chance.choice([1, 3])):
        at = chance.randrange(len(content))
        header = content.find(b"XTENSION", chance.randrange(len(content)))
        at = max(header, 0) + at % BLOCK
        if at < len(content):
            content[at] = ord(chance.choice("0123456789- ='TABCDEJ/.\x00\xff"))


VALUES = (
    "-1", "0", "2", "7", "999", "-2147483648", "4294967296", "1000000000000", "1E999", "1E-999",
    "-1.5", "9" * 60, "T", "''", "'abc'", "", "NaN", "(1.0, 2.0)", "'/etc/passwd'", "1.2.3",
)  # fmt: skip


def claim(chance, content):
    """Give a keyword of a header another value."""
    cards = [
        at
        for at in range(0, len(content) - 80, 80)
        if content[at + 8 : at + 10] == b"= " and content[at : at + 1].isalpha()
    ]
    for _ in range(chance.choice([1, 1, 2]) if cards else 0):
        at = chance.choice(cards)
        content[at + 10 : at + 80] = chance.choice(VALUES).rjust(20).ljust(70).encode()


WAYS = [flip, cut, drop, type_over, claim, claim]


def damage(chance, content):
    """Return a content that was damaged before or after it was compressed, or both."""
    packed = content[:2] == b"\x1f\x8b"
    inner = bytearray(gzip.decompress(content) if packed else content)
    chance.choice(WAYS)(chance, inner)
    if not packed or not inner:
        return bytes(inner)
    outer = bytearray(gzip.compress(inner, 1))
    if chance.random() < 0.3:
        chance.choice([flip, cut])(chance, outer)
    return bytes(outer)


class TooSlowError(BaseException):
    """A file took too long."""


def wake(number, frame):
    raise TooSlowError


@pytest.fixture
def limits():
    """Let no file take long, nor much memory."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    with open("/proc/self/statm") as stream:  # pages
        used = int(stream.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + ROOM, before[1]))
    handler = signal.signal(signal.SIGALRM, wake)
    signal.alarm(PATIENCE)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, handler)
    resource.setrlimit(resource.RLIMIT_AS, before)


def outcome(use, sound, path, name):
    signal.alarm(PATIENCE)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LnoclWarning)
        try:
            use(sound, str(path), name)
        except LnoclError:
            return "refused"
        finally:
            signal.alarm(0)
    return "read"


def fuzz(seeds, sound, folder):
    """Read a damaged file for each seed, and return how often each use had which outcome."""
    outcomes = Counter()
    for seed in seeds:
        chance = random.Random(seed)
        use, name = chance.choice(DRAWS if chance.random() < SHARE_OF_DRAWS else USES)
        name += chance.choice([".dat", ".dat", ".gz"])
        path = folder / "damaged"
        path.write_bytes(damage(chance, sound[name].read_bytes()))
        try:
            outcomes[use.__name__, outcome(use, sound, path, name)] += 1
        except BaseException as error:
            error.add_note(f"seed {seed}: {use.__name__} of {name}")
            raise
    return outcomes


@pytest.fixture
def quick_figures(monkeypatch):
    """Draw, but do not render, which is what takes the time and knows nothing of the files."""
    for module in ("lnocl.plotting.figure", "lnocl.studies.demo"):
        monkeypatch.setattr(f"{module}.save_figure", lambda figure, path, overwrite: None)


CASES = 300


@pytest.mark.usefixtures("limits", "quick_figures")
def test_damaged_files_are_read_or_refused(sound, tmp_path):
    outcomes = fuzz(range(CASES), sound, tmp_path)
    readers = {use.__name__ for use, _ in USES}
    assert min(outcomes[use, how] for use in readers for how in ("read", "refused")) > 5


@pytest.mark.exhaustive
@pytest.mark.usefixtures("limits", "quick_figures")
@pytest.mark.parametrize("part", range(10))
def test_many_damaged_files_are_read_or_refused(sound, tmp_path, part):
    first = CASES + 1000 * part
    fuzz(range(first, first + 1000), sound, tmp_path)


@pytest.mark.parametrize(
    ("use", "name"), [(use, name + end) for use, name in USES + DRAWS for end in (".dat", ".gz")]
)
@pytest.mark.usefixtures("quick_figures")
def test_sound_files_are_read(sound, tmp_path, use, name):
    expected = "refused" if name.startswith("tiles") else "read"
    assert outcome(use, sound, sound[name], name) == expected


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
def test_what_a_header_claims_is_not_believed(sound, tmp_path, use, claims, compress):
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
def test_an_image_larger_than_the_memory_is_not_read(sound, tmp_path):
    path = tmp_path / "damaged"
    path.write_bytes(hostile({"NAXIS1": 10**6, "NAXIS2": 10**6}))
    os.truncate(path, 2 * BIG + 2 * BLOCK)  # a file with a hole takes no room
    with pytest.raises(FileError, match=r"shape \(1000000, 1000000\), 7.45e\+03 GiB; this mach"):
        read_saved(sound, str(path), "image.dat")


@pytest.mark.usefixtures("limits")
@pytest.mark.parametrize("keyword", ["TFIELDS", "NAXIS2", "PCOUNT", "NAXIS"])
@pytest.mark.parametrize("name", ["star_table.dat", "result.dat"])
def test_what_a_table_claims_is_not_believed(sound, tmp_path, keyword, name):
    content = bytearray(sound[name].read_bytes())
    at = content.index(f"{keyword:8}= ".encode(), content.index(b"XTENSION= 'BINTABLE'"))
    content[at + 10 : at + 30] = f"{BIG:20}".encode()
    path = tmp_path / "damaged"
    path.write_bytes(content)
    with pytest.raises(FileError, match=rf"{path} is (damaged: {keyword} is|truncated)"):
        (read_stars if name.startswith("star") else read_saved)(sound, str(path), name)


NO_BYTES = {
    "rows of no bytes": {"NAXIS1": 0},
    "a heap that takes them back": {"NAXIS1": 1, "PCOUNT": -(10**8)},
    "no groups": {"NAXIS1": 1, "GCOUNT": 0},
}


def read_checkpoint(sound, damaged, name):
    checkpoint.read(damaged)


@pytest.mark.usefixtures("limits")
@pytest.mark.parametrize("compress", [bytes, gzip.compress])
@pytest.mark.parametrize("use", [read_stars, read_saved, read_checkpoint])
@pytest.mark.parametrize("claims", NO_BYTES.values(), ids=NO_BYTES)
def test_rows_that_take_no_room_are_not_read(sound, tmp_path, use, claims, compress):
    columns = [fits.Column(name, "0A") for name in ("x", "y", "flux", "name", "value")]
    name = "RUN" if use is read_checkpoint else "STARS"
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
def test_what_may_have_no_end_is_not_read(sound, tmp_path, monkeypatch, use, path):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    with pytest.raises(FileError) as caught:
        use(sound, path, "image.dat")
    how = "read as a table" if use is read_stars else "opened"
    why = "it is no regular file; save what it gives to one first"
    assert str(caught.value) == f"{path} cannot be {how}: {why}"


@pytest.mark.usefixtures("limits")
@pytest.mark.parametrize("keyword", ["A_ORDER", "BP_ORDER", "WCSAXES"])
def test_what_coordinates_claim_is_not_believed(keyword):
    header = fits.Header(SIP | {keyword: 10**5})
    began = time.monotonic()
    with pytest.warns(LnoclWarning, match=f"cannot be kept and are left out: {keyword} is 100000"):
        assert len(fitsread.wcs_cards(header)) == 0
    assert not sky.has_celestial(header)
    assert time.monotonic() - began < 2


def test_a_card_that_cannot_be_read_is_left_out_and_said(tmp_path):
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
        sky.read_stars(str(path), fits.Header(), "a.fits")


def test_damage_to_a_compressed_file_beyond_the_image_is_seen(sound, tmp_path):
    content = bytearray(sound["telescope.gz"].read_bytes())
    content[-8] ^= 1  # the checksum of it all
    path = tmp_path / "a.fits.gz"
    path.write_bytes(content)
    with pytest.raises(FileError, match="CRC check failed"):
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
        ({"MU": "large"}, "MU of {} is 'large', no finite number"),
        ({"PIXSCALE": "wide", "OF": "truth"}, "PIXSCALE of {} is 'wide', no finite number"),
        ({"OF": "truth", "MAGZERO": "bright"}, "MAGZERO of {} is 'bright', no finite number"),
    ],
)
def test_what_should_be_numbers_in_a_header(sound, tmp_path, quick_figures, changes, message):
    path = tmp_path / "damaged"
    name = f"{changes.get('OF', 'result')}.dat"
    path.write_bytes(sound[name].read_bytes())
    with fits.open(path, mode="update") as hdus:
        hdus[0].header.update(changes)
    with pytest.raises(InputError, match=re.escape(message.format(path))):
        draw(sound, str(path), name)


@pytest.mark.parametrize("position", [(1e300, 3.0), (3.0, np.nan), (-1.0, 3.0), (3.0, 32.0)])
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
        fitsread.read_result(str(path))


def test_a_column_with_several_numbers_in_a_row(tmp_path):
    columns = [fits.Column(name, "2D", array=np.ones((1, 2))) for name in ("x", "y", "flux")]
    path = tmp_path / "a.fits"
    table = fits.BinTableHDU.from_columns(columns, name="STARS")
    fits.HDUList([fits.PrimaryHDU(COUNTS), table]).writeto(path)
    with pytest.raises(FileError, match=r"several numbers in a row of column x of STARS"):
        fitsread.read_result(str(path))
