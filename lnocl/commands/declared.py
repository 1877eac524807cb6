"""Options that a function declares: their type, choices, default and help are its parameters'."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal, get_args, get_origin

from lnocl.commands.options import EITHER, SEVERAL, Option, finite, option, or_word
from lnocl.deconvolution import deconvolve
from lnocl.io.calibration import Calibration

# What a docstring has for readers of the reference alone: where more is said.
_REFERENCE = re.compile(r" \((?:see )?(?:`lnocl\.|:doc:)[^()]*\)")


def parameter(
    function: Callable[..., Any], name: str, *flags: str, also: str = "", **own: Any
) -> Option:
    """Return the option for a parameter of a function or a class.

    Type, choices and default are those of the signature. The help is the first paragraph that the
    docstring, in numpydoc's style, has on the parameter.

    Parameters
    ----------
    function : callable
        What takes the parameter.
    name : str
        Its name.
    *flags : str
        Spellings on the command line; by default the name.
    also : str, optional
        What the help says of the shell alone.
    **own
        As for `lnocl.commands.options.option`, in place of what the function declares.
    """
    declared = inspect.signature(function).parameters[name]
    # Of this one alone: the types of others may be imported for type checkers only.
    annotation = getattr(declared.annotation, "__forward_arg__", declared.annotation)
    hint = eval(annotation, vars(sys.modules[function.__module__]))
    keywords = _conversion(hint)
    words = "; ".join(filter(None, [_first_paragraph(function, name), also]))
    value = keywords.get("default", declared.default)
    if value is not None and "action" not in keywords and "default" not in words:
        words += f" (default: {value:g})" if isinstance(value, float) else f" (default: {value})"
    flags = flags or (f"--{name.replace('_', '-')}",)
    return option(*flags, **{"default": value, "help": words, **keywords, **own})


def _conversion(hint: Any) -> Mapping[str, Any]:
    """Return the keywords for a parser that convert words to a type."""
    if get_origin(hint) is Literal:
        return {"choices": get_args(hint)}
    if get_origin(hint) is Sequence:
        return {**_conversion(get_args(hint)[0]), **SEVERAL, "default": None}
    kinds = set(get_args(hint) or [hint]) - {type(None)}
    if len(kinds) == 1 < len(get_args(hint)):  # with None
        return _conversion(*kinds)
    has_words = str in kinds or any(get_origin(kind) is Literal for kind in kinds)
    if bool in kinds:
        # Neither flag is the word, which is the default.
        return {"action": EITHER, "default": None} if has_words else {"action": "store_true"}
    if float in kinds:
        return {"type": partial(or_word, float) if has_words else float}
    if int in kinds:
        return {"type": partial(or_word, int) if has_words else int, "metavar": "N"}
    return {}


def _first_paragraph(function: Callable[..., Any], name: str) -> str:
    """Return it without references, quotes, and the full stop; none where docstrings are left out.

    Names of other parameters stay between grave accents, for those of their options.
    """
    text = f"{inspect.getdoc(function) or ''}\n"
    found = re.search(rf"^{name} : .*\n((?: .*\n)+)", text, re.MULTILINE)
    if found is None:
        return ""
    paragraph = _REFERENCE.sub("", " ".join(found[1].split()))
    plain = re.sub(r"\bNone\b", "none", paragraph.translate({ord('"'): None}).replace("``", ""))
    plain = plain.removeprefix("Whether ").removesuffix(".").replace("%", "%%")
    first = plain.partition(" ")[0]
    return plain[0].lower() + plain[1:] if first[1:].islower() else plain


DEVICE = parameter(deconvolve, "device", metavar="SPEC")
BACKGROUND = parameter(
    Calibration, "background", metavar="B", card=("BKG", "background, electrons"), checksum="BSUM"
)
READ_NOISE = parameter(
    Calibration, "read_noise", metavar="S", card=("RON", "read noise, electrons"), checksum="RSUM"
)
SATURATION = parameter(
    Calibration,
    "saturation",
    type=finite,
    metavar="V",
    card=("SATURATE", "saturation level, unit of the input"),
)
