"""The environment of a command, made fit for the libraries that it loads."""

from __future__ import annotations

import logging
import os

# A folder that cannot be made.
NO_HOME = os.path.join(os.devnull, "home")


def prepare() -> None:
    """Let users without a home run commands, or with one that cannot be written to.

    astropy fails to import without a home; with one that cannot be read it uses its defaults.
    matplotlib then makes a temporary folder, and its message about that is hidden.
    """
    if not os.path.isabs(os.path.expanduser("~")):
        os.environ["HOME"] = NO_HOME
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
