"""A terminal to show progress on."""

import io


class Screen(io.StringIO):
    """A stream that is a terminal."""

    def isatty(self):
        """Return True."""
        return True
