"""The arguments of subcommands, each written once; the parser and the record follow from it."""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from lnocl.errors import InputError, note
from lnocl.io.calibration import EACH
from lnocl.io.names import ERR, parse_kind
from lnocl.parallel import CURRENT

if TYPE_CHECKING:
    from astropy.io import fits

# The values for which a switch is on the command line.
SWITCHES = {"store_true": True, "store_false": False}
# The action of a switch that is turned on by its flag, and off by the same with no- before it.
EITHER = argparse.BooleanOptionalAction
# A star of a table that is so near to one given by its place is that, pixels.
SAME_STAR = 1.5
# The keywords of an option that takes several values and may be repeated.
SEVERAL: dict[str, Any] = {"nargs": "+", "action": "extend"}


@dataclasses.dataclass(frozen=True)
class Option:
    """An argument of a subcommand, named as the parameter of the function that takes it.

    Attributes
    ----------
    flags : tuple of str
        Spellings on the command line, shortest first; of a positional argument its name.
    keywords : mapping
        Further keyword arguments of `argparse.ArgumentParser.add_argument`.
    card : tuple of two str, optional
        Keyword and comment of its header card; values of a list are numbered from 1.
    checksum : str
        Keyword of the cards with the checksums of its files.
    is_input : bool
        Whether a text that it is given may be the name of a file to read, as with a checksum.
    kinds : mapping of str to str
        The kinds of its values, ``KIND=FILE``, with the parameter that each stands for.
    is_repeated : bool
        Whether the command that repeats a run has it.
    needs : tuple of str
        Names of options without all of which it would be ignored.
    """

    flags: tuple[str, ...]
    keywords: Mapping[str, Any]
    card: tuple[str, str] | None = None
    checksum: str = ""
    is_input: bool = False
    is_repeated: bool = True
    kinds: Mapping[str, str] = dataclasses.field(default_factory=dict)
    needs: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Its name in the namespace of the parsed arguments."""
        return self.keywords.get("dest") or self.flags[-1].lstrip("-").replace("-", "_")

    @property
    def default(self) -> Any:
        """Its value where it is not given."""
        switch = SWITCHES.get(self.keywords.get("action", ""))
        return self.keywords.get("default", None if switch is None else not switch)

    @property
    def is_positional(self) -> bool:
        """Whether it is given by its place, without a flag."""
        return not self.flags[0].startswith("-")

    @property
    def is_needed(self) -> bool:
        """Whether the usage names it: one of several options is hard to find there."""
        return self.is_positional or bool(self.keywords.get("required"))

    def refuse_ignored(self, values: Mapping[str, Any]) -> None:
        """Refuse a value where all options that it needs are left out.

        Raises
        ------
        InputError
            It would be ignored.
        """
        value = values[self.name]
        if self.needs and value and value != self.default and not any(map(values.get, self.needs)):
            others = " or ".join(f"`{name}`" for name in self.needs)
            raise InputError(
                f"`{self.name}` does nothing without {others}: give that too, or leave it out"
            )

    def usage(self) -> str:
        """Return the words of the usage for it."""
        metavar = self.keywords["metavar"]
        values = {"+": f"{metavar} [{metavar} ...]", "*": f"[{metavar} ...]"}
        value = values.get(self.keywords.get("nargs", ""), metavar)
        return value if self.is_positional else f"{self.flags[0]} {value}"

    def but(self, *flags: str, **given: Any) -> Option:
        """Return the same option with other flags, attributes, or keywords, such as its help."""
        own, keywords = _apart(given)
        keywords = {**self.keywords, **keywords}
        return dataclasses.replace(self, flags=flags or self.flags, keywords=keywords, **own)

    def words(self, value: Any) -> list[str]:
        """Return the words of a command line that give it a value; None gives no words."""
        flag = [] if self.is_positional else [self.flags[0]]
        action = self.keywords.get("action")
        if action in SWITCHES:
            return flag if value is SWITCHES[action] else []
        if action is EITHER:
            off = [self.flags[0].replace("--", "--no-", 1)]
            return [] if value in (self.default, None) else flag if value else off
        values = _listed(value)
        if action == "append":
            return [word for each in values for word in (*flag, _word(each))]
        return [*flag, *map(_word, values)] if values else []

    def inputs(self, value: Any) -> list[str]:
        """Return the names in a value that may be those of files to read."""
        is_input = self.is_input or bool(self.checksum)
        words = [word for word in _listed(value) if is_input and isinstance(word, str)]
        return [parse_kind(word)[1] for word in words] if self.kinds else words


# The options of a subcommand, by the headings of its help.
Options = Mapping[str, Sequence[Option]]


def option(*flags: str, **given: Any) -> Option:
    """Return an `Option` with the attributes that are given, and other keywords for the parser."""
    own, keywords = _apart(given)
    if kinds := own.get("kinds"):
        keywords = {"type": partial(_of_kind, kinds), "metavar": "KIND=FILE", **keywords}
    return Option(flags, keywords, **own)


def _apart(given: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return which keywords are attributes of an option, and which are for the parser."""
    own = given.keys() & {each.name for each in dataclasses.fields(Option)}
    return {name: given[name] for name in own}, {k: given[k] for k in given.keys() - own}


