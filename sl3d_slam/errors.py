"""Errors a user can act on; the command line turns each into one sentence and exit status 2."""


class Sl3dError(Exception):
    """Base of every error this package raises on purpose; its text is one sentence."""


class InputError(Sl3dError):
    """A file, folder or array is missing, damaged or of the wrong form; the text names it."""


class ConfigError(Sl3dError):
    """A setting is unknown, out of range or of the wrong type; the text names its full key."""


class OutputError(Sl3dError):
    """A result could not be written; whatever was there before is untouched."""


class MissingExtraError(Sl3dError):
    """An optional package or system library is absent; the text says how to install it."""


class GraphError(Sl3dError):
    """A factor graph cannot be solved as it stands; the text names the keys in question."""
