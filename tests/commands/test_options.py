"""The tables of options: parser, messages, cards and the repeated command follow from them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from astropy.io import fits
from commandline import NUMPY, one_complaint, run

from lnocl.commands import cli, deconvolve, messages, options, psf, record
from lnocl.commands.declared import parameter
from lnocl.commands.options import EITHER, option, position
from lnocl.io.calibration import Calibration

pytestmark = pytest.mark.usefixtures("command_folder")

# Options of lnocl deconvolve that no function takes as they are.
OF_THE_SHELL = {"images", "output", "overwrite", "plot", "quiet", "verbose", "residuals",
                "star_table",
                "parallel", "tile"}  # fmt: skip
# Parameters of lnocl.deconvolve that the shell gives itself, or that no option gives.
NOT_OPTIONS = {"observation", "callback", "progress", "initial_extended", "initial_star_fluxes"}


def test_every_option_is_a_parameter_and_every_parameter_an_option():
    names = {each.name for each in deconvolve.ALL_OPTIONS}
    taken = {*deconvolve.PARAMETERS, *Calibration._fields, "psfs"}
    assert names - taken == OF_THE_SHELL
    assert taken - names == NOT_OPTIONS


def test_messages_name_the_flag_that_does_it_and_not_the_one_that_undoes_it():
    flags = deconvolve.COMMAND.flags()
    named = messages.in_shell("give its place, take `refine_positions`, or mend it", flags)
    assert named == "give its place, take --refine, or mend it"
    assert messages.in_shell("give `effective_psfs`=True, and `pad`=8", flags) == (
        "give --effective-psfs, and --pad 8"
    )
    assert messages.in_shell("(`mend_images` False leaves them)", flags) == (
        "(--no-mend-images leaves them)"
    )


def test_messages_name_the_kind_of_file_that_is_a_parameter():
    flags = deconvolve.COMMAND.flags()
    named = messages.in_shell("`psf_modes` has shape (2, 5)", flags)
    assert named == "--psf-errors modes has shape (2, 5)"


@pytest.mark.parametrize("table", [deconvolve.ALL_OPTIONS, psf.OPTIONS])
def test_no_two_options_share_a_keyword_or_a_checksum(table):
    keywords = [each.card[0] for each in table if each.card]
    checksums = [each.checksum for each in table if each.checksum]
    assert len({*keywords, *checksums}) == len(keywords) + len(checksums)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (option("--gain", type=float), ["--gain", "1.7000000000000002"]),
        (option("--size", type=int), ["--size", "21"]),
        (option("--mask", nargs="+", action="extend"), ["--mask", "a.fits", "./-b.fits"]),
        (option("--star", action="append", type=position),
         ["--star", "1.5,-2.0", "--star", "3.0,4.0"]),
        (option("--residuals", action="store_true"), ["--residuals"]),
        (option("--residuals", action="store_true"), []),
        (option("--refine", action=EITHER, dest="moves"), ["--refine"]),
        (option("--refine", action=EITHER, dest="moves"), ["--no-refine"]),
        (option("--refine", action=EITHER, dest="moves"), []),
        (option("--no-recentre", action="store_false", dest="recentre"), ["--no-recentre"]),
        (option("--no-recentre", action="store_false", dest="recentre"), []),
        (option("--gain", type=float), []),
        (option("images", nargs="+"), ["a.fits", "./-b.fits"]),
        (option("-o", "--output"), ["-o", "./-out.fits"]),
    ],
)  # fmt: skip
def test_the_words_of_a_value_are_parsed_to_that_value(given, words):
    parser = argparse.ArgumentParser()
    parser.add_argument(*given.flags, **given.keywords)
    assert given.words(getattr(parser.parse_args(words), given.name)) == words


def test_cards_follow_from_the_values():
    table = [
        option("--gain", card=("GAIN", "a gain")),
        option("--level", card=("BKG", "a level"), checksum="BSUM"),
        option("--device", card=("DEVICE", "a device")),
        option("--stop"),
    ]
    used = {"gain": None, "level": [2.5, "maps/b.fits"], "device": "CPU/GPU", "stop": 0.1}
    assert record.make_cards(table, used, {"level": ["12ab"]}, [("NBAD", 3, "")])[1:] == [
        ("BKG1", 2.5, "a level"),
        ("BKG2", "b.fits", "a level"),
        ("DEVICE", "CPU/GPU", "a device"),
        ("NBAD", 3, ""),
        ("BSUM1", "12ab", ""),
    ]


def test_warnings_name_the_option_that_was_typed(capsys):
    fits.writeto("wide.fits", np.ones((70, 70)))
    assert run("--quiet", psf="wide.fits") == 0
    assert "crop it, or give --pad to enlarge the grid" in capsys.readouterr().err


FLAGS = {"n_iter": "--n-iter", "mu": "--mu", "pad": "--pad", "psfs": "--psf", "sky": "--sky",
         "sky_brightness": "--sky", "mask": "--mask"}  # fmt: skip


@pytest.mark.parametrize(
    ("message", "named"),
    [
        ("`n_iter`, `mu` and `pad`", "--n-iter, --mu and --pad"),
        ("give `pad` 5 or more, or pad less", "give --pad 5 or more, or pad less"),
        ("with `pad`=3 it fits", "with --pad 3 it fits"),
        ("psfs hold values", "psfs hold values"),
        ("`psfs[0]` of `images[9]` and image 3.fits", "psf 1 of image 10 and image 3.fits"),
        ("`sky_brightness` must be", "--sky must be"),
        ("`initial_extended` holds values", "initial_extended holds values"),
        ("the sky and the mask are empty", "the sky and the mask are empty"),
        ("give a mask file", "give a mask file"),
        ("mask.fits has no pixels", "mask.fits has no pixels"),
        ("n_iter.fits, ./n_iter and 'n_iter' hold images", None),
        ("mu-1.fits and mu/1.fits are missing", None),
    ],
)
def test_only_names_of_parameters_become_options(message, named):
    assert messages.in_shell(message, FLAGS) == (message if named is None else named)


def test_a_file_that_is_called_as_a_parameter_keeps_its_name(capsys):
    Path("oblong.fits").rename("mask")
    assert run(image=("a.fits", "mask")) == 2
    message = "mask has the shape (12, 16) and a.fits (16, 12); they must be the same"
    assert one_complaint(capsys.readouterr()) == message


class TestTakenImages:
    """An option of several values takes every word that follows it."""

    @pytest.mark.parametrize(
        ("words", "advice"),
        [
            (["--psf", "k1.fits", "a.fits"], "--psf has taken a.fits: put it before the options, "
             "or after --, as in --psf k1.fits -- a.fits"),
            (["--psf", "k1.fits", "k2.fits", "--background", "5", "a.fits"],
             "--background has taken a.fits: put it before the options, or after --, as in "
             "--background 5 -- a.fits"),
            (["--psf", "k1.fits", "a.fits", "--background", "5", "6"], "--psf has taken a.fits"),
        ],
    )  # fmt: skip
    def test_the_option_that_has_them_is_named(self, capsys, words, advice):
        assert cli.main(["deconvolve", *words, "-o", "out.fits", *NUMPY]) == 2
        message = one_complaint(capsys.readouterr())
        assert message.startswith("the following arguments are required: IMAGE; ")
        assert advice in message
        assert not Path("out.fits").exists()

    @pytest.mark.parametrize("words", [["--psf", "k1.fits"], ["--psf", "k1.fits", "--gain", "2"]])
    def test_no_option_is_blamed_for_images_that_were_not_given(self, capsys, words):
        assert cli.main(["deconvolve", *words, "-o", "out.fits"]) == 2
        assert one_complaint(capsys.readouterr()) == (
            "the following arguments are required: IMAGE; see lnocl deconvolve --help"
        )


class TestNamesOfOutputs:
    @pytest.mark.parametrize("name", ["w.png", "out", "out.fits.txt", "fits", "no/w.png"])
    def test_others_than_those_of_fits_files_are_refused(self, capsys, name):
        assert run(output=name, image="no.fits") == 2
        assert one_complaint(capsys.readouterr()) == (
            f"the output is a FITS file; give it a name ending in .fits, not {name}"
        )

    @pytest.mark.parametrize("name", ["out.fits", "OUT.FIT", "out.fts"])
    def test_those_of_fits_files_are_taken(self, name):
        assert run(output=name) == 0
        assert fits.getdata(name).shape == (16, 12)


# Words that are ignored without others, and these.
NEEDED = {
    "psf f.fits -o p.fits --without 3,4": "--stars",
    "deconvolve i.fits --psf p.fits -o o.fits --centre 3,4": "--angle",
    "deconvolve i.fits --psf p.fits -o o.fits --epoch each": "--star or --stars",
    "deconvolve i.fits --psf p.fits -o o.fits --refine": "--star or --stars",
    "deconvolve i.fits --psf p.fits -o o.fits --psf-error 0.02": "--star or --stars",
    "deconvolve i.fits --psf p.fits -o o.fits --psf-errors ideal=d.fits": "--star or --stars",
    "deconvolve i.fits --psf p.fits -o o.fits --star-psf 1,2=q.fits": "--star or --stars",
    "limit r.fits --injections 0 --seed 3": "--injections",
    "devices --device 0": "--tune",
    "bench --psf p.fits": "images",
    "bench --background 3": "images",
    "bench --read-noise 3": "images",
    "bench --star 3,4": "images",
}


def test_every_option_that_needs_another_is_listed():
    needing = {
        (name, each.flags[0])
        for name, command in cli.COMMANDS.items()
        for group in command.options.values()
        for each in group
        if each.needs
    }
    words = [each.split() for each in NEEDED]
    assert {(each[0], next(w for w in each[::-1] if w[:2] == "--")) for each in words} == needing


@pytest.mark.parametrize("command", NEEDED)
def test_an_option_that_would_be_ignored_is_refused_before_any_work(command, capsys):
    flag = next(word for word in command.split()[::-1] if word.startswith("--"))
    assert cli.main(command.split()) == 2
    assert one_complaint(capsys.readouterr()) == (
        f"{flag} does nothing without {NEEDED[command]}: give that too, or leave it out"
    )


def test_options_of_stars_are_taken_with_a_table_of_them_and_defaults_alone():
    parser = cli.make_parser()
    for words in ("--stars s.csv --refine --epoch each", "--no-refine"):
        line = f"deconvolve i.fits --psf p.fits -o o.fits {words}"
        parsed = parser.parse_args(line.split())
        parsed.command.refuse_ignored(parsed)


def test_processes_are_refused_where_there_are_no_tiles(capsys):
    assert run("--parallel", "2") == 2
    message = "--parallel does nothing without tiles: give --tile too, or leave it out"
    assert one_complaint(capsys.readouterr()) == message


class TestDeclared:
    """Options from the signature and the docstring of a function."""

    @staticmethod
    def function(
        n: int = 3,
        size: int | Literal["auto"] = "auto",
        width: float = 0.5,
        weight: float | Literal["auto"] | None = None,
        engine: Literal["fast", "exact"] = "fast",
        centred: bool = False,
        refine: bool | Literal["auto"] = "auto",
        path: str | None = None,
        align: Literal["wcs"] | None = None,
        levels: Sequence[str | float] = (0.0,),
        files: Sequence[str] = (),
    ):
        """Do it.

        Parameters
        ----------
        n : int, optional
            Largest number of
            rounds, 1 or more (see `lnocl.core.scene.penalty.Penalty`).

            What the reference says besides.
        size : int or "auto", optional
            FITS pixels. By default "auto", of `engine`, 50 %.
        width : float, optional
            Width, or None (:doc:`/theory/model`), as ``nx // 2``.
        weight : float, "auto" or None
            OpenCL weight.
        centred : bool, optional
            Whether it is.
        levels : sequence of float or str
            Electrons.
        """

    @pytest.mark.parametrize(
        ("name", "words", "value"),
        [
            ("n", ["--n", "4"], 4),
            ("n", [], 3),
            ("size", ["--size", "4"], 4),
            ("size", ["--size", "auto"], "auto"),
            ("width", ["--width", "4"], 4.0),
            ("weight", ["--weight", "auto"], "auto"),
            ("weight", ["--weight", "2"], 2.0),
            ("weight", [], None),
            ("engine", ["--engine", "exact"], "exact"),
            ("centred", ["--centred"], True),
            ("centred", [], False),
            ("refine", ["--refine"], True),
            ("refine", ["--no-refine"], False),
            ("refine", [], None),
            ("path", ["--path", "4"], "4"),
            ("align", ["--align", "wcs"], "wcs"),
            ("levels", ["--levels", "4", "a", "--levels", "-1"], [4.0, "a", -1.0]),
            ("levels", [], None),
            ("files", ["--files", "4"], ["4"]),
        ],
    )
    def test_words_are_converted_to_the_type_of_the_signature(self, name, words, value):
        made = parameter(self.function, name)
        parser = argparse.ArgumentParser()
        parser.add_argument(*made.flags, **made.keywords)
        found = getattr(parser.parse_args(words), name)
        assert (found, type(found)) == (value, type(value))

    def test_other_words_than_the_choices_of_the_signature_are_refused(self):
        assert parameter(self.function, "engine").keywords["choices"] == ("fast", "exact")
        assert parameter(self.function, "align").keywords["choices"] == ("wcs",)

    @pytest.mark.parametrize(
        ("name", "text"),
        [
            ("n", "largest number of rounds, 1 or more (default: 3)"),
            ("size", "FITS pixels. By default auto, of `engine`, 50 %%"),
            ("width", "width, or none, as nx // 2 (default: 0.5)"),
            ("weight", "OpenCL weight"),
            ("centred", "it is"),
            ("path", ""),
            ("levels", "electrons"),
        ],
    )
    def test_the_help_is_the_first_paragraph_of_the_docstring(self, name, text):
        assert parameter(self.function, name).keywords["help"] == text

    def test_shell_option_overrides_the_declared_name_and_default(self):
        made = parameter(self.function, "n", "-n", also="of tiles", dest="rounds", default=None)
        assert (made.name, made.default) == ("rounds", None)
        assert made.keywords["help"].endswith("1 or more; of tiles (default: 3)")


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_option_has_a_help_of_ascii_words_that_names_flags(name, capsys):
    with pytest.raises(SystemExit):
        cli.main([name, "--help"])
    shown = capsys.readouterr().out
    assert shown.isascii()
    assert "`" not in shown
    assert all(each.keywords["help"] for g in cli.COMMANDS[name].options.values() for each in g)


def test_a_star_of_a_table_that_is_given_too_is_taken_once():
    Path("stars.csv").write_text("x,y\n5.8,9.3\n6.9,9.1\n20,3\n")
    header = fits.Header({"NAXIS1": 40, "NAXIS2": 40})
    found = options.star_places([(6.0, 9.0)], "stars.csv", header, "image.fits")
    assert found == [(6.0, 9.0), (6.9, 9.1), (20.0, 3.0)]
    apart = options.star_places([(6.0, 12.0)], "stars.csv", header, "image.fits")
    assert len(apart) == 4