def _of_kind(kinds: Mapping[str, str], word: str) -> str:
    kind, path = parse_kind(word)
    if kind not in kinds or not (path or word == ERR):
        raise argparse.ArgumentTypeError(f"{word!r} is not KIND=FILE; kinds are {', '.join(kinds)}")
    return word


def placed_file(word: str) -> str:
    """Return a word ``X,Y=FILE``.

    Raises
    ------
    argparse.ArgumentTypeError
        Another text.
    """
    place, path = parse_kind(word)
    pixel(place)
    if not path:
        raise argparse.ArgumentTypeError(f"{word!r} is not X,Y=FILE")
    return word


def mixture(word: str) -> str:
    """Return a word ``NAME=WEIGHT,WEIGHT,...``, or each.

    Raises
    ------
    argparse.ArgumentTypeError
        Another text.
    """
    if word == EACH:
        return word
    name, weights = parse_kind(word)
    if not (name.strip() and all(each.strip() for each in weights.split(","))):
        raise argparse.ArgumentTypeError(
            f"{word!r} is not NAME=WEIGHT,WEIGHT,..., such as line=1,0 for two images, nor each"
        )
    return word


def _listed(value: Any) -> list[Any]:
    if value is None:
        return []
    return value if isinstance(value, list) else [value]


def _word(value: Any) -> str:
    """Return a text that is not taken for an option, a number to the last digit, or ``X,Y``."""
    if isinstance(value, str):
        return f"./{value}" if value.startswith("-") else value
    return ",".join(map(repr, value if isinstance(value, tuple) else (value,)))


def or_word(kind: type[float] | type[int], text: str) -> float | str:
    """Return a number, or a whole one, where a text is one, else the text."""
    try:
        return kind(text)
    except ValueError:
        return text


def finite(text: str) -> float:
    """Return a number that a header can hold.

    Raises
    ------
    argparse.ArgumentTypeError
        A text that is not a finite number.
    """
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"{text!r} is not a finite number")
    return number


def pixel(text: str) -> tuple[float, float]:
    """Return the numbers of ``X,Y``.

    Raises
    ------
    argparse.ArgumentTypeError
        A text that is not two finite numbers.
    """
    try:
        x, y = map(finite, text.split(","))
    except (ValueError, argparse.ArgumentTypeError):
        raise argparse.ArgumentTypeError(f"{text!r} is not X,Y in pixels") from None
    return x, y


def position(text: str) -> tuple[float, float] | str:
    """Return the numbers of ``X,Y``, or a text that is a position on the sky.

    Raises
    ------
    argparse.ArgumentTypeError
        A text that is neither.
    """
    try:
        x, y = map(float, text.split(","))
        return x, y
    except ValueError:
        from lnocl.io.sky import parse_sky  # which takes its time to load

        try:
            parse_sky([text])
        except InputError as error:
            raise argparse.ArgumentTypeError(error.message) from None
        return text


