"""The environment of a command, made fit for the libraries that it loads."""

from __future__ import annotations

import logging
import os

# A folder that cannot be made.
NO_HOME = os.path.join(os.devnull, "home")


def prepare() -> None:
    """Let users without a home run commands, or with one that cannot be written to.

    astropy fails where there is no home at all, and goes without its settings where it cannot be
    read. matplotlib then takes a temporary folder, and need not say so.
    """
    try:
        is_known = os.path.isabs(os.path.expanduser("~"))
    except (KeyError, RuntimeError):
        is_known = False
    if not is_known:
        os.environ["HOME"] = NO_HOME
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
