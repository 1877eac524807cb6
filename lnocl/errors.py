"""The errors and the warning that lnocl raises."""


class LnoclError(Exception):
    """Anything that lnocl refuses or fails at; its message is one line, meant for the user.

    Attributes
    ----------
    exit_status : int
        What the command line returns for it: 1 failed, 2 wrong use.
    """

    exit_status = 1

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))


class InputError(LnoclError, ValueError):
    """A value that cannot be used: an argument, an image, a PSF, a mask."""

    exit_status = 2


class FileError(LnoclError, OSError):
    """A file that cannot be read or written."""


class DeviceError(LnoclError, RuntimeError):
    """No usable OpenCL device, or the device cannot do what was asked of it."""


class LnoclWarning(UserWarning):
    """Something was changed or left out of the data, and the user should know."""
