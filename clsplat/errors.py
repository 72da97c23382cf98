"""Exceptions whose message is one sentence for the user: what was expected, what was found, what to do."""


class ClsplatError(Exception):
    """Base of every error that the command line prints as one sentence, without a traceback."""


class InputError(ClsplatError, ValueError):
    """An argument or a file that cannot be used as it is; the message names it."""


class DeviceError(ClsplatError, RuntimeError):
    """No usable OpenCL device, or one whose limits a buffer exceeds."""
