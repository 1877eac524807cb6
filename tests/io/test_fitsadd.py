"""HDUs that are added to the file of a result: by many at once, and to odd files."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from lnocl.errors import FileError
from lnocl.io.fitsadd import add_parts
from lnocl.io.fitswrite import write_result
from lnocl.io.packed import BLOCK
from lnocl.io.parts import PARTS, Part
from lnocl.io.saved_results import read_result

SKY = np.random.default_rng(2).exponential(3.0, (9, 14))


@pytest.fixture
def path(tmp_path):
    """Return the file of a result with two stars."""
    write_result(str(tmp_path / "out.fits"), SKY, [(3.0, 4.5), (11.0, 2.0)], [17.25, 5.0])
    return tmp_path / "out.fits"


def image(fill):
    return np.full((2, 3), fill)


def test_threads_that_add_at_once_lose_nothing(path, monkeypatch):
    for k in range(16):
        monkeypatch.setitem(PARTS, f"E{k}", Part(pixels="f8"))
    saved = read_result(str(path))
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda k: add_parts(saved, {f"E{k}": image(k)}), range(16)))
    with fits.open(path, checksum=True) as hdus:
        assert sorted(hdu.name for hdu in hdus[2:]) == sorted(f"E{k}" for k in range(16))
        for k in range(16):
            assert (hdus[f"E{k}"].data == k).all()
    assert [each.name for each in path.parent.iterdir()] == ["out.fits"]


@pytest.mark.system
def test_processes_that_add_at_once_lose_nothing(path):
    program = (
        "import sys\nimport numpy as np\n"
        "from lnocl.io.fitsadd import add_parts\nfrom lnocl.io.saved_results import read_result\n"
        "from lnocl.io.parts import PARTS, Part\n"
        "saved = read_result(sys.argv[1])\nprint(flush=True)\nsys.stdin.readline()\n"
        "for k in range(8):\n"
        "    name = f'E{sys.argv[2]}_{k}'\n"
        "    PARTS[name] = Part(pixels='f8')\n"
        "    add_parts(saved, {name: np.ones(k + 1)})\n"
    )
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", program, path, str(k)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for k in range(5)
    ]
    for process in processes:
        process.stdout.readline()
    for process in processes:  # all begin at once
        process.stdin.write("\n")
        process.stdin.flush()
    for process in processes:
        process.communicate()
        assert process.returncode == 0
    with fits.open(path, checksum=True) as hdus:
        assert len({hdu.name for hdu in hdus}) == len(hdus) == 2 + 40
    assert [each.name for each in path.parent.iterdir()] == ["out.fits"]


def test_nothing_is_added_to_another_result(path):
    saved = read_result(str(path))
    write_result(str(path), SKY + 1e-9, [(3.0, 4.5), (11.0, 2.0)], [17.25, 5.0], overwrite=True)
    content = path.read_bytes()
    with pytest.raises(FileError, match=r"out\.fits holds another result than when it was read"):
        add_parts(saved, {"BIAS": image(1.0)})
    assert path.read_bytes() == content


def test_the_same_name_is_replaced_and_all_else_is_copied_byte_by_byte(path):
    saved, before = read_result(str(path)), path.read_bytes()
    add_parts(saved, {"BIAS": image(1.0), "SHARE": image(2.0)}, unit="adu")
    add_parts(saved, {"BIAS": image(3.0)})
    assert path.read_bytes().startswith(before)
    with fits.open(path, checksum=True) as hdus:
        assert [hdu.name for hdu in hdus[2:]] == ["SHARE", "BIAS"]
        assert (hdus["BIAS"].data == 3.0).all()


def test_a_file_without_its_last_padding_gets_it(path):
    saved, whole = read_result(str(path)), path.read_bytes()
    with fits.open(path) as hdus:
        where, size = hdus[-1].fileinfo(), hdus[-1].size
    path.write_bytes(whole[: where["datLoc"] + size])
    assert path.stat().st_size < len(whole)
    add_parts(saved, {"BIAS": image(1.0)})
    assert path.read_bytes().startswith(whole)
    with fits.open(path, checksum=True) as hdus:
        assert (hdus["BIAS"].data == 1.0).all()


ODD = [b"EXPTIME = 1.2.3", b"object  = 'M 31'", b"A.B     = 3", b"=HST    = 5", b"OBSERVER= 'O",
       b"FOCUS   =     T3", b"HIERARCH  = 4", b"\xe9t\xe9     = 'x'"]  # fmt: skip


@pytest.mark.parametrize("card", ODD, ids=[str(each) for each in ODD])
@pytest.mark.filterwarnings("ignore")
def test_cards_that_are_not_standard_are_copied(path, card):
    content = bytearray(path.read_bytes())
    at = content.index(b"END ")
    content[at : at + 160] = card.ljust(80) + b"END".ljust(80)
    assert at + 160 < BLOCK
    path.write_bytes(content)
    saved = read_result(str(path))
    add_parts(saved, {"BIAS": image(1.0)}, unit="adu")
    assert path.read_bytes().startswith(content)
    np.testing.assert_array_equal(read_result(str(path)).extended, SKY)


def test_a_link_to_a_result_stays_one(path):
    link = Path(path.parent / "link.fits")
    link.symlink_to(path)
    add_parts(read_result(str(link)), {"BIAS": image(1.0)})
    assert link.is_symlink()
    assert fits.getdata(path, "BIAS").shape == (2, 3)
