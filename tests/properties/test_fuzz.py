"""Damaged files: they are read, or refused by lnocl's own errors; nothing else."""

import gzip
import random
import signal
import warnings
from collections import Counter

import pytest
from sound_files import PATIENCE, draw, read_observation, read_saved, read_scene, read_stars

from lnocl.errors import LnoclError, LnoclWarning

BLOCK = 2880

USES = [
    *((read_observation, name) for name in ("image", "telescope", "psfs", "mask")),
    *((read_stars, name) for name in ("star_table", "sky_table", "text_table", "votable")),
    *((read_scene, name) for name in ("image", "telescope", "truth")),
    *((read_saved, name) for name in ("result", "truth")),
]
# Drawing, and a process that unpacks tiles, take a hundred times as long as reading.
SLOW = [(draw, "result"), (draw, "truth"), (read_observation, "tiles"), (read_scene, "tiles")]
SHARE_OF_SLOW = 0.03


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
        use, name = chance.choice(SLOW if chance.random() < SHARE_OF_SLOW else USES)
        name += chance.choice([".dat", ".dat", ".gz"])
        path = folder / "damaged"
        path.write_bytes(damage(chance, sound[name].read_bytes()))
        try:
            outcomes[use.__name__, outcome(use, sound, path, name)] += 1
        except BaseException as error:
            error.add_note(f"seed {seed}: {use.__name__} of {name}")
            raise
    return outcomes


CASES = 150


@pytest.mark.exhaustive
@pytest.mark.usefixtures("limits", "quick_figures")
def test_damaged_files_are_read_or_refused(sound, tmp_path):
    outcomes = fuzz(range(CASES), sound, tmp_path)
    readers = {use.__name__ for use, _ in USES}
    assert min(outcomes[use, how] for use in readers for how in ("read", "refused")) > 3


@pytest.mark.exhaustive
@pytest.mark.usefixtures("limits", "quick_figures")
@pytest.mark.parametrize("part", range(2))
def test_many_damaged_files_are_read_or_refused(sound, tmp_path, part):
    first = CASES + 500 * part
    fuzz(range(first, first + 500), sound, tmp_path)


@pytest.mark.parametrize(
    ("use", "name"), [(use, name + end) for use, name in USES + SLOW for end in (".dat", ".gz")]
)
@pytest.mark.usefixtures("quick_figures")
def test_sound_files_are_read(sound, tmp_path, use, name):
    assert outcome(use, sound, sound[name], name) == "read"