def star_places(
    positions: Sequence[tuple[float, float] | str],
    table: str | None,
    header: fits.Header,
    image: str,
) -> list[tuple[float, float]]:
    """Return the places of stars in pixels, from --star and the table of --stars.

    Parameters
    ----------
    positions : sequence
        As from `position`.
    table : str, optional
        File with a table of stars.
    header : astropy.io.fits.Header
        Header of the image, for positions on the sky.
    image : str
        Its file, for messages.

    Raises
    ------
    FileError, InputError
        As `sky.to_pixels` and `star_files.read_stars`; places on the sky for an image without WCS.
    """
    texts = [each for each in positions if isinstance(each, str)]
    found = iter(())
    if texts:
        from lnocl.io import sky

        wcs = sky.celestial_wcs(header, image)
        found = iter(sky.to_pixels(sky.parse_sky(texts), wcs, image).tolist())
    places = [next(found) if isinstance(each, str) else each for each in positions]
    if table:
        from lnocl.io.star_files import read_stars

        found = read_stars(table, header, image).tolist()
        for place in places:
            away = [math.dist(place, star) for star in found]
            if min(away, default=math.inf) < SAME_STAR:
                x, y = found.pop(int(np.argmin(away)))
                note("%s: its star at (%.7g, %.7g) is one of `stars`, and taken once", table, x, y)
        places += found
    return [(x, y) for x, y in places]


def processes(text: str) -> int | str:
    """Return a number of processes, or the name of what `lnocl.parallel` knows.

    Raises
    ------
    argparse.ArgumentTypeError
        A text that is neither.
    """
    if text == CURRENT:
        return text
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(
            f"{text!r} is neither a number of processes, 1 or more, nor {CURRENT}"
        )
    return int(text)


IMAGES = option(
    "images",
    nargs="+",
    metavar="IMAGE",
    checksum="ISUM",
    help="FITS file with an image, or one file with a cube of them, in the unit of its BUNIT, or "
    "else in electrons; an extension of any FITS file is named as in 'FILE[SCI]', "
    "'FILE[SCI,2]' or 'FILE[1]'",
)
PSFS = option(
    "--psf",
    **SEVERAL,
    dest="psfs",
    metavar="PSF",
    checksum="PSUM",
    help="FITS file with a PSF, centred at (ky // 2, kx // 2): one for all images or one for each, "
    "or one file with a cube of them",
)
STARS = option(
    "--star",
    action="append",
    default=[],
    type=position,
    dest="stars",
    metavar="X,Y",
    help="position of a star: in pixels, 0-based, x along columns; or RA,DEC on the sky (ICRS), "
    "with units or as hours and degrees: 65d,19.5d or 4h20m,19d30m or 4:20:00,19:30:00; may be "
    "repeated",
)
STAR_TABLE = option(
    "--stars",
    metavar="FILE",
    dest="star_table",
    is_input=True,
    help="table of stars in any format of astropy, with columns x and y, or ra and dec, or as "
    "photutils, SExtractor, Gaia and VizieR name them",
)
OVERWRITE = option(
    "--overwrite", action="store_true", is_repeated=False, help="replace files that exist"
)
QUIET = option(
    "--quiet", action="store_true", is_repeated=False, help="show only warnings and errors"
)
VERBOSE = option(
    "--verbose",
    action="store_true",
    is_repeated=False,
    help="show what was measured and chosen too, as it happens",
)
HOW_MUCH_IS_SAID = QUIET, VERBOSE

PICTURE = option("--plot", metavar="FILE.png", is_repeated=False)


def result(use: str) -> Option:
    """Return the argument for the file of a result, to which something is added."""
    words = f"file that lnocl deconvolve has written; {use}"
    return option("result", metavar="RESULT.fits", is_input=True, help=words)


def table_output(content: str, **keywords: Any) -> Option:
    """Return the option for a file with a table."""
    words = f"table of the {content}, in a format by its ending: .ecsv, .csv or .fits"
    return option("-o", "--output", help=words, **keywords)


def parallel(parts: str) -> Option:
    """Return the option for where parts of the work are done."""
    return option(
        "--parallel",
        type=processes,
        default=False,
        metavar="N",
        is_repeated=False,
        help=f"{parts} at once: a number of processes, or current-scheduler, the workers of the "
        "scheduler of Dask that DASK_SCHEDULER_ADDRESS names (default: one after the other)",
    )


def output_folder(content: str, **keywords: Any) -> list[Option]:
    """Return the option for the folder of the output, and that to replace files in it."""
    default = " (default: %(default)s)" if "default" in keywords else ""
    folder = option(
        "-o", "--output", metavar="DIR", help=f"folder for {content}{default}", **keywords
    )
    return [folder, OVERWRITE.but(help="replace files in DIR")]
